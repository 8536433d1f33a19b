"""Normal equations of the distortion with the stars eliminated, and passes over pieces of the data.

For star s, let A_s be minus the second derivatives of the log density with respect to the star's
parameters, and B_s the mixed ones with respect to those and the parameters of the model.  With the
derivatives J_i of position i with respect to the parameters of the model and the curvature H_i of
its log density, the elimination of all stars gives

    N = sum_i J_i^T H_i J_i - sum_s B_s^T A_s^-1 B_s

for the parameters of distortion and exposures.  The B_s of about a thousand stars at a time form a
matrix, so that the second sum is a matrix product.

Passes over the detections are made piece by piece, in this process or on a cluster.  A piece
contains all detections of some stars, and the stars at the current solution.  Its next state and
its contribution to any sum depend only on the piece and on the parameters.  Therefore stars are not
transferred, and a lost piece can be computed again from its detections.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from typing import Concatenate, TypeVar

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.kernel.blocks import in_turn, threads_for
from bayesdist.infer.kernel.lapack import add_square
from bayesdist.infer.kernel.moments import product_table
from bayesdist.infer.stars.shards import Compute, MappedPieces, P, Piece_co, T
from bayesdist.infer.stars.stars import Sums
from bayesdist.kinds.selfcal import kernel
from bayesdist.kinds.selfcal.infer.problem import Problem, StarPriors
from bayesdist.utils.arrays import Float, Int

Source = TypeVar("Source")

STARS = 1024  # number of stars that are eliminated at a time
PARTS = 8  # number of partial sums over the stars, independent of the number of threads
ELIMINATION = 40  # cost of the elimination per detection, in evaluations of a polynomial
SURE, NEVER = 0.99, 1e-6  # membership probabilities beyond which a detection is not doubtful
MODE = 10  # cost of the search for a star's mode per detection, in evaluations of a polynomial
NO_MODE = 1e-6  # relative determinant of a curvature that does not determine a star's position
SCRATCH = 2_000_000  # bytes of coefficients of draws processed at a time: the cache of a core

PIECE = 2**17  # detections per piece: a few tenths of a second for a batch of draws


@dataclass(frozen=True)
class Mixture:
    """Parameters of the distribution of detections about their stars."""

    jitter: float = 0.0  # error in pixels in addition to the quoted errors
    fraction: float = 0.01  # fraction of false detections

    def constants(self, log_outlier: float) -> tuple[float, float, float]:
        """Squared jitter, log of the fraction of true detections, and log density of false ones.

        `log_outlier` is the log density of a detection that is known to be false.
        """
        with np.errstate(divide="ignore"):
            core, false = np.log([1.0 - self.fraction, self.fraction])
        return self.jitter**2, float(core), float(max(false + log_outlier, -1e300))


@dataclass(frozen=True, eq=False)
class PlaceDerivatives:
    """Derivatives of sky positions with respect to the parameters, linearised at a solution.

    Those with respect to the polynomial coefficients of a chip are M (kron) phi; those with respect
    to other parameters are `extra` phi.
    """

    coef: Float  # effective coefficients (G, 2, K)
    linear: Float  # M (G, 2, 2)
    # derivatives (G, m, 2, K) with respect to drift and frame parameters; zero if there are fewer
    extra: Float
    columns: Int  # indices (G, m) of these parameters; -1 for none
    jacobian: list[tuple[Int, Float]]  # result of `Problem.effective_jacobian`

    @classmethod
    def at(cls, problem: Problem, theta: Float) -> PlaceDerivatives:
        """Linearise a problem at theta (D,)."""
        groups, K = problem.groups, problem.model.n_terms
        jacobian = problem.effective_jacobian(theta)
        m = max(len(columns) for columns, _ in jacobian) - 2 * K
        extra, columns = np.zeros((len(groups), m, 2, K)), np.full((len(groups), m), -1)
        linear = np.empty((len(groups), 2, 2))
        for g, (indices, derivative) in enumerate(jacobian):
            linear[g] = derivative[:, 0, [0, K]]
            n = len(indices) - 2 * K
            columns[g, :n] = indices[2 * K :]
            extra[g, :n] = np.moveaxis(derivative[..., 2 * K :], 2, 0)
        return cls(problem.effective(theta), linear, extra, columns, jacobian)


@dataclass(frozen=True, eq=False)
class Expansion(Sums):
    """Second-order expansion of the log density at a solution, with the stars eliminated."""

    value: float  # log density with the stars integrated out (Laplace), up to a constant
    gradient: Float  # gradient (D,) at the modes of the stars
    curvature: Float  # minus the Hessian (D, D)
    n_members: float  # expected number of true detections
    chi2: float  # sum of membership probability times squared normalised residual


def expand(
    problem: Problem, theta: Float, mixture: Mixture, stars: Float, *, observed: bool = True
) -> tuple[Expansion, Float]:
    """Expand the log density at theta (D,), and find the modes (S, q) of the stars, in one pass.

    The search for the modes starts at `stars` (S, q).  If `observed` is True, the curvature is that
    of the mixture; otherwise EM weights are used, with which it is never indefinite.  Returns the
    expansion and the modes.
    """
    structure, D = PlaceDerivatives.at(problem, theta), problem.model.n_params
    order, K = problem.model.order, problem.model.n_terms
    sums = kernel.EliminationSums.zero(len(problem.groups), order)
    curvature, gradient = np.zeros((D, D)), np.zeros(D)
    modes = stars.copy()

    def part(first: int, last: int) -> tuple[kernel.EliminationSums, Float]:
        mine = kernel.EliminationSums.zero(len(problem.groups), order)
        absorbed = np.zeros((D, D))
        for _, rows, _ in _passes(problem, structure, mixture, modes, observed, first, last, mine):
            add_square(absorbed, rows)
        return mine, absorbed

    edges = np.arange(PARTS + 1) * problem.n_stars // PARTS
    with threads_for(ELIMINATION * len(problem)):
        for mine, absorbed in in_turn(part, edges[:-1], edges[1:]):
            for total, term in zip(sums, mine, strict=True):
                total += term
            curvature -= absorbed
            del absorbed  # release memory: it is as large as the curvature
    curvature += np.tril(curvature, -1).T  # `add_square` fills lower triangles only
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
    return Expansion(float(value), gradient, curvature, members, chi2), modes


def eliminated_rows(
    problem: Problem, theta: Float, mixture: Mixture, stars: Float
) -> Iterator[tuple[slice, Float, Float]]:
    """Yield the coupling of the stars to the parameters of the model, in batches of stars.

    Each item has the slice of n stars, L^-1 B (n, q, D), and L (n, q, q), with A = L L^T.
    """
    structure, D, q = PlaceDerivatives.at(problem, theta), problem.model.n_params, problem.n_star
    sums = kernel.EliminationSums.zero(len(problem.groups), problem.model.order)
    arguments = stars.copy(), True, 0, problem.n_stars, sums
    for batch, rows, factors in _passes(problem, structure, mixture, *arguments):
        yield batch, rows.reshape(len(factors), q, D), factors


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
    """Yield slices of the stars first..last with the results of `kernel.eliminate_stars`."""
    p = problem
    j2, log_core, log_out = mixture.constants(p.log_outlier)
    for begin in range(first, last, STARS):
        batch = slice(begin, min(begin + STARS, last))
        results = kernel.eliminate_stars(
            batch.start,
            batch.stop,
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
        yield batch, *results


def memberships(problem: Problem, theta: Float, mixture: Mixture, stars: Float) -> Float:
    """Probability (N,) that each detection belongs to its star.

    `theta` (D,) are the parameters of the model, and the search for the modes of the stars starts
    at `stars` (S, q).
    """
    p = problem
    j2, log_core, log_out = mixture.constants(p.log_outlier)
    places = p.places(theta)
    with threads_for(MODE * len(p)):
        probability = kernel.weighted_stars(
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
    return np.asarray(probability)


@dataclass(frozen=True, eq=False)
class StarModes:
    """Modes of the stars at a solution, and their linear response to changes of the parameters."""

    stars: Float  # parameters (S, q) at the modes
    response: Float  # derivatives (N, 2, 2) of a star's position with respect to its detections
    middles: Float  # sums (S, 2) of response times position of the detections, at the solution
    state: NDArray[np.int8]  # state (N,) of the detections: MEMBER, DOUBTFUL or FALSE of `kernel`

    @classmethod
    def at(cls, problem: Problem, theta: Float, mixture: Mixture, stars: Float) -> StarModes:
        """Compute the response for a problem at theta (D,), where `stars` (S, q) are the modes."""
        p, z = problem, problem.places(theta)
        member = memberships(problem, theta, mixture, stars)
        s2 = p.var + mixture.jitter**2
        response = _response(p, _curvatures(p, z - p.star_places(stars), member, s2))
        return cls(stars, response, _means(p, response, z), _states(p, member))

    def moved(self, problem: Problem, theta: Float) -> Float:
        """Predicted modes (S, q) at other parameters theta (D,), as start of a search there."""
        out = self.stars.copy()
        out[:, :2] += _means(problem, self.response, problem.places(theta)) - self.middles
        return out


def _curvatures(problem: Problem, residual: Float, member: Float, s2: Float) -> Float:
    """Minus the second derivatives uu, uv, vv (3, N) with respect to the position of the star."""
    (u, v), (uu, uv, vv) = residual.T, problem.W.T
    along = np.sqrt(member * (1.0 - member)) / s2
    gu, gv = along * (uu * u + uv * v), along * (uv * u + vv * v)
    core = member / s2
    return np.stack([core * uu - gu * gu, core * uv - gu * gv, core * vv - gv * gv])


def _response(problem: Problem, curvature: Float) -> Float:
    """Derivatives (N, 2, 2) of a star's position with respect to the position of each detection.

    If a star has no well-defined mode, its position is taken to be the mean of its detections.
    """
    star, counts, prior_precision = problem.star, problem.counts, problem.priors.precision
    uu, uv, vv = (
        np.bincount(star, element, minlength=len(counts)) + prior_precision[:, a, b]
        for element, (a, b) in zip(curvature, ((0, 0), (0, 1), (1, 1)), strict=True)
    )
    det = uu * vv - uv * uv
    lost = ~((det > NO_MODE * uu * vv) & (uu > 0))
    uu, uv, vv = (
        np.where(lost, 0.0, element / np.where(lost, 1.0, det))[star] for element in (uu, uv, vv)
    )
    a, b, c = curvature
    rows = [[vv * a - uv * b, vv * b - uv * c], [uu * b - uv * a, uu * c - uv * b]]
    out = np.stack([np.stack(row, axis=1) for row in rows], axis=1)
    out[lost[star]] = np.eye(2)
    out[lost[star]] /= counts[star[lost[star]]][:, None, None]
    return out


def _means(problem: Problem, response: Float, places: Float) -> Float:
    """Sums (S, 2) over the detections of each star of response (N, 2, 2) times position (N, 2)."""
    moves = np.einsum("nab,nb->na", response, places)
    return np.stack([np.bincount(problem.star, moves[:, axis]) for axis in (0, 1)], axis=1)


def _states(problem: Problem, member: Float) -> NDArray[np.int8]:
    """States (N,) of the detections: MEMBER, DOUBTFUL or FALSE of `kernel`.

    Only stars without proper motion have doubtful detections.  If a star with few detections has a
    doubtful one, all its detections are doubtful, since the true members may be other ones.
    """
    out = np.where(member > 0.5, kernel.MEMBER, kernel.FALSE).astype(np.int8)
    if problem.n_star > 2:
        return out
    doubtful = member < SURE
    has_few = problem.counts <= kernel.MOST_DOUBTFUL
    open_stars = np.bincount(problem.star, doubtful) > 0
    out[(has_few & open_stars)[problem.star]] = kernel.DOUBTFUL
    # for stars with many detections only the most doubtful ones
    candidates = np.flatnonzero(doubtful & (member > NEVER) & ~has_few[problem.star])
    candidates = candidates[
        np.lexsort((np.abs(member[candidates] - 0.5), problem.star[candidates]))
    ]
    star = problem.star[candidates]
    rank = np.arange(len(candidates)) - np.searchsorted(star, star)
    out[candidates[rank < kernel.MOST_DOUBTFUL]] = kernel.DOUBTFUL
    return out


def log_marginal(problem: Problem, theta: Float, mixtures: Float, modes: StarModes) -> Float:
    """Log densities (n,) of theta (n, D), with the stars integrated out, up to a constant.

    The integral is a Laplace approximation.  `mixtures` (n, 2) are the jitter in pixels and the
    fraction of false detections.  `modes` of a nearby solution provide the starting points for the
    stars' modes.
    """
    p = problem
    rows = np.array([Mixture(j, f).constants(p.log_outlier) for j, f in mixtures])
    out = np.empty(len(theta))
    # a multiple of eight draws, to fill SIMD vectors
    step = max(8, SCRATCH // (16 * p.model.n_terms * len(p.groups)) // 8 * 8)
    for a in range(0, len(theta), step):
        draws = slice(a, a + step)
        with threads_for(MODE * len(p) * len(theta[draws])):
            sums = kernel.log_marginals(
                p.columns,
                modes.stars,
                modes.middles,
                modes.response,
                modes.state,
                p.effective(theta[draws]),
                p.model.order,
                rows[draws],
                p.least_root,
            )
        out[draws] = sums.sum(axis=0)
    return out


# -- division of the detections into pieces, in this process or on a cluster, for the passes -------


@dataclass(frozen=True, eq=False)
class StarPiece:
    """Stars with all their detections."""

    problem: Problem  # linearised at the stars of the last step
    stars: Float  # parameters (S, q) of the stars

    def __sizeof__(self) -> int:
        """Size of all columns in bytes, which Dask uses to estimate the cost of moving a piece."""
        columns = [*self.problem.columns, self.problem.seen, self.stars]
        if self.problem.shape is not None:
            columns.append(self.problem.shape)
        return sum(column.nbytes for column in columns)

    def split(self, detections: int) -> Iterator[StarPiece]:
        """Divide into pieces of consecutive stars with about `detections` detections each."""
        p = self.problem
        ends = np.searchsorted(p.starts, np.arange(detections, len(p), detections))
        for stars in np.split(np.arange(p.n_stars), np.unique(ends)):
            if len(stars):
                part = replace(p.of_stars(stars), rows=np.empty(0, np.int64))
                yield StarPiece(part, self.stars[stars])


@dataclass(frozen=True, eq=False)
class Expanded(StarPiece):
    """Stars at their modes, with the expansion of the log density there."""

    expansion: Expansion


# -- next states ----------------------------------------------------------------------------------


def at_stars(piece: StarPiece, theta: Float) -> StarPiece:
    """Piece linearised at theta (D,) and at its current stars."""
    return StarPiece(piece.problem.at(theta, piece.stars), piece.stars)


def at_means(piece: StarPiece, theta: Float) -> StarPiece:
    """Piece linearised at theta (D,), with the stars at the means of their detections."""
    return at_stars(replace(piece, stars=piece.problem.mean_places(theta)), theta)


def at_medians(piece: StarPiece, theta: Float) -> StarPiece:
    """Piece linearised at theta (D,), with the stars at the medians of their detections."""
    return at_stars(replace(piece, stars=piece.problem.median_places(theta)), theta)


def at_modes(piece: StarPiece, theta: Float, mixture: Mixture, observed: bool) -> Expanded:
    """Piece with the stars at their modes, and the expansion there (see `expand`).

    Stars that have moved away from all their detections are reset.
    """
    result, stars = expand(piece.problem, theta, mixture, piece.stars, observed=observed)
    return Expanded(piece.problem, piece.problem.found_again(theta, stars), result)


def moved(piece: StarPiece, before: Float, after: Float) -> StarPiece:
    """Piece re-linearised after a change of the parameters (D,) from `before` to `after`.

    Stars move like the means of their detections.
    """
    p, stars = piece.problem, piece.stars.copy()
    stars[:, :2] += p.shifts(before, after)
    return StarPiece(p.at(after, stars), stars)


@dataclass(frozen=True, eq=False)
class ModePiece(StarPiece):
    """Stars at the modes of a solution, with their response to changes of the parameters."""

    modes: StarModes

    def __sizeof__(self) -> int:
        """Size of all columns in bytes; see `StarPiece`."""
        m = self.modes
        return super().__sizeof__() + sum(c.nbytes for c in (m.response, m.middles, m.state))


def to_sample(piece: StarPiece, theta: Float, mixture: Mixture) -> ModePiece:
    """Prepare a piece of a solution for computing the densities of draws near it."""
    # only the columns that the passes use are needed
    p = replace(piece.problem, seen=np.empty((2, 0)))
    return ModePiece(p, piece.stars, StarModes.at(p, theta, mixture, piece.stars))


# -- sums -----------------------------------------------------------------------------------------


def expansion_of(piece: Expanded) -> Expansion:
    """Expansion that is stored with a piece."""
    return piece.expansion


def expansion(
    piece: StarPiece, theta: Float, mixture: Mixture, observed: bool, priors: bool
) -> Expansion:
    """Expansion of the log density (see `expand`), with or without the priors of the stars."""
    p = piece.problem
    if not priors:
        p = replace(p, priors=StarPriors.none(p.n_stars, p.n_star))
    return expand(p, theta, mixture, piece.stars, observed=observed)[0]


def log_density(piece: ModePiece, theta: Float, mixtures: Float) -> Float:
    """Log densities (n,) of theta (n, D); see `log_marginal`."""
    return log_marginal(piece.problem, theta, mixtures, piece.modes)


def slope(piece: ModePiece, theta: Float, mixture: Mixture, observed: bool) -> Expansion:
    """Expansion of the log density at theta (D,); see `expand`."""
    stars = piece.modes.moved(piece.problem, theta)
    return expand(piece.problem, theta, mixture, stars, observed=observed)[0]


# -- results per piece ----------------------------------------------------------------------------


def squares(piece: StarPiece, theta: Float) -> Float:
    """Squared distances (N,) of the detections from their stars, in square pixels."""
    return piece.problem.squares(theta, piece.stars)


def _state(piece: StarPiece) -> tuple[Float, ...]:
    p = piece.problem
    return p.X, p.Y, p.offset, p.W, piece.stars


def gathered(problem: Problem, pieces: MappedPieces[StarPiece]) -> StarPiece:
    """Collect the pieces of a problem in a single piece."""
    states = pieces.each(_state)
    X, Y, offset, W, stars = (
        columns[0] if len(columns) == 1 else np.concatenate(columns)
        for columns in zip(*states, strict=True)
    )
    return StarPiece(replace(problem, X=X, Y=Y, offset=offset, W=W), stars)


# -- location of the pieces -----------------------------------------------------------------------


@contextmanager
def in_pieces(
    problem: Problem, stars: Float, compute: Compute | None = None
) -> Iterator[MappedPieces[StarPiece]]:
    """Context with the detections and stars (S, q), as one piece here or as many on a cluster.

    Raises the InputErrors of `ClusterPieces`.
    """
    piece = StarPiece(problem, stars)
    pieces: MappedPieces[StarPiece] = _Whole(piece)
    if compute is not None and compute.engine == "dask":
        # dask is imported only if its engine is requested
        from bayesdist.infer.stars.cluster import ClusterPieces

        pieces = ClusterPieces(_same, piece.split(PIECE), compute)
    try:
        yield pieces
    finally:
        pieces.close()


def each_of(
    compute: Compute | None, function: Callable[[Source], T], sources: Iterable[Source]
) -> Iterable[T]:
    """Results of a function for each source, in their order, computed here or on a cluster.

    Raises the InputErrors of `ClusterPieces`.
    """
    if compute is None or compute.engine != "dask":
        return map(function, sources)
    from bayesdist.infer.stars.cluster import ClusterPieces

    with closing(ClusterPieces(function, sources, compute)) as pieces:
        return list(pieces.each(_same))


@contextmanager
def one_cluster(compute: Compute | None) -> Iterator[Compute | None]:
    """Context in which all calls of `in_pieces` with the yielded `Compute` share one cluster.

    Without dask, `compute` itself is yielded.
    """
    if compute is None or compute.engine != "dask":
        yield compute
        return
    from bayesdist.infer.stars import cluster

    with cluster.one_cluster(compute) as shared:
        yield shared


class _Whole(MappedPieces[Piece_co]):
    """A single piece in this process; passes use its threads."""

    def __init__(self, piece: Piece_co) -> None:
        self._piece = piece

    def sum(
        self, task: Callable[Concatenate[Piece_co, P], T], *args: P.args, **options: P.kwargs
    ) -> T:
        """Result of the task."""
        return task(self._piece, *args, **options)

    def each(
        self, task: Callable[Concatenate[Piece_co, P], T], *args: P.args, **options: P.kwargs
    ) -> tuple[T]:
        """Result of the task as a tuple of one item."""
        return (task(self._piece, *args, **options),)

    def map(
        self, task: Callable[Concatenate[Piece_co, P], T], *args: P.args, **options: P.kwargs
    ) -> _Whole[T]:
        """New piece from the task."""
        return _Whole(task(self._piece, *args, **options))

    def close(self) -> None:
        """Do nothing, as there is nothing to release."""


def _same(piece: T) -> T:
    """Return the piece (runs on a worker), to keep it there or to fetch it."""
    return piece
