"""Joint mode of distortion, frames, stars and memberships, in a gauge determined at the mode.

Free directions are determined at a solution, but finding a solution requires that parameters are
fixed.  With the large errors of a starting point, more directions seem free than at the mode; for
example if roll angles hardly differ.  The free directions are therefore determined again at the
mode, and the decision is stored with the solution for later use.

`expected_solution` gives the covariance that is expected for planned exposures: that of the mode
for simulated detections.  It depends only on the positions of the stars: residuals would enter the
information only through the membership probabilities, and all simulated detections are at the
positions of their stars.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bayesdist.data.detections import Detections
from bayesdist.errors import DegenerateError, NotSettledError
from bayesdist.infer.equations.priors import Prior
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.solution.transforms import gauge_free_matrix
from bayesdist.infer.stars.likelihood import Clip
from bayesdist.infer.stars.shards import Compute, MappedPieces
from bayesdist.kinds.selfcal.infer import elimination as of
from bayesdist.kinds.selfcal.infer.elimination import Expansion, Mixture, expand
from bayesdist.kinds.selfcal.infer.gauge import Decision, Gauge, find_gauge
from bayesdist.kinds.selfcal.infer.problem import Problem, prepare
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.quantities import Random, generator_of

PriorAt = Callable[[Float], Prior]  # prior linearised at given parameters (D,)
MAX_PASSES = 80
MAX_DECREMENT = 1e-5  # decrement (expected gain in log density) at convergence
NEAR = 1.0  # decrement below which the curvature of the mixture is used instead of EM weights
MAX_CHANGE = 1e-4  # relative change of errors and of the fraction of false detections
MIN_FRACTION = 1e-5  # smallest fraction of false detections
# initial errors as a multiple of the robust scatter, large enough that no star is lost
START_SCALE = 3.0
REJECTED = 25.0  # chi-square (sum over both axes) above which a detection counts as rejected

BOUNDED = 1e-3  # largest unexplained fraction of a free direction for bounded errors
NONE_FALSE = Mixture(jitter=0.0, fraction=1e-300)


@dataclass(frozen=True, eq=False)
class SelfCalibrationMode:
    """Mode of the posterior of a self-calibration.

    Parameters
    ----------
    problem : Problem
        Detections, linearised at the mode.
    theta : ndarray, shape (D,)
        Parameters of the model.
    stars : ndarray, shape (S, q)
        Parameters of the stars.
    mixture : Mixture
        Jitter (by moments) and fraction of false detections.
    free : ndarray of int, shape (F,)
        Indices of the parameters that were fitted; the gauge fixes the others.
    expansion : Expansion
        Expansion of the log density at the mode.
    curvatures : tuple of ndarray, shape (D, D)
        Curvatures with EM weights, which are never indefinite: for the detections alone, and
        including the priors of the stars.
    prior : Prior
        Information from other sources than the detections.
    decision : Decision, optional
        Free directions; None if only `free` was specified.
    """

    problem: Problem
    theta: Float
    stars: Float
    mixture: Mixture
    free: Int
    expansion: Expansion
    curvatures: tuple[Float, Float]
    prior: Prior
    decision: Decision | None = None

    @property
    def precision(self) -> Float:
        """Precision (F, F) of the free parameters, including information from other sources."""
        total = self.expansion.curvature + self.prior.precision
        return np.asarray(total[np.ix_(self.free, self.free)])

    @property
    def cov(self) -> Float:
        """Covariance (D, D) of the parameters of the model; zero for fixed parameters."""
        precision = self.precision
        scale = 1.0 / np.sqrt(np.diag(precision))
        # the product of roots stays positive definite even if a nearly free direction dominates
        factor = np.linalg.cholesky(precision * np.outer(scale, scale))
        root = np.linalg.inv(factor).T * scale[:, None]
        out = np.zeros((len(self.theta),) * 2)
        out[np.ix_(self.free, self.free)] = root @ root.T
        return out

    @property
    def distortion_information(self) -> Float:
        """Information (d, d) of the detections about polynomials and drift.

        Stars and frames are eliminated.  Rows and columns of fixed parameters are zero.
        """
        return of_first(self.expansion.curvature, self.free, self.problem.model.n_distortion)

    @property
    def gain(self) -> float:
        """Information of a further exposure about the distortion, in units of the average exposure.

        The position of a star absorbs the information of one of its detections (of more if the star
        also moves, and of less if its position is known from other data).  A star with m detections
        therefore contributes the information of m - 1, while further detections of it contribute
        fully.
        """
        p, error = self.problem, self.error
        data = np.bincount(p.star, (p.W[:, 0] + p.W[:, 2]) / 2, minlength=p.n_stars) / error**2
        known = np.trace(p.priors.precision[:, :2, :2], axis1=1, axis2=2) / 2
        absorbed = np.minimum(p.n_star / 2 * data / (data + known), np.maximum(p.counts - 1, 1))
        return float(len(p) / (len(p) - absorbed.sum()))

    @property
    def error(self) -> float:
        """Typical error of a detection per axis in pixels."""
        return float(np.sqrt(np.median(self.problem.var) + self.mixture.jitter**2))

    @cached_property
    def solution(self) -> LinearFit:
        """Linear solution for distortion and frames, with the statistics of the residuals.

        Its covariance is the inverse of the curvature with the stars eliminated.
        """
        p, theta = self.problem, self.theta
        wider = 1.0 + self.mixture.jitter**2 / p.sigma**2
        clip = Clip(theta, REJECTED * wider, p.match_radius * p.model.pixel_size(theta))
        square = p.squares(theta, self.stars) / p.var
        residual = p.places(theta) - p.star_places(self.stars)
        far = np.hypot(*residual.T) > clip.abs_limit
        used = (square <= clip.chi2_limit) & ~far
        n, n_used = len(p), int(used.sum())
        precision = self.precision
        scale = np.sqrt(np.diag(precision))
        uu, vv = (residual[used] ** 2).mean(axis=0)
        lost = p.n_star * p.n_stars + len(self.free)
        return LinearFit(
            model=p.model,
            mean=theta,
            cov=self.cov,
            clip=clip,
            n_rows=n,
            n_used=n_used,
            rms_u=float(np.sqrt(uu)),
            rms_v=float(np.sqrt(vv)),
            rms_rejected=float(np.sqrt((residual[~used] ** 2).mean())) if n > n_used else 0.0,
            rejected={
                "chi-square": int((~used & ~far).sum()),
                "absolute residual": int(far.sum()),
            },
            chi2=float(square[used].sum()),
            dof=max(2 * n_used - lost, 1),
            condition=float(np.linalg.cond(precision / np.outer(scale, scale))),
        )


def of_first(curvature: Float, free: Int, n: int) -> Float:
    """Information (n, n) about the first n parameters, with later ones eliminated.

    `curvature` (D, D) is minus the Hessian with respect to all parameters, and `free` (F,) are the
    indices of those that are fitted.  Rows and columns of fixed parameters are zero.
    """
    own, later = free[free < n], free[free >= n]
    left = curvature[np.ix_(own, own)]
    if later.size:
        local, cross = curvature[np.ix_(later, later)], curvature[np.ix_(own, later)]
        scale = 1.0 / np.sqrt(np.diag(local))
        half = cross * scale
        left = left - half @ np.linalg.solve(local * np.outer(scale, scale), half.T)
    out = np.zeros((n, n))
    out[np.ix_(own, own)] = (left + left.T) / 2
    return out


def solve(
    problem: Problem,
    theta: Float,
    free: Int,
    prior: Prior,
    *,
    stars: Float | None = None,
    mixture: Mixture | None = None,
    jitter: float | None = None,
    compute: Compute | None = None,
) -> SelfCalibrationMode:
    """Find the mode by Newton's method, eliminating the stars in each pass.

    The initial errors are as large as the scatter at the start and decrease with it, so that no
    star is lost if the start is inaccurate.

    Parameters
    ----------
    problem : Problem
    theta : ndarray, shape (D,)
        Starting parameters.
    free : ndarray of int, shape (F,)
        Indices of the parameters to fit.
    prior : Prior
        Information from other sources than the detections.
    stars : ndarray, shape (S, q), optional
        Starting values of the stars; by default the medians of their detections.
    mixture : Mixture, optional
        Starting values of jitter and fraction of false detections.
    jitter : float, optional
        Fixed jitter in pixels; fitted by default.
    compute : Compute, optional
        Computing engine; this process by default.

    Returns
    -------
    SelfCalibrationMode

    Raises
    ------
    DegenerateError
        If the free parameters are not determined.
    NotSettledError
        If the search does not converge.
    """
    with _loaded(problem, stars, compute) as loaded:
        begin = _Begun(loaded, theta, mixture, medians=stars is None)
        return _solved(problem, begin, free, prior, jitter).mode(problem)


@dataclass(frozen=True, eq=False)
class _Begun:
    """Starting point of a search."""

    pieces: MappedPieces[of.StarPiece]
    theta: Float
    mixture: Mixture | None = None  # None to start with large errors
    medians: bool = False  # True to start with the stars at the medians of their detections


@dataclass(frozen=True, eq=False)
class _FoundMode:
    """Result of a search."""

    pieces: MappedPieces[of.StarPiece]
    theta: Float
    mixture: Mixture
    free: Int
    expansion: Expansion
    curvatures: tuple[Float, Float]
    prior: Prior
    decision: Decision | None = None

    @property
    def again(self) -> _Begun:
        """Starting point of another search from this result."""
        return _Begun(self.pieces, self.theta, self.mixture)

    def mode(self, problem: Problem) -> SelfCalibrationMode:
        """Collect all detections in this process and return the mode."""
        gathered = of.gathered(problem, self.pieces)
        remaining = (
            self.mixture,
            self.free,
            self.expansion,
            self.curvatures,
            self.prior,
            self.decision,
        )
        return SelfCalibrationMode(gathered.problem, self.theta, gathered.stars, *remaining)


def _loaded(
    problem: Problem, stars: Float | None, compute: Compute | None
) -> AbstractContextManager[MappedPieces[of.StarPiece]]:
    """Context with the pieces of a problem, with stars (S, q) or, if None, stars at zero."""
    places = np.zeros((problem.n_stars, problem.n_star)) if stars is None else stars
    return of.in_pieces(problem, places, compute)


def _solved(
    problem: Problem, begin: _Begun, free: Int, prior: Prior, jitter: float | None
) -> _FoundMode:
    theta, near = begin.theta, False
    pieces = begin.pieces.map(of.at_medians if begin.medians else of.at_stars, theta)
    mixture = begin.mixture or wide_mixture(pieces, theta)
    for _ in range(MAX_PASSES):
        at_modes = pieces.map(of.at_modes, theta, mixture, near)
        expansion = at_modes.sum(of.expansion_of)
        gradient = expansion.gradient + prior.pull(theta)
        step = newton_step(expansion.curvature + prior.precision, gradient, free)
        if step is None and near:
            near, pieces = False, at_modes
            continue
        if step is None:
            raise DegenerateError(
                "the detections do not determine the free parameters",
                where="self-calibration",
                do="check the gauge: dither more, add roll angles, or give priors",
            )
        decrement = float(gradient @ step)
        pieces = at_modes.map(of.moved, theta, theta + step)
        theta = theta + step
        after = _mixture(problem, mixture, expansion, len(free), jitter)
        change = abs(after.fraction / mixture.fraction - 1.0) + abs(
            (problem.var + after.jitter**2).mean() / (problem.var + mixture.jitter**2).mean() - 1.0
        )
        if near and decrement < MAX_DECREMENT and change < MAX_CHANGE:
            settled = pieces.map(of.at_modes, theta, mixture, True)
            expansion, at_solution = (
                settled.sum(of.expansion_of),
                curvatures(problem, settled, theta, mixture),
            )
            return _FoundMode(settled, theta, mixture, free, expansion, at_solution, prior)
        near = decrement < NEAR and change < 0.1
        mixture = after
    raise NotSettledError(
        f"the solution still moves after {MAX_PASSES} passes",
        where="self-calibration",
        do="give a better start (selfcal.initial_distortion), or lower the order",
    )


def newton_step(curvature: Float, gradient: Float, free: Int) -> Float | None:
    """Newton step (D,) of the free parameters; None if their curvature is not positive definite.

    `curvature` (D, D) and `gradient` (D,) are of all parameters; `free` has the indices of the free
    ones. The step of the others is 0.
    """
    H = curvature[np.ix_(free, free)]
    if not (np.diag(H) > 0).all():
        return None
    scale = np.sqrt(np.diag(H))
    try:
        L = np.linalg.cholesky(H / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return None
    out = np.zeros(len(gradient))
    half = np.linalg.solve(L, gradient[free] / scale)
    out[free] = np.linalg.solve(L.T, half) / scale
    return out


def wide_mixture(pieces: MappedPieces[of.StarPiece], theta: Float) -> Mixture:
    """Mixture with large errors, estimated from the scatter at the parameters `theta` (D,)."""
    square = np.concatenate(list(pieces.each(of.squares, theta)))
    # the median of r^2 is 1.386 sigma^2
    return Mixture(START_SCALE * float(np.sqrt(np.median(square) / (2 * np.log(2)))), 0.02)


def _mixture(
    problem: Problem, mixture: Mixture, found: Expansion, n_free: int, jitter: float | None
) -> Mixture:
    """Update the mixture: fraction of false detections by EM, jitter by chi-square."""
    n = len(problem)
    fraction = float(np.clip((n - found.n_members) / n, MIN_FRACTION, 0.9))
    if jitter is not None:
        return replace(mixture, fraction=fraction, jitter=jitter)
    lost = (problem.n_star * problem.n_stars + n_free) / n  # fitted parameters per detection
    dof = max((2.0 - lost) * found.n_members, 1.0)
    s2 = problem.var + mixture.jitter**2
    # the derivative of chi-square with respect to jitter^2 is that of the mean of 1 / s^2
    new = mixture.jitter**2 + (found.chi2 / dof - 1.0) / float(np.mean(1.0 / s2))
    # errors are at most halved per step, since the residuals decrease together with them
    lower = (mixture.jitter**2 - 3 * problem.sigma**2) / 4
    new = min(max(new, lower), 4 * mixture.jitter**2 + float(np.median(s2)))
    floor = (1e-2 * problem.sigma) ** 2
    return Mixture(float(np.sqrt(max(new, floor))), fraction)


def solve_in_gauge(
    problem: Problem,
    theta: Float,
    prior_at: PriorAt,
    *,
    stars: Float | None = None,
    mixture: Mixture | None = None,
    decision: Decision | None = None,
    jitter: float | None = None,
    compute: Compute | None = None,
) -> SelfCalibrationMode:
    """Find the mode of a problem, and determine at the mode which parameters the gauge fixes.

    The search starts at theta (D,) with the free directions of a `decision` from a nearby solution
    or, if it is None, with those at the start.  Parameters that are determined at the mode but were
    fixed at the start are then fitted as well, unless they turn out to be free after all.

    `prior_at` returns information from other sources than the detections, linearised at given
    parameters (D,).  See `solve` for the other arguments and for exceptions.
    """
    prior = prior_at(theta)

    def solved(decision: Decision, begin: _Begun) -> _FoundMode:
        free = np.setdiff1d(np.arange(problem.model.n_params), decision.held)
        return replace(_solved(problem, begin, free, prior, jitter), decision=decision)

    def asked_at(found: _FoundMode) -> Decision:
        alone, informed = found.curvatures
        prior_there = prior_at(found.theta)
        return find_gauge(problem, found.theta, alone, prior_there, known=informed).decision

    with _loaded(problem, stars, compute) as loaded:
        begin = _Begun(loaded, theta, mixture, medians=stars is None)
        try:
            current = decision or _gauge_at_start(problem, loaded, theta, prior).decision
            found = solved(current, begin)
        except (DegenerateError, NotSettledError):
            if decision is None:
                raise
            # these detections determine less than those for which the decision was made
            current = _gauge_at_start(problem, loaded, theta, prior).decision
            found = solved(current, begin)
        at_mode = asked_at(found)
        if at_mode.held.size > current.held.size:
            return solved(at_mode, found.again).mode(problem)
        while at_mode.held.size < current.held.size:
            try:
                freer = solved(at_mode, found.again)
            except (DegenerateError, NotSettledError):
                return found.mode(problem)
            current, at_mode = at_mode, asked_at(freer)
            if at_mode.held.size > current.held.size:
                return found.mode(problem)
            found = freer
        # the same number is fixed; keep the parameters, since their choice is arbitrary
        return replace(found, decision=replace(at_mode, held=current.held)).mode(problem)


def mode_at(
    problem: Problem,
    theta: Float,
    stars: Float,
    mixture: Mixture,
    free: Int,
    prior: Prior,
    decision: Decision | None = None,
    *,
    compute: Compute | None = None,
) -> SelfCalibrationMode:
    """Restore a mode from its parameters; `problem` must be linearised there.

    See `SelfCalibrationMode` for the arguments.
    """
    with of.in_pieces(problem, stars, compute) as loaded:
        pieces = loaded.map(of.at_modes, theta, mixture, True)
        expansion, at_solution = (
            pieces.sum(of.expansion_of),
            curvatures(problem, pieces, theta, mixture),
        )
        return _FoundMode(
            pieces, theta, mixture, free, expansion, at_solution, prior, decision
        ).mode(problem)


def gauge_of(
    problem: Problem, theta: Float, prior: Prior, solution: SelfCalibrationMode | None = None
) -> Gauge:
    """Find the free directions of a problem and their constraints.

    If `solution` is given, its decision on the number of free directions is used.  Otherwise the
    stars are assumed to be at the means of their detections.
    """
    if solution is None:
        with _loaded(problem, None, None) as loaded:
            return _gauge_at_start(problem, loaded, theta, prior)
    alone, informed = solution.curvatures
    return find_gauge(problem, theta, alone, prior, known=informed, decision=solution.decision)


def _gauge_at_start(
    problem: Problem, loaded: MappedPieces[of.StarPiece], theta: Float, prior: Prior
) -> Gauge:
    pieces = loaded.map(of.at_means, theta)
    alone, informed = curvatures(problem, pieces, theta, wide_mixture(pieces, theta))
    return find_gauge(problem, theta, alone, prior, known=informed)


def curvatures(
    problem: Problem, pieces: MappedPieces[of.StarPiece], theta: Float, mixture: Mixture
) -> tuple[Float, Float]:
    """Curvatures (D, D) of the log density, without and with the priors of the stars."""
    informed = pieces.sum(of.expansion, theta, mixture, False, True).curvature
    if not problem.priors.informed.any():
        return informed, informed
    return pieces.sum(of.expansion, theta, mixture, False, False).curvature, informed


# -- expected covariance for planned exposures: the Fisher information at assumed true parameters --


@dataclass(frozen=True, eq=False)
class ExpectedSolution(Solution):
    """Expected solution: its mean is the assumed truth, its covariance the expected one."""

    model: DistortionModel
    mean: Float  # true parameters (D,)
    cov: Float  # covariance (D, D); zero for parameters that the gauge fixes
    gauge: Gauge
    problem: Problem  # detections that would be used, sorted by star

    def draws(self, n: int, rng: Random) -> Float:
        """Draws (n, D) from the Gaussian with this mean and covariance; see `Solution.draws`."""
        generator = generator_of(rng)
        return np.asarray(generator.multivariate_normal(self.mean, self.cov, n, method="eigh"))

    def up_to(self, directions: Float) -> Float:
        """Covariance (D, D) without errors along the directions (D, d); see `gauge_free_matrix`.

        It is meaningful only if `bounded_by` is True for these directions.
        """
        S = gauge_free_matrix(self.model, self.mean, directions)
        return np.asarray(S @ self.cov @ S.T)

    def bounded_by(self, directions: Float) -> bool:
        """True if errors are bounded apart from those along the given directions (D, d)."""
        free, model = self.gauge.open, self.model
        if not free.shape[1]:
            return True
        remainder = gauge_free_matrix(model, self.mean, directions) @ free
        return _largest(remainder, model) <= BOUNDED * _largest(free, model)


def _largest(change: Float, model: DistortionModel) -> float:
    """Largest absolute change of a polynomial coefficient in changes (D, k) of the parameters."""
    return float(np.abs(change[: model.n_polynomial]).max())


def expected_solution(
    model: DistortionModel,
    truth: Float,
    detections: Detections,
    prior: Prior,
    *,
    min_detections: int = 2,
) -> ExpectedSolution:
    """Compute the expected covariance of a self-calibration, marginalised over the stars.

    `truth` (D,) are the true parameters.  `detections` are the noise-free positions of stars, with
    star codes and errors; `prior` is information from other sources; `min_detections` is the
    minimum number of detections of a star.  Raises InputError if no star has enough detections.
    """
    problem, curvature = _expanded(model, truth, detections, min_detections)
    gauge = find_gauge(problem, truth, curvature, prior)
    free = np.setdiff1d(np.arange(model.n_params), gauge.held)
    precision = (curvature + prior.precision)[np.ix_(free, free)]
    scale = 1.0 / np.sqrt(np.diag(precision))
    cov = np.zeros_like(curvature)
    cov[np.ix_(free, free)] = np.linalg.inv(precision * np.outer(scale, scale)) * np.outer(
        scale, scale
    )
    return ExpectedSolution(model, np.array(truth, float), cov, gauge, problem)


def expected_curvature(model: DistortionModel, truth: Float, detections: Detections) -> Float:
    """Minus the Hessian (D, D) of the log-likelihood, with the stars integrated out.

    See `expected_solution` for the arguments.
    """
    return _expanded(model, truth, detections, 2)[1]


def _expanded(
    model: DistortionModel, truth: Float, detections: Detections, min_detections: int
) -> tuple[Problem, Float]:
    """Problem of detections without noise, and the curvature (D, D) of its log-likelihood."""
    # there are no false detections, so the match radius does not matter
    problem = prepare(model, detections, truth, match_radius=1.0, min_detections=min_detections)
    stars = problem.mean_places(truth)
    problem = problem.at(truth, stars)
    return problem, expand(problem, truth, NONE_FALSE, stars)[0].curvature
