"""The mode of distortion, frames, stars and memberships, with the parameters fixed by convention.

Free directions are found at a solution, and a solution needs the fixed parameters.  With the errors
of a start more seems free than at the mode; where rolls hardly differ the two answers differ.  So
the question is asked again at the mode, and the answer is stored with the solution for all later
uses.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bayesdist.errors import DegenerateError, NotSettledError
from bayesdist.infer.equations.priors import Prior
from bayesdist.infer.selfcal import pieces as of
from bayesdist.infer.selfcal.elimination import Expansion, Mixture
from bayesdist.infer.selfcal.gauge import Decision, Gauge, find_gauge
from bayesdist.infer.selfcal.problem import Problem
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.infer.stars.likelihood import Clip
from bayesdist.infer.stars.shards import Compute, MappedPieces
from bayesdist.utils.arrays import Float, Int

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
    """Mode of a self-calibration."""

    problem: Problem  # linearised there
    theta: Float  # (D,)
    stars: Float  # (S, q)
    mixture: Mixture  # errors by moments; fraction of false detections at its mode
    free: Int  # (F,), parameters that were fitted; the others are fixed by the gauge
    expansion: Expansion
    # (D, D), with EM weights, hence never indefinite: by the detections alone, and with the priors
    # of the stars
    curvatures: tuple[Float, Float]
    prior: Prior
    decision: Decision | None = None  # directions taken as free; None where only `free` was given

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
    compute: Compute | None = None,
) -> SelfCalibrationMode:
    """Mode by Newton's method with the stars eliminated in each pass.

    Errors begin as large as the scatter of the start and shrink with it, so that a start that is
    far off loses no star.  `jitter` is fitted by default; so are `stars` (S, q) and `mixture`,
    which are starting values.  `compute` is where the passes over the detections are made, in this
    process by default.  DegenerateError when the parameters `free` are not determined;
    NotSettledError when it does not converge.
    """
    with _loaded(problem, stars, compute) as loaded:
        begin = _Begun(loaded, theta, mixture, medians=stars is None)
        return _solved(problem, begin, free, prior, jitter).mode(problem)


@dataclass(frozen=True, eq=False)
class _Begun:
    """Start of a search."""

    pieces: MappedPieces
    theta: Float
    mixture: Mixture | None = None  # wide errors by default
    medians: bool = False  # begin with the stars at the medians of their detections


@dataclass(frozen=True, eq=False)
class _Found:
    """End of a search."""

    pieces: MappedPieces
    theta: Float
    mixture: Mixture
    free: Int
    expansion: Expansion
    curvatures: tuple[Float, Float]
    prior: Prior
    decision: Decision | None = None

    @property
    def again(self) -> _Begun:
        """Start of another search from here."""
        return _Begun(self.pieces, self.theta, self.mixture)

    def mode(self, problem: Problem) -> SelfCalibrationMode:
        """The mode, with all detections in this process."""
        whole = of.gathered(problem, self.pieces)
        rest = self.mixture, self.free, self.expansion, self.curvatures, self.prior, self.decision
        return SelfCalibrationMode(whole.problem, self.theta, whole.stars, *rest)


def _loaded(
    problem: Problem, stars: Float | None, compute: Compute | None
) -> AbstractContextManager[MappedPieces]:
    """Context with the pieces of a problem, at given stars (S, q) or at none yet."""
    places = np.zeros((problem.n_stars, problem.n_star)) if stars is None else stars
    return of.in_pieces(problem, places, compute)


def _solved(
    problem: Problem, begin: _Begun, free: Int, prior: Prior, jitter: float | None
) -> _Found:
    theta, near = begin.theta, False
    pieces = begin.pieces.map(of.at_medians if begin.medians else of.at_stars, theta)
    mixture = begin.mixture or wide_mixture(pieces, theta)
    for _ in range(MAX_PASSES):
        at_modes = pieces.map(of.at_modes, theta, mixture, near)
        found = at_modes.sum(of.expansion_of)
        gradient = found.gradient + prior.pull(theta)
        step = newton_step(found.curvature + prior.precision, gradient, free)
        if step is None and near:
            near, pieces = False, at_modes
            continue
        if step is None:
            raise DegenerateError(
                "the detections do not determine the parameters that are free",
                where="self-calibration",
                do="look at the gauge: dither more, add roll angles, or give priors",
            )
        decrement = float(gradient @ step)
        pieces = at_modes.map(of.moved, theta, theta + step)
        theta = theta + step
        after = _mixture(problem, mixture, found, len(free), jitter)
        change = abs(after.fraction / mixture.fraction - 1.0) + abs(
            (problem.var + after.jitter**2).mean() / (problem.var + mixture.jitter**2).mean() - 1.0
        )
        if near and decrement < MAX_DECREMENT and change < MAX_CHANGE:
            pieces = pieces.map(of.at_modes, theta, mixture, True)
            found, both = pieces.sum(of.expansion_of), curvatures(problem, pieces, theta, mixture)
            return _Found(pieces, theta, mixture, free, found, both, prior)
        near = decrement < NEAR and change < 0.1
        mixture = after
    raise NotSettledError(
        f"the solution still moves after {MAX_PASSES} passes",
        where="self-calibration",
        do="give a better start (selfcal.initial_distortion), or lower the order",
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


def wide_mixture(pieces: MappedPieces, theta: Float) -> Mixture:
    """Mixture with errors as large as those of a start."""
    square = np.concatenate(list(pieces.each(of.squares, theta)))
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
    # errors shrink to half at most: as they do, so do the distances of detections from their stars
    least = (mixture.jitter**2 - 3 * problem.sigma**2) / 4
    new = min(max(new, least), 4 * mixture.jitter**2 + float(np.median(s2)))
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
    """Mode of a problem, with the parameters fixed by convention as decided there.

    The search starts at theta (D,), with a `decision` on the free directions that was made near by,
    or with that at the start; `prior_at` gives information from other sources than the detections,
    linearised at parameters (D,).  Where the detections determine more at the mode than
    at the start, that is fitted; where it then turns out to be free after all, it stays fixed.
    Other arguments, DegenerateError and NotSettledError as `solve`.
    """
    prior = prior_at(theta)

    def solved(decision: Decision, begin: _Begun) -> _Found:
        free = np.setdiff1d(np.arange(problem.model.n_params), decision.held)
        return replace(_solved(problem, begin, free, prior, jitter), decision=decision)

    def asked_at(found: _Found) -> Decision:
        alone, known = found.curvatures
        there = prior_at(found.theta)
        return find_gauge(problem, found.theta, alone, there, known=known).decision

    with _loaded(problem, stars, compute) as loaded:
        begin = _Begun(loaded, theta, mixture, medians=stars is None)
        try:
            taken = decision or _gauge_at_start(problem, loaded, theta, prior).decision
            found = solved(taken, begin)
        except (DegenerateError, NotSettledError):
            if decision is None:
                raise
            # the detections determine less than those of the decision
            taken = _gauge_at_start(problem, loaded, theta, prior).decision
            found = solved(taken, begin)
        at_mode = asked_at(found)
        if at_mode.held.size > taken.held.size:
            return solved(at_mode, found.again).mode(problem)
        while at_mode.held.size < taken.held.size:
            try:
                freer = solved(at_mode, found.again)
            except (DegenerateError, NotSettledError):
                return found.mode(problem)
            taken, at_mode = at_mode, asked_at(freer)
            if at_mode.held.size > taken.held.size:
                return found.mode(problem)
            found = freer
        # as many are fixed: the choice of the parameters is arbitrary
        return replace(found, decision=replace(at_mode, held=taken.held)).mode(problem)


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
    """Mode that was found before, from its parameters: `problem` is linearised there."""
    with of.in_pieces(problem, stars, compute) as loaded:
        pieces = loaded.map(of.at_modes, theta, mixture, True)
        found, both = pieces.sum(of.expansion_of), curvatures(problem, pieces, theta, mixture)
        return _Found(pieces, theta, mixture, free, found, both, prior, decision).mode(problem)


def gauge_of(
    problem: Problem, theta: Float, prior: Prior, solution: SelfCalibrationMode | None = None
) -> Gauge:
    """Free directions of a problem, and what fixes them.

    Before there is a solution, stars lie at the means of their detections.  The solution's decision
    on the free directions is used.
    """
    if solution is None:
        with _loaded(problem, None, None) as loaded:
            return _gauge_at_start(problem, loaded, theta, prior)
    alone, known = solution.curvatures
    return find_gauge(problem, theta, alone, prior, known=known, decision=solution.decision)


def _gauge_at_start(problem: Problem, loaded: MappedPieces, theta: Float, prior: Prior) -> Gauge:
    pieces = loaded.map(of.at_means, theta)
    alone, known = curvatures(problem, pieces, theta, wide_mixture(pieces, theta))
    return find_gauge(problem, theta, alone, prior, known=known)


def curvatures(
    problem: Problem, pieces: MappedPieces, theta: Float, mixture: Mixture
) -> tuple[Float, Float]:
    """Curvature (D, D) by the detections alone, and with the priors of the stars."""
    known = pieces.sum(of.expansion, theta, mixture, False, True).curvature
    if not problem.priors.informed.any():
        return known, known
    return pieces.sum(of.expansion, theta, mixture, False, False).curvature, known
