"""Normal equations of the distortion with the stars eliminated.

For star s, with A_s the curvature of the log density by its own parameters and B_s that by its own
and the distortion's, elimination leaves

    N = sum_i J_i^T H_i J_i - sum_s B_s^T A_s^-1 B_s

dense in the parameters of the distortion and of the exposures alone.  B_s of some thousand stars at
a time is one matrix, so that the second sum is a product of matrices.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer import kernel
from bayesdist.infer.kernel.blocks import in_turn, threads_for
from bayesdist.infer.kernel.lapack import add_square
from bayesdist.infer.kernel.moments import product_table
from bayesdist.infer.selfcal.problem import Problem
from bayesdist.infer.stars.sums import Sums
from bayesdist.utils.arrays import Float, Int

STARS = 1024  # eliminated at a time
PARTS = 8  # of the stars, whose sums are made separately whatever the number of threads
ELIMINATION = 40  # evaluations of a polynomial that last as long as a detection's part in it
SURE, NEVER = 0.99, 1e-6  # memberships beyond which no other choice is considered
MODE = 10  # evaluations of a polynomial that last as long as the search for a star's mode
NO_MODE = 1e-6  # relative determinant of a curvature that says nothing of where the mode is
SCRATCH = 2_000_000  # bytes of coefficients of draws at a time: the cache of a core


@dataclass(frozen=True)
class Mixture:
    """Distribution of detections about their stars."""

    jitter: float = 0.0  # pixels, in addition to the quoted errors
    fraction: float = 0.01  # of false detections

    def constants(self, log_outlier: float) -> tuple[float, float, float]:
        """Squared jitter, log of the core's fraction, log density of false detections."""
        with np.errstate(divide="ignore"):
            core, false = np.log([1.0 - self.fraction, self.fraction])
        return self.jitter**2, float(core), float(max(false + log_outlier, -1e300))


@dataclass(frozen=True, eq=False)
class PlaceDerivatives:
    """Dependence of sky positions on the parameters, linearised at a solution.

    By the coefficients of a chip's polynomials, M (kron) phi; by everything else, `extra` phi.
    """

    coef: Float  # effective coefficients (G, 2, K)
    linear: Float  # M (G, 2, 2)
    # derivatives (G, m, 2, K) by drift and frames; zero where a group has fewer than m of them
    extra: Float
    columns: Int  # indices (G, m) of these parameters; -1 for none
    jacobian: list[tuple[Int, Float]]  # as of `DistortionModel.effective_jacobian`

    @classmethod
    def at(cls, problem: Problem, theta: Float) -> PlaceDerivatives:
        """PlaceDerivatives of a problem at theta (D,)."""
        groups, K = problem.groups, problem.model.n_terms
        found = problem.effective_jacobian(theta)
        m = max(len(columns) for columns, _ in found) - 2 * K
        extra, columns = np.zeros((len(groups), m, 2, K)), np.full((len(groups), m), -1)
        linear = np.empty((len(groups), 2, 2))
        for g, (which, derivative) in enumerate(found):
            linear[g] = derivative[:, 0, [0, K]]
            n = len(which) - 2 * K
            columns[g, :n] = which[2 * K :]
            extra[g, :n] = np.moveaxis(derivative[..., 2 * K :], 2, 0)
        return cls(problem.effective(theta), linear, extra, columns, found)


@dataclass(frozen=True, eq=False)
class Expansion(Sums):
    """Second-order expansion of the log density at a solution, the stars eliminated."""

    value: float  # log density with the stars integrated out (Laplace), up to a constant
    gradient: Float  # (D,) at the stars' modes
    curvature: Float  # minus the Hessian (D, D)
    n_members: float  # expected number of true detections
    chi2: float  # sum of w times the squared normalised residual


