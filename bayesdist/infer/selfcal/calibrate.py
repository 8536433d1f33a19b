"""Detections grouped into stars, solved, grouped again: until nothing changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bayesdist.data.detections import Detections
from bayesdist.data.matching.friends import Friends, friends_of_friends
from bayesdist.errors import NotSettledError
from bayesdist.infer.equations.priors import Prior
from bayesdist.infer.selfcal.elimination import Mixture, memberships
from bayesdist.infer.selfcal.gauge import Decision, Gauge
from bayesdist.infer.selfcal.mode import PriorAt, SelfCalibrationMode, gauge_of, solve_in_gauge
from bayesdist.infer.selfcal.pieces import each_of
from bayesdist.infer.selfcal.problem import Problem, StarPriors, prepare
from bayesdist.infer.selfcal.tangent import TangentPlane, places_of
from bayesdist.infer.stars.shards import Compute
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int

MAX_ITERATIONS = 12
SHRINK = 0.5  # smallest factor on the linking length from one iteration to the next
REACH = 12.0  # errors below which the linking length does not shrink
MAX_CHANGED = 1e-3  # fraction of the detections that may change their star,
MIN_CHANGED = 4  # or this number: two at the edge of the linking length, each with its successor
ALIKE = 0.02  # change of the number of detections by which the errors hardly change
GUESS = 0.02  # pixels: error where none is quoted, until it is measured
MIN_IN_BIN = 200  # detections of one magnitude
MAX_BINS = 20
# of a residual's variance: a star with as many parameters as detections absorbs it all
MOST_TAKEN = 0.99

References = Callable[[Problem, Float], StarPriors]


@dataclass(frozen=True, eq=False)
class SelfCalibration:
    """A mode with its gauge and the last grouping of detections."""

    mode: SelfCalibrationMode
    gauge: Gauge
    friends: Friends  # of the last iteration; its `star` is of the detections given
    # with star codes and errors, on one tangent plane where that is requested
    detections: Detections
    iterations: int


@dataclass(frozen=True, eq=False)
class _Iteration:
    """What the next iteration takes from one: no detections."""

    n_detections: int  # of stars
    mixture: Mixture
    decision: Decision | None

    @classmethod
    def of(cls, mode: SelfCalibrationMode) -> _Iteration:
        """What is taken from a mode."""
        return cls(len(mode.problem), mode.mixture, mode.decision)

    def is_near(self, problem: Problem) -> bool:
        """True where errors and free directions are those of the next problem at first.

        Nearly the same detections: new ones may lie far from their positions by the solution.
        Stars with motions start at rest, and then the first errors have to be large.
        """
        same = abs(len(problem) / self.n_detections - 1.0) < ALIKE
        return same and problem.n_star == 2


def self_calibrate(
    model: DistortionModel,
    detections: Detections,
    theta: Float,
    *,
    prior_at: PriorAt | None = None,
    match_radius: float,
    start_radius: float | None = None,
    min_detections: int = 2,
    motion: str = "none",
    parallax_factors: Float | None = None,
    dilation: Float | None = None,
    jitter: float | None = None,
    references: References | None = None,
    plane: TangentPlane | None = None,
    max_iterations: int = MAX_ITERATIONS,
    log: Callable[[str], None] = lambda text: None,
    compute: Compute | None = None,
) -> SelfCalibration:
    """Calibrate a detector from detections alone.

    Parameters
    ----------
    model : DistortionModel
    detections : Detections
        Without errors these are measured, by magnitude where magnitudes are given.
    theta : ndarray, shape (D,)
        A start by which detections of a star lie closer than `start_radius`.
    prior_at : callable, optional
        Prior from other sources than the detections, linearised at parameters (D,).
    match_radius : float
        Linking length of the last iteration, pixels: the largest distance of false detections.
    start_radius : float, optional
        Linking length of the first iteration.
    min_detections : int
        Of a star.
    motion, parallax_factors
        As `prepare`.
    dilation : ndarray, shape (E,), optional
        VAFACTOR of each exposure.
    jitter : float, optional
        Fixed value, pixels.
    references : callable, optional
        Priors of the stars of a problem at parameters (D,).
    plane : TangentPlane, optional
        To which the tangent planes of all exposures are mapped; the sky counts as flat by default.
    max_iterations : int
    log : callable, optional
        Called with a sentence for each iteration.
    compute : Compute, optional
        Where detections are grouped and the passes over them are made; in this process by default.

    Returns
    -------
    SelfCalibration

    Raises
    ------
    InputError, DegenerateError
        As `prepare` and `solve`.
    NotSettledError
        When the groups do not converge.
    """
    theta = np.array(theta, float)
    prior_at = prior_at or Prior.none
    measured = detections.sigma is None
    sigma = np.full(len(detections), GUESS) if detections.sigma is None else detections.sigma
    detections = replace(detections, sigma=sigma)
    radius = max(start_radius or match_radius, match_radius)
    pixel = model.pixel_size(theta)
    few = max(MAX_CHANGED * len(detections), MIN_CHANGED)
    last = False
    before: _Iteration | None = None
    solved: tuple[Friends, SelfCalibrationMode] | None = None
    each = partial(each_of, compute)
    for turn in range(max_iterations + 1):
        flat = detections if plane is None else plane.onto_it(model, detections, theta)
        friends = friends_of_friends(
            places_of(model, flat, theta, dilation), flat.exposure, radius * pixel, each=each
        )
        # references and priors are linearised at the start of a solution: the first one's is far
        if solved is not None and turn > 1 and last and _changed(solved[0], friends) <= few:
            friends, mode = solved
            if measured:  # with the errors of the last iteration
                problem = replace(mode.problem, var=sigma[mode.problem.rows] ** 2)
                mode = solve_in_gauge(
                    problem,
                    theta,
                    prior_at,
                    stars=mode.stars,
                    jitter=jitter,
                    mixture=mode.mixture,
                    decision=mode.decision,
                    compute=compute,
                )
            gauge = gauge_of(mode.problem, mode.theta, prior_at(mode.theta), mode)
            found = replace(flat, star=friends.star)
            return SelfCalibration(mode, gauge, friends, found, turn)
        if turn == max_iterations:
            break
        if solved is not None:
            before = _Iteration.of(solved[1])
            solved = None  # else two problems are held
        found = replace(flat, star=friends.star)
        problem = prepare(
            model,
            found,
            theta,
            match_radius=radius,
            min_detections=min_detections,
            motion=motion,
            parallax_factors=parallax_factors,
            dilation=dilation,
        )
        if references is not None:
            problem = replace(problem, priors=references(problem, theta))
        near = before if before is not None and before.is_near(problem) else None
        mode = solve_in_gauge(
            problem,
            theta,
            prior_at,
            mixture=None if near is None else near.mixture,
            decision=None if near is None else near.decision,
            jitter=jitter,
            compute=compute,
        )
        theta = mode.theta
        log(
            f"iteration {turn + 1}: linking length {radius:.3g} pix, {friends.n_stars} stars, "
            f"{len(problem)} detections, error {mode.error:.3g} pix"
        )
        last = radius <= match_radius
        if measured:
            sigma = _errors_of(detections, mode)
            detections = replace(detections, sigma=sigma)
        scatter, solved = mode.error, (friends, mode)
        radius = max(match_radius, min(radius, max(SHRINK * radius, REACH * scatter)))
        del flat, found, problem, mode  # else two problems are held as the next is made
    if last:
        raise NotSettledError(
            f"stars and solution still change after {max_iterations} iterations",
            where="self-calibration",
            do="give a better start (selfcal.initial_distortion), another match radius or a lower "
            "order",
        )
    raise NotSettledError(
        f"after {max_iterations} iterations the detections still ask for a linking length of "
        f"{radius:.3g} pix, since they scatter by {scatter:.3g} pix",
        where="self-calibration",
        do="give a higher order, a better start (selfcal.initial_distortion) or a larger match "
        "radius",
    )


def _errors_of(detections: Detections, mode: SelfCalibrationMode) -> Float:
    """Errors (N,) in pixels: by magnitude, or one for all."""
    problem = mode.problem
    mag = np.zeros(len(detections)) if detections.mag is None else detections.mag
    middles, sigma = scatter_by_magnitude(
        problem, mode.theta, mode.mixture, mode.stars, mag[problem.rows]
    )
    return np.exp(np.interp(mag, middles, np.log(sigma)))


def _changed(before: Friends, after: Friends) -> int:
    """Number of detections that follow another one in their star than before.

    Codes of stars would not do: they shift where a star comes or goes.
    """
    return int(np.sum(_previous(before.star) != _previous(after.star)))


def _previous(star: Int) -> Int:
    """Index of the previous detection (N,) of the same star, or -1."""
    order = np.argsort(star, kind="stable")
    same = (star[order[1:]] == star[order[:-1]]) & (star[order[1:]] >= 0)
    out = np.full(len(star), -1)
    out[order[1:]] = np.where(same, order[:-1], -1)
    return out


def scatter_by_magnitude(
    problem: Problem, theta: Float, mixture: Mixture, stars: Float, mag: Float
) -> tuple[Float, Float]:
    """Median magnitude of each bin (bins,), and error on one axis there in pixels (bins,).

    A star's position is that of its own detections; the scatter is corrected for this.  `mag` (N,)
    is in the order of the problem.
    """
    w = memberships(problem, theta, mixture, stars)
    precision = w / (problem.var + mixture.jitter**2)
    total = np.bincount(problem.star, precision, minlength=problem.n_stars)[problem.star]
    # on each axis a star takes q / 2 degrees of freedom, shared by weight
    left = 1.0 - np.minimum(precision / np.maximum(total, 1e-300) * problem.n_star / 2, MOST_TAKEN)
    square = problem.squares(theta, stars)
    n_bins = int(np.clip(len(mag) // MIN_IN_BIN, 1, MAX_BINS))
    # equal magnitudes, as in lists without any, leave fewer bins
    edges = np.unique(np.quantile(mag, np.linspace(0, 1, n_bins + 1)))
    n_bins = max(len(edges) - 1, 1)
    bin_of = np.clip(np.searchsorted(edges, mag, side="right") - 1, 0, n_bins - 1)
    number = np.bincount(bin_of, w * left, n_bins)
    variance = np.bincount(bin_of, w * square, n_bins) / (2 * np.maximum(number, 1e-9))
    middles = np.array([np.median(mag[bin_of == k]) for k in range(n_bins)])
    return middles, np.sqrt(variance)
