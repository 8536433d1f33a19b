"""Score tests of self-calibrations: what a model lacks, with the stars eliminated.

The questions are those to matched stars (`diagnose.score.questions`), with the positions of stars
among the parameters that are projected out, and with the scores of a star's detections added up.
What stars take up cannot be tested: directions in which known stars would say much more are left
out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesdist.diagnose.efficient import Directions, EfficientScore
from bayesdist.diagnose.score.exposures import EXPOSURES
from bayesdist.diagnose.score.motions import MOTIONS, SHORTEST, StarResiduals, motion_outcome
from bayesdist.diagnose.score.noise import noise_tests
from bayesdist.diagnose.score.regressors import (
    Functions,
    Regressors,
    functions_for,
    one_of_each,
)
from bayesdist.diagnose.score.result import Family, Outcome, ScoreTest, corrected, outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.diagnose.selfcal.eliminated import (
    Columns,
    EvenStars,
    absorbed_by_stars,
    add_products,
    pieces,
    without_parameters,
)
from bayesdist.diagnose.selfcal.sandwich import star_scores
from bayesdist.diagnose.selfcal.scores import DetectionScores, scores_of_detections, taken_by_stars
from bayesdist.diagnose.significance import hotelling_p
from bayesdist.infer.selfcal.elimination import memberships
from bayesdist.infer.selfcal.mode import SelfCalibrationMode
from bayesdist.infer.selfcal.problem import Problem
from bayesdist.utils.arrays import Bool, Float, Int

STARS_PER_DIRECTION = 2  # below, a covariance of the scores says nothing
MIN_INFORMATION = 0.02  # of a direction, relative to that with known stars
UNDITHERED = 1e-3  # of half a side: offsets that say nothing
EXPOSURES_OF_SELFCAL = replace(
    EXPOSURES, remedy="give selfcal.frames a scale where it has none, or leave out exposures"
)
MOTIONS_OF_SELFCAL = replace(
    MOTIONS,
    remedy="set selfcal.motion to 'proper_motion'",
    present="stars move between the dates of the exposures, and are taken to stand still",
)


@dataclass(frozen=True, eq=False, kw_only=True)
class _AddedColumns(Columns):
    """Functions of the questions on both axes of every chip, and deviations of exposures."""

    added: Functions

    def n_functions(self, chip: int) -> int:
        """Number of functions along one axis."""
        return self.added.n_added

    def values(self, chip: int, rows: Int) -> Float:
        """Values (n, n_functions) of these."""
        return self.added.at(rows)[self.problem.model.n_terms :].T

    def along_axes(self, functions: Int) -> Int:
        """Columns of some functions: those of one chip after the other, along u and v in turn."""
        n, chips = self.n_functions(0), np.arange(len(self.problem.model.chips))
        first = functions - self.problem.model.n_terms
        return np.ravel(2 * n * chips[:, None, None] + first[:, None] + [0, n])

    @property
    def of_exposures(self) -> Int:
        """Columns of the deviations of exposures."""
        n = 0 if self.deviations is None else self.deviations.n_of_exposures
        return 2 * self.n_functions(0) * len(self.problem.model.chips) + np.arange(n)


@dataclass(frozen=True, eq=False)
class _Sums:
    """Information and score of the further columns of a problem."""

    known: Float  # (n, n) information if stars and parameters were known
    left: EfficientScore
    covariance: Float  # (n, n) of the score, by the scores of single stars
    square: Float  # (n, n) mean products of displacements over the detections
    n_stars: int
    unit: str


def selfcal_score_tests(
    solution: SelfCalibrationMode,
    *,
    mag: Float | None = None,
    colour: Float | None = None,
    epoch: Float | None = None,
) -> tuple[ScoreTest, ...]:
    """Targeted tests of a self-calibration for what its model lacks, and for its noise.

    A test is left out where the data cannot be asked.  `mag`, `colour` and `epoch` (N,) are those
    of each detection of its problem, the last in decimal years.
    """
    whole, some, scores = solution.problem, EvenStars.of(solution), scores_of_detections(solution)
    chosen = scores.at(some.rows)
    sample = _sample(solution, some, chosen, mag=mag, colour=colour, epoch=epoch)
    functions = functions_for(sample)
    columns = _AddedColumns(
        some.problem, solution.theta, deviations=some.deviations, added=functions
    )
    sums = _summed(solution, columns, chosen, some.stars)
    found = one_of_each(_regressor_tests(sums, columns, functions))
    which = columns.of_exposures
    every = np.ones(len(which), bool)
    deviating = _tested(sums, EXPOSURES_OF_SELFCAL, which, every, np.eye(len(which)))
    moving = None
    if epoch is not None and whole.n_star == 2 and np.ptp(epoch) > SHORTEST:
        stars = StarResiduals(
            whole.star, epoch, scores.gradient, scores.curvature, whole.priors.precision
        )
        moving = motion_outcome(stars, whole.model.unit, MOTIONS_OF_SELFCAL)
    found += [one for one in (deviating, moving) if one is not None]
    return corrected([*found, *noise_tests(sample)])


def _summed(
    solution: SelfCalibrationMode, columns: _AddedColumns, scores: DetectionScores, stars: Float
) -> _Sums:
    """Sums over the detections of some stars of a solution."""
    p, n, D = columns.problem, columns.sparse.stop, columns.n_params
    known, taken, square = (np.zeros((n, n)) for _ in range(3))
    score, psi = np.zeros(n), []
    for piece in pieces(columns):
        here = piece.scores(scores)
        sums = absorbed_by_stars(columns, piece, here, stars)
        taken += sums.rows.T @ sums.rows
        score -= sums.rows.T @ sums.right
        add_products(known, columns, columns, piece, here.curvature)
        add_products(square, columns, columns, piece, piece.frame.mT @ piece.frame)
        psi.append(star_scores(columns, piece, here.gradient))
    inside = np.ix_(columns.order, columns.order)
    own = np.concatenate(psi)
    N = (known - taken)[inside]
    left = without_parameters(solution, N, score[columns.order] + own.sum(axis=0))
    own = own[:, D:] - own[:, :D] @ left.gain
    # given back what the parameters have taken: a little, and much the same everywhere
    numbers = 2 * float((scores.curvature[:, 0, 0] > 0).sum()) - p.n_star * p.n_stars
    free = max(1 - len(solution.free) / max(numbers, 1.0), 0.1)
    covariance = own.T @ own / free + left.gain.T @ solution.prior.precision @ left.gain
    further = np.ix_(columns.order[D:], columns.order[D:])
    return _Sums(
        known[further],
        left,
        covariance,
        square[further] / len(p),
        p.n_stars,
        p.model.unit,
    )


def _regressor_tests(
    sums: _Sums, columns: _AddedColumns, functions: Functions
) -> Iterator[tuple[Regressors, Outcome]]:
    """Tests of all regressors that there are stars enough for."""
    n_chips = len(columns.problem.model.chips)
    for one in functions.regressors:
        which, own = columns.along_axes(one.every), one.own(n_chips)
        least = max(MIN_INFORMATION, one.least)
        found = _tested(sums, one.family, which, own, one.directions(n_chips), least)
        if found is not None:
            yield one, found


def _tested(
    sums: _Sums,
    family: Family,
    which: Int,
    own: Bool,
    combinations: Float,
    least: float = MIN_INFORMATION,
) -> Outcome | None:
    """Outcome of one test of some columns, as of `Directions`; None where they cannot be asked."""
    known = sums.known[np.ix_(which[own], which[own])]
    one, n = Directions.of(sums.left, which, own, combinations, known, least), sums.n_stars
    q = one.q
    if q == 0 or n < STARS_PER_DIRECTION * q + 2:
        return None
    at = np.ix_(which, which)
    V = one.basis.T @ sums.covariance[at] @ one.basis
    T = float(one.score @ np.linalg.solve(V, one.score))
    square, noise = one.squares(V, sums.square[at])
    return outcome(
        family,
        T,
        q,
        float(n - q),
        hotelling_p(T, q, n),
        square=square,
        noise=noise,
        unit=sums.unit,
    )


def _sample(
    solution: SelfCalibrationMode,
    some: EvenStars,
    scores: DetectionScores,
    **known: Float | None,
) -> ScoredSample:
    """Sample of detections along the axes of the detector, in the unit of u and v.

    Rolls turn the axes of the sky from exposure to exposure, and errors are those of pixels.
    """
    whole, theta, model = solution.problem, solution.theta, solution.problem.model
    p, rows, pixel = some.problem, some.rows, model.pixel_size(theta)
    group = p.groups.index
    J = p.jacobians(theta, slice(0, len(p)))
    g = np.einsum("nab,na->nb", J, scores.gradient) / pixel
    H = np.swapaxes(J, 1, 2) @ scores.curvature @ J / pixel**2
    r = (p.places(theta) - p.star_places(some.stars))[..., None]
    residual = np.linalg.solve(J, r)[:, :, 0] * pixel
    variance = (p.var + solution.mixture.jitter**2) * pixel**2
    taken = taken_by_stars(solution)[rows]
    at_rows = {name: None if one is None else one[rows] for name, one in known.items()}
    frames = [model.frame(theta, e) for e in range(len(model.exposures))]
    position, offset = _pointings(p, theta, frames)
    return ScoredSample(
        model=model,
        X=p.X,
        Y=p.Y,
        score=g.T,
        curvature=np.stack([H[:, 0, 0], H[:, 0, 1], H[:, 1, 1]]),
        residual=np.asarray(residual.T, float),
        variance=np.stack([variance, variance]),
        inlier=memberships(whole, theta, solution.mixture, solution.stars)[rows],
        mag=at_rows["mag"],
        colour=at_rows["colour"],
        epoch=at_rows["epoch"],
        star=p.star,
        chip=p.groups.chip[group],
        exposure=p.groups.exposure[group],
        turn=np.stack([M for M, _ in frames])[p.groups.exposure[group]],
        has_catalogue=False,
        position=position,
        offset=offset,
        leverage=np.stack([taken, taken]),
    )


def _pointings(
    problem: Problem, theta: Float, frames: Sequence[tuple[Float, Float]]
) -> tuple[Float, Float | None]:
    """Positions (2, N), and offsets (2, N) of the exposures, along the axes of the detector.

    Lengths are in half sides of the detector; no offsets where nothing was dithered.
    """
    model = problem.model
    exposure = problem.groups.exposure[problem.groups.index]
    half = model.pixel_size(theta) * max(max(c.size) for c in model.chips) / 2
    on_sky = problem.places(theta) - np.asarray(model.origin)
    offsets, positions = np.zeros((len(problem), 2)), np.empty((len(problem), 2))
    for e in np.unique(exposure):
        here = exposure == e
        M, shift = frames[e]
        back = np.linalg.inv(M).T / half
        offsets[here] = shift @ back
        positions[here] = (on_sky[here] - shift) @ back
    offsets -= offsets.mean(axis=0)  # of a mean the polynomials take care
    return positions.T, None if np.abs(offsets).max() < UNDITHERED else offsets.T