def expand(
    problem: Problem, theta: Float, mixture: Mixture, stars: Float, *, observed: bool = True
) -> tuple[Expansion, Float]:
    """Expansion at theta (D,) and the stars' modes (S, q), by one pass over the detections.

    The search for the modes starts at `stars` (S, q).  If `observed` the curvature is that
    of the mixture itself; otherwise that with EM weights, which is never indefinite.
    """
    structure, D = PlaceDerivatives.at(problem, theta), problem.model.n_params
    order, K = problem.model.order, problem.model.n_terms
    sums = kernel.EliminationSums.zero(len(problem.groups), order)
    curvature, gradient = np.zeros((D, D)), np.zeros(D)
    found = stars.copy()

    def part(first: int, last: int) -> tuple[kernel.EliminationSums, Float]:
        mine = kernel.EliminationSums.zero(len(problem.groups), order)
        absorbed = np.zeros((D, D))
        for _, rows, _ in _passes(problem, structure, mixture, found, observed, first, last, mine):
            add_square(absorbed, rows)
        return mine, absorbed

    edges = np.arange(PARTS + 1) * problem.n_stars // PARTS
    with threads_for(ELIMINATION * len(problem)):
        for mine, absorbed in in_turn(part, edges[:-1], edges[1:]):
            for total, more in zip(sums, mine, strict=True):
                total += more
            curvature -= absorbed
            del absorbed  # as large as the curvature, while the next parts are summed
    curvature += np.tril(curvature, -1).T  # squares are lower triangles
    table = product_table(order)
    weights, pulls = sums.weights[..., : table.shape[-1]], sums.pulls[..., :K]
    squares = np.einsum("gcm,klm->gckl", weights, table, optimize=True)
    for (columns, by), (uu, uv, vv), pull in zip(structure.jacobian, squares, pulls, strict=True):
        by = by.reshape(2 * K, -1)
        curvature[np.ix_(columns, columns)] += by.T @ np.block([[uu, uv], [uv, vv]]) @ by
        gradient[columns] += pull.ravel() @ by
    curvature += curvature.T
    curvature /= 2
    value, members, chi2 = sums.scalars
    return Expansion(float(value), gradient, curvature, members, chi2), found


def eliminated_rows(
    problem: Problem, theta: Float, mixture: Mixture, stars: Float
) -> Iterator[tuple[slice, Float, Float]]:
    """Coupling of stars to the distortion, some stars at a time.

    Yields the stars, L^-1 B (n, q, D) of each, A = L L^T, and L (n, q, q).
    """
    structure, D, q = PlaceDerivatives.at(problem, theta), problem.model.n_params, problem.n_star
    sums = kernel.EliminationSums.zero(len(problem.groups), problem.model.order)
    whole = stars.copy(), True, 0, problem.n_stars, sums
    for some, rows, factors in _passes(problem, structure, mixture, *whole):
        yield some, rows.reshape(len(factors), q, D), factors


def _passes(
    problem: Problem,
    structure: PlaceDerivatives,
    mixture: Mixture,
    stars: Float,
    observed: bool,
    first: int,
    last: int,
    sums: kernel.EliminationSums,
) -> Iterator[tuple[slice, Float, Float]]:
    """Some of the stars first..last at a time, with the results of `kernel.eliminate_stars`."""
    p = problem
    j2, log_core, log_out = mixture.constants(p.log_outlier)
    for begin in range(first, last, STARS):
        some = slice(begin, min(begin + STARS, last))
        found = kernel.eliminate_stars(
            some.start,
            some.stop,
            p.columns,
            stars,
            structure.coef,
            p.groups.chip,
            structure.linear,
            structure.extra,
            structure.columns,
            p.model.n_params,
            p.model.order,
            j2,
            log_core,
            log_out,
            p.least_root,
            observed,
            sums,
        )
        yield some, *found


def memberships(problem: Problem, theta: Float, mixture: Mixture, stars: Float) -> Float:
    """Probability (N,) that a detection belongs to its star."""
    p = problem
    j2, log_core, log_out = mixture.constants(p.log_outlier)
    places = p.places(theta)
    with threads_for(MODE * len(p)):
        found = kernel.weighted_stars(
            p.starts,
            places,
            p.W,
            p.var,
            j2,
            log_core,
            log_out,
            p.time,
            p.factor,
            p.priors.centre,
            p.priors.precision,
            p.least_root,
            stars.copy(),
        )
    return np.asarray(found)


@dataclass(frozen=True, eq=False)
class StarModes:
    """Modes of the stars at a solution, and their response to their detections from there."""

    stars: Float
    response: Float  # (N, 2, 2) of a star's position to its detections'
    middles: Float  # mean positions (S, 2) of the detections at the solution, by these
    state: NDArray[np.int8]  # of each detection (N,): `kernel.MEMBER`, `DOUBTFUL` or `FALSE`

    @classmethod
    def at(cls, problem: Problem, theta: Float, mixture: Mixture, stars: Float) -> StarModes:
        """Modes of a problem at theta (D,), where `stars` are the modes."""
        p, z = problem, problem.places(theta)
        member = memberships(problem, theta, mixture, stars)
        s2 = p.var + mixture.jitter**2
        response = _response(p, _curvatures(p, z - p.star_places(stars), member, s2))
        return cls(stars, response, _means(p, response, z), _states(p, member))

    def moved(self, problem: Problem, theta: Float) -> Float:
        """Stars (S, q), moved as their detections are by theta (D,): start of a search there."""
        out = self.stars.copy()
        out[:, :2] += _means(problem, self.response, problem.places(theta)) - self.middles
        return out


