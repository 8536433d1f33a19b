"""The mode of distortion, frames, stars and memberships, with the parameters fixed by convention.

Free directions are found at a solution, and a solution needs the fixed parameters.  With the errors
of a start more seems free than at the mode; where rolls hardly differ the two answers differ.  So
the question is asked again at the mode, and the answer is stored with the solution for all later
uses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import DegenerateError, NotSettledError
from bayesdist.infer.equations.priors import Prior
from bayesdist.infer.linear import LinearFit
from bayesdist.infer.selfcal.elimination import Expansion, Mixture, expand
from bayesdist.infer.selfcal.gauge import Decision, Gauge, find_gauge
from bayesdist.infer.selfcal.problem import Problem, StarPriors
from bayesdist.infer.stars.likelihood import Clip

__all__ = ["PriorAt", "SelfCalibrationMode", "curvatures", "gauge_of", "solve", "solve_in_gauge"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]
PriorAt = Callable[[Float], Prior]  # linearised at parameters (D,)

MAX_PASSES = 80
MAX_DECREMENT = 1e-5  # decrement (expected gain in log density) at which the mode is found
NEAR = 1.0  # decrement below which the curvature of the mixture is used
MAX_CHANGE = 1e-4  # relative change of errors and of the fraction of false detections
MIN_FRACTION = 1e-5
# times the robust scatter: errors begin as large as this, so that no star is lost
START_SCALE = 3.0
REJECTED = 25.0  # chi-square of both axes beyond which a detection counts as rejected


@dataclass(frozen=True, eq=False)
class SelfCalibrationMode:
    """Mode of a self-calibration.

    Parameters
    ----------
    problem : Problem
        Linearised there.
    theta : ndarray, shape (D,)
    stars : ndarray, shape (S, q)
    mixture : Mixture
        Errors by moments; fraction of false detections at its mode.
    free : ndarray of int, shape (F,)
        Parameters that were fitted; the others are fixed by the gauge.
    expansion : Expansion
    prior : Prior
    decision : Decision, optional
        Directions taken as free; None where only `free` was given.
    """

    problem: Problem
    theta: Float
    stars: Float
    mixture: Mixture
    free: Int
    expansion: Expansion
    prior: Prior
    decision: Decision | None = None

    @property
    def precision(self) -> Float:
        """Curvature (F, F) of the free parameters, with information from other sources."""
        total = self.expansion.curvature + self.prior.precision
        return np.asarray(total[np.ix_(self.free, self.free)])

    @property
    def cov(self) -> Float:
        """Covariance (D, D); zero for fixed parameters."""
        precision = self.precision
        scale = 1.0 / np.sqrt(np.diag(precision))
        # a square of roots stays positive where a nearly free direction dwarfs all others
        factor = np.linalg.cholesky(precision * np.outer(scale, scale))
        root = np.linalg.inv(factor).T * scale[:, None]
        out = np.zeros((len(self.theta),) * 2)
        out[np.ix_(self.free, self.free)] = root @ root.T
        return out

    @property
    def distortion_information(self) -> Float:
        """Information (d, d) of the detections about polynomials and drift; zero for fixed ones.

        Stars and frames are eliminated.
        """
        n, H = self.problem.model.n_distortion, self.expansion.curvature
        own, frames = self.free[self.free < n], self.free[self.free >= n]
        left = H[np.ix_(own, own)]
        if frames.size:
            local, cross = H[np.ix_(frames, frames)], H[np.ix_(own, frames)]
            scale = 1.0 / np.sqrt(np.diag(local))
            half = cross * scale
            left = left - half @ np.linalg.solve(local * np.outer(scale, scale), half.T)
        out = np.zeros((n, n))
        out[np.ix_(own, own)] = (left + left.T) / 2
        return out

    @property
    def error(self) -> float:
        """Typical error of a detection on one axis, pixels."""
        return float(np.sqrt(np.median(self.problem.var) + self.mixture.jitter**2))

    @cached_property
    def solution(self) -> LinearFit:
        """Solution of distortion and frames, with the statistics of the detections' residuals.

        The covariance is that of the curvature, with the stars eliminated.
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


def solve(
    problem: Problem,
    theta: Float,
    free: Int,
    prior: Prior,
    *,
    stars: Float | None = None,
    mixture: Mixture | None = None,
    jitter: float | None = None,
) -> SelfCalibrationMode:
    """Mode by Newton's method with the stars eliminated in each pass.

    Errors begin as large as the scatter of the start and shrink with it, so that a start that is
    far off loses no star.  `jitter` is fitted by default; so are `stars` (S, q) and `mixture`,
    which are starting values.  DegenerateError when the parameters `free` are not determined;
    NotSettledError when it does not converge.
    """
    stars = problem.median_places(theta) if stars is None else stars
    problem = problem.at(theta, stars)
    mixture = mixture or wide_mixture(problem, theta, stars)
    near = False
    for _ in range(MAX_PASSES):
        found = expand(problem, theta, mixture, stars, observed=near)
        stars = problem.found_again(theta, found.stars)
        gradient = found.gradient + prior.pull(theta)
        step = newton_step(found.curvature + prior.precision, gradient, free)
        if step is None and near:
            near = False
            continue
        if step is None:
            raise DegenerateError(
                "the detections do not determine the parameters that are free",
                where="self-calibration",
                do="look at the gauge: dither more, add roll angles, or give priors",
            )
        decrement = float(gradient @ step)
        before = problem.middles(theta)
        theta = theta + step
        stars = stars.copy()
        stars[:, :2] += problem.middles(theta) - before
        problem = problem.at(theta, stars)
        after = _mixture(problem, mixture, found, len(free), jitter)
        change = abs(after.fraction / mixture.fraction - 1.0) + abs(
            (problem.var + after.jitter**2).mean() / (problem.var + mixture.jitter**2).mean() - 1.0
        )
        if near and decrement < MAX_DECREMENT and change < MAX_CHANGE:
            found = expand(problem, theta, mixture, stars)
            stars = problem.found_again(theta, found.stars)
            return SelfCalibrationMode(problem, theta, stars, mixture, free, found, prior)
        near = decrement < NEAR and change < 0.1
        mixture = after
    raise NotSettledError(
        f"the solution still moves after {MAX_PASSES} passes",
        where="self-calibration",
        do="give a better start, or lower the order",
    )


