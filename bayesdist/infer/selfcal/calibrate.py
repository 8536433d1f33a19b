"""Detections grouped into stars, solved, grouped again: until nothing changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.detections import Detections
from bayesdist.data.matching.friends import Friends, friends_of_friends
from bayesdist.errors import NotSettledError
from bayesdist.infer.selfcal.errors import scatter_by_magnitude
from bayesdist.infer.selfcal.gauge import Gauge
from bayesdist.infer.selfcal.information import Information
from bayesdist.infer.selfcal.normal import Mixture
from bayesdist.infer.selfcal.problem import Problem, StarPriors, prepared
from bayesdist.infer.selfcal.settled import Knowledge, gauge_of, solved_in_gauge
from bayesdist.infer.selfcal.solve import Solution
from bayesdist.infer.selfcal.tangent import TangentPlane, places_of
from bayesdist.model import DistortionModel

__all__ = ["SelfCalibration", "self_calibrate"]

Float = NDArray[np.float64]

MOST_ROUNDS = 12
SHRINK = 0.5  # smallest factor on the linking length from round to round
REACH = 12.0  # errors below which the linking length does not shrink
SETTLED = 1e-3  # fraction of the detections that may change their star,
FEWEST = 4  # or this number: two at the edge of the linking length, each with its successor
ALIKE = 0.02  # change of the number of detections by which the errors hardly change
GUESS = 0.02  # pixels: error where none is quoted, until it is measured

References = Callable[[Problem, Float], StarPriors]


@dataclass(frozen=True, eq=False)
class SelfCalibration:
    """A solution with its gauge and the last grouping of detections.

    Parameters
    ----------
    solution : Solution
    gauge : Gauge
    friends : Friends
        Of the last round; its `star` is of the detections given.
    detections : Detections
        With star codes and errors, on one tangent plane where that is requested.
    magnitude_errors : tuple of ndarray, or None
        Magnitudes and errors in pixels, where these were measured.
    rounds : int
    """

    solution: Solution
    gauge: Gauge
    friends: Friends
    detections: Detections
    magnitude_errors: tuple[Float, Float] | None
    rounds: int


def self_calibrate(
    model: DistortionModel,
    detections: Detections,
    theta: Float,
    *,
    knowledge: Knowledge | None = None,
    match_radius: float,
    start_radius: float | None = None,
    least: int = 2,
    motion: str = "none",
    parallax_factors: Float | None = None,
    dilation: Float | None = None,
    jitter: float | None = None,
    references: References | None = None,
    plane: TangentPlane | None = None,
    rounds: int = MOST_ROUNDS,
    log: Callable[[str], None] = lambda text: None,
) -> SelfCalibration:
    """Calibrate a detector from detections alone.

    Parameters
    ----------
    model : DistortionModel
    detections : Detections
        Without errors these are measured, by magnitude where magnitudes are given.
    theta : ndarray, shape (D,)
        A start by which detections of a star lie closer than `start_radius`.
    knowledge : callable, optional
        Information from other sources than the detections, linearised at parameters (D,).
    match_radius : float
        Linking length of the last round, pixels: the largest distance of false detections.
    start_radius : float, optional
        Linking length of the first round.
    least : int
        Fewest detections of a star.
    motion, parallax_factors
        As `prepared`.
    dilation : ndarray, shape (E,), optional
        VAFACTOR of each exposure.
    jitter : float, optional
        Fixed value, pixels.
    references : callable, optional
        Priors of the stars of a problem at parameters (D,).
    plane : TangentPlane, optional
        To which the tangent planes of all exposures are mapped; the sky counts as flat by default.
    rounds : int
        Largest number of rounds.
    log : callable, optional
        Called with a sentence for each round.

    Returns
    -------
    SelfCalibration

    Raises
    ------
    InputError, DegenerateError
        As `prepared` and `solve`.
    NotSettledError
        When the groups do not converge.
    """
    theta = np.array(theta, float)
    knowledge = knowledge or Information.none
    measured = detections.sigma is None
    if measured:
        detections = replace(detections, sigma=np.full(len(detections), GUESS))
    radius = max(start_radius or match_radius, match_radius)
    pixel = model.pixel_size(theta)
    errors: tuple[Float, Float] | None = None
    before: Friends | None = None
    solution: Solution | None = None
    for turn in range(rounds):
        flat = detections if plane is None else plane.onto_it(model, detections, theta)
        friends = friends_of_friends(
            places_of(model, flat, theta, dilation), flat.exposure, radius * pixel
        )
        found = replace(flat, star=friends.star)
        problem = prepared(
            model, found, theta, match_radius=radius, least=least, motion=motion,
            parallax_factors=parallax_factors, dilation=dilation,
        )  # fmt: skip
        if references is not None:
            problem = replace(problem, priors=references(problem, theta))
        known = None if solution is None else _still(problem, solution)
        solution = solved_in_gauge(problem, theta, knowledge, jitter=jitter, mixture=known)
        theta = solution.theta
        log(
            f"round {turn + 1}: linking length {radius:.3g} pix, {friends.n_stars} stars, "
            f"{len(problem)} detections, error "
            f"{np.sqrt(np.median(solution.problem.var) + solution.mixture.jitter**2):.3g} pix"
        )
        last = radius <= match_radius
        if measured:
            detections, errors = _with_errors(detections, solution)
        few = max(SETTLED * len(detections), FEWEST)
        if last and before is not None and _changed(before, friends) <= few:
            if measured:  # with the errors of this round
                sigma = detections.sigma
                assert sigma is not None
                problem = solution.problem.with_sigma(sigma[solution.problem.rows])
                solution = solved_in_gauge(
                    problem, theta, knowledge, stars=solution.stars, jitter=jitter,
                    mixture=solution.mixture,
                )  # fmt: skip
            gauge = gauge_of(solution.problem, solution.theta, knowledge(solution.theta), solution)
            found = replace(found, sigma=detections.sigma)
            return SelfCalibration(solution, gauge, friends, found, errors, turn + 1)
        before = friends
        scatter = float(np.sqrt(np.median(solution.problem.var) + solution.mixture.jitter**2))
        radius = max(match_radius, min(radius, max(SHRINK * radius, REACH * scatter)))
    if last:
        raise NotSettledError(
            f"stars and solution still change after {rounds} rounds",
            where="self-calibration",
            do="give a better start, another match radius, or a lower order",
        )
    raise NotSettledError(
        f"after {rounds} rounds the detections still ask for a linking length of {radius:.3g} pix, "
        f"since they scatter by {scatter:.3g} pix",
        where="self-calibration",
        do="give a higher order, a better start, or a larger match radius",
    )


def _still(problem: Problem, solution: Solution) -> Mixture | None:
    """Mixture of the last round, if this round starts with nearly the same detections.

    New ones may lie far from their positions by the solution, and so do stars with motions, which
    start at rest: then the first errors have to be large.
    """
    same = abs(len(problem) / len(solution.problem) - 1.0) < ALIKE
    return solution.mixture if same and problem.n_star == 2 else None


def _with_errors(
    detections: Detections, solution: Solution
) -> tuple[Detections, tuple[Float, Float]]:
    """Detections with errors by magnitude, or one for all."""
    problem = solution.problem
    mag = np.zeros(len(detections)) if detections.mag is None else detections.mag
    middles, sigma = scatter_by_magnitude(
        problem, solution.theta, solution.mixture, solution.stars, mag[problem.rows]
    )
    of_each = np.exp(np.interp(mag, middles, np.log(sigma)))
    return replace(detections, sigma=of_each), (middles, sigma)


def _changed(before: Friends, after: Friends) -> int:
    """Number of detections that follow another one in their star than before.

    Codes of stars would not do: they shift where a star comes or goes.
    """
    return int(np.sum(_previous(before.star) != _previous(after.star)))


def _previous(star: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index of the previous detection (N,) of the same star, or -1."""
    order = np.argsort(star, kind="stable")
    same = (star[order[1:]] == star[order[:-1]]) & (star[order[1:]] >= 0)
    out = np.full(len(star), -1)
    out[order[1:]] = np.where(same, order[:-1], -1)
    return out