def _curvatures(problem: Problem, residual: Float, member: Float, s2: Float) -> Float:
    """Curvature uu, uv, vv (3, N) of each detection by the position of its star."""
    (u, v), (uu, uv, vv) = residual.T, problem.W.T
    along = np.sqrt(member * (1.0 - member)) / s2
    gu, gv = along * (uu * u + uv * v), along * (uv * u + vv * v)
    core = member / s2
    return np.stack([core * uu - gu * gu, core * uv - gu * gv, core * vv - gv * gv])


def _response(problem: Problem, curvature: Float) -> Float:
    """Response (N, 2, 2) of a star to each of its detections: to their mean if it has no mode."""
    star, counts, known = problem.star, problem.counts, problem.priors.precision
    uu, uv, vv = (
        np.bincount(star, one, minlength=len(counts)) + known[:, a, b]
        for one, (a, b) in zip(curvature, ((0, 0), (0, 1), (1, 1)), strict=True)
    )
    det = uu * vv - uv * uv
    lost = ~((det > NO_MODE * uu * vv) & (uu > 0))
    uu, uv, vv = (np.where(lost, 0.0, one / np.where(lost, 1.0, det))[star] for one in (uu, uv, vv))
    a, b, c = curvature
    rows = [[vv * a - uv * b, vv * b - uv * c], [uu * b - uv * a, uu * c - uv * b]]
    out = np.stack([np.stack(row, axis=1) for row in rows], axis=1)
    out[lost[star]] = np.eye(2)
    out[lost[star]] /= counts[star[lost[star]]][:, None, None]
    return out


def _means(problem: Problem, response: Float, places: Float) -> Float:
    """Mean positions (S, 2) of the detections of each star, by their response (N, 2, 2)."""
    moves = np.einsum("nab,nb->na", response, places)
    return np.stack([np.bincount(problem.star, moves[:, axis]) for axis in (0, 1)], axis=1)


def _states(problem: Problem, member: Float) -> NDArray[np.int8]:
    """States (N,) of detections; doubtful memberships are summed over, for stars without motion.

    All detections of a star with few are doubtful if one is: another one may have the right
    members.
    """
    out = np.where(member > 0.5, kernel.MEMBER, kernel.FALSE).astype(np.int8)
    if problem.n_star > 2:
        return out
    doubtful = member < SURE
    few = problem.counts <= kernel.MOST_DOUBTFUL
    open_stars = np.bincount(problem.star, doubtful) > 0
    out[(few & open_stars)[problem.star]] = kernel.DOUBTFUL
    # of many detections the most doubtful ones
    rest = np.flatnonzero(doubtful & (member > NEVER) & ~few[problem.star])
    rest = rest[np.lexsort((np.abs(member[rest] - 0.5), problem.star[rest]))]
    star = problem.star[rest]
    rank = np.arange(len(rest)) - np.searchsorted(star, star)
    out[rest[rank < kernel.MOST_DOUBTFUL]] = kernel.DOUBTFUL
    return out


def log_marginal(problem: Problem, theta: Float, mixtures: Float, modes: StarModes) -> Float:
    """Log densities (n,) of theta (n, D), the stars integrated out (Laplace), up to a constant.

    `mixtures` (n, 2) are jitter in pixels and fraction of false detections; the search for the
    stars' modes starts from `modes`, of a solution near by.
    """
    p = problem
    rows = np.array([Mixture(j, f).constants(p.log_outlier) for j, f in mixtures])
    out = np.empty(len(theta))
    # a multiple of eight, as in a vector instruction
    step = max(8, SCRATCH // (16 * p.model.n_terms * len(p.groups)) // 8 * 8)
    for a in range(0, len(theta), step):
        some = slice(a, a + step)
        with threads_for(MODE * len(p) * len(theta[some])):
            sums = kernel.log_marginals(
                p.columns,
                modes.stars,
                modes.middles,
                modes.response,
                modes.state,
                p.effective(theta[some]),
                p.model.order,
                rows[some],
                p.least_root,
            )
        out[some] = sums.sum(axis=0)
    return out