def newton_step(curvature: Float, gradient: Float, free: Int) -> Float | None:
    """Step (D,) of the free parameters; None where the curvature is not positive."""
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


def wide_mixture(problem: Problem, theta: Float, stars: Float) -> Mixture:
    """Mixture with errors as large as those of a start."""
    square = problem.squares(theta, stars)
    # the median of r^2 is 1.386 sigma^2
    return Mixture(START_SCALE * float(np.sqrt(np.median(square) / (2 * np.log(2)))), 0.02)


def _mixture(
    problem: Problem, mixture: Mixture, found: Expansion, n_free: int, jitter: float | None
) -> Mixture:
    """Mixture with the fraction of false detections by EM, and the jitter by chi-square."""
    n = len(problem)
    fraction = float(np.clip((n - found.n_members) / n, MIN_FRACTION, 0.9))
    if jitter is not None:
        return replace(mixture, fraction=fraction, jitter=jitter)
    lost = (problem.n_star * problem.n_stars + n_free) / n  # of each detection's two numbers
    dof = max((2.0 - lost) * found.n_members, 1.0)
    s2 = problem.var + mixture.jitter**2
    # chi-square changes by jitter^2 as the mean of 1 / s^2 does
    new = mixture.jitter**2 + (found.chi2 / dof - 1.0) / float(np.mean(1.0 / s2))
    new = min(max(new, mixture.jitter**2 / 4), 4 * mixture.jitter**2 + float(np.median(s2)))
    floor = (1e-2 * problem.sigma) ** 2
    return Mixture(float(np.sqrt(max(new, floor))), fraction)


def solve_in_gauge(
    problem: Problem,
    theta: Float,
    prior_at: PriorAt,
    *,
    stars: Float | None = None,
    mixture: Mixture | None = None,
    jitter: float | None = None,
) -> SelfCalibrationMode:
    """Mode of a problem, with the parameters fixed by convention as decided there.

    The search starts at theta (D,); `prior_at` gives information from other sources than the
    detections, linearised at parameters (D,).  Where the detections determine more at the mode than
    at the start, that is fitted; where it then turns out to be free after all, it stays fixed.
    DegenerateError and NotSettledError as `solve`.
    """
    prior = prior_at(theta)

    def solved(gauge: Gauge, begin: SelfCalibrationMode | None) -> SelfCalibrationMode:
        free = np.setdiff1d(np.arange(problem.model.n_params), gauge.held)
        found = solve(
            problem,
            theta if begin is None else begin.theta,
            free,
            prior,
            stars=stars if begin is None else begin.stars,
            mixture=mixture if begin is None else begin.mixture,
            jitter=jitter,
        )
        return replace(found, decision=gauge.decision)

    def asked_at(solution: SelfCalibrationMode) -> Gauge:
        bare = replace(solution, decision=None)
        return gauge_of(bare.problem, bare.theta, prior_at(bare.theta), bare)

    gauge = gauge_of(problem, theta, prior)
    solution = solved(gauge, None)
    at_mode = asked_at(solution)
    if at_mode.held.size > gauge.held.size:
        return solved(at_mode, solution)
    while at_mode.held.size < gauge.held.size:
        try:
            freer = solved(at_mode, solution)
        except (DegenerateError, NotSettledError):
            return solution
        gauge, at_mode = at_mode, asked_at(freer)
        if at_mode.held.size > gauge.held.size:
            return solution
        solution = freer
    # as many are fixed: the choice of the parameters is arbitrary
    return replace(solution, decision=replace(at_mode.decision, held=gauge.held))


def gauge_of(
    problem: Problem, theta: Float, prior: Prior, solution: SelfCalibrationMode | None = None
) -> Gauge:
    """Free directions of a problem, and what fixes them.

    Before there is a solution, stars lie at the means of their detections.  The solution's decision
    on the free directions is used.
    """
    decision = None if solution is None else solution.decision
    if solution is None:
        stars = problem.mean_places(theta)
        problem = problem.at(theta, stars)
        mixture = wide_mixture(problem, theta, stars)
    else:
        stars, mixture = solution.stars, solution.mixture
    alone, known = curvatures(problem, theta, mixture, stars)
    return find_gauge(problem, theta, alone, prior, known=known, decision=decision)


def curvatures(
    problem: Problem, theta: Float, mixture: Mixture, stars: Float
) -> tuple[Float, Float]:
    """Curvature (D, D) by the detections alone, and with the priors of the stars."""
    known = expand(problem, theta, mixture, stars, observed=False).curvature
    if not problem.priors.informed.any():
        return known, known
    bare = replace(problem, priors=StarPriors.none(problem.n_stars, problem.n_star))
    return expand(bare, theta, mixture, stars, observed=False).curvature, known
