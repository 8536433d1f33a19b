"""Score tests of self-calibrations: what a model lacks, with the stars eliminated.

The questions are those for matched stars (`diagnose.score.questions`).  The positions of stars are
among the parameters that are projected out, and the scores of a star's detections are summed.
Effects that the stars absorb cannot be tested: directions that would be far better determined if
the stars were known are left out.
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

STARS_PER_DIRECTION = 2  # with fewer, the covariance of the scores is meaningless
MIN_INFORMATION = 0.02  # of a direction, relative to that for known stars
UNDITHERED = 1e-3  # of half a side: smaller pointing offsets do not constrain the pointing test
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
        """Values (n, n_functions) of these functions."""
        return self.added.at(rows)[self.problem.model.n_terms :].T

    def along_axes(self, functions: Int) -> Int:
        """Columns of the given functions, chip by chip, along u and v in turn."""
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
    """Information and score of the columns that are added to the parameters."""

    known: Float  # (n, n) information for known stars and parameters
    left: EfficientScore
    covariance: Float  # (n, n) of the score, from the scores of single stars
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
    """Test a self-calibration for effects that its model lacks, and for unexpected noise.

    Tests that the data do not allow are left out.

    Parameters
    ----------
    solution : SelfCalibrationMode
        The solution to test; its problem has N detections.
    mag, colour : ndarray, shape (N,), optional
        Magnitude and colour of each detection.
    epoch : ndarray, shape (N,), optional
        Date of each detection, in decimal years.

    Returns
    -------
    tuple of ScoreTest
    """
    problem, star_subset, scores = (
        solution.problem,
        EvenStars.of(solution),
        scores_of_detections(solution),
    )
    chosen = scores.at(star_subset.rows)
    sample = _sample(solution, star_subset, chosen, mag=mag, colour=colour, epoch=epoch)
    functions = functions_for(sample)
    columns = _AddedColumns(
        star_subset.problem, solution.theta, deviations=star_subset.deviations, added=functions
    )
    sums = _summed(solution, columns, chosen, star_subset.stars)
    outcomes = one_of_each(_regressor_tests(sums, columns, functions))
    of_exposures = columns.of_exposures
    all_columns = np.ones(len(of_exposures), bool)
    deviating = _tested(
        sums, EXPOSURES_OF_SELFCAL, of_exposures, all_columns, np.eye(len(of_exposures))
    )
    moving = None
    if epoch is not None and problem.n_star == 2 and np.ptp(epoch) > SHORTEST:
        stars = StarResiduals(
            problem.star, epoch, scores.gradient, scores.curvature, problem.priors.precision
        )
        moving = motion_outcome(stars, problem.model.unit, MOTIONS_OF_SELFCAL)
    outcomes += [outcome for outcome in (deviating, moving) if outcome is not None]
    return corrected([*outcomes, *noise_tests(sample)])


def _summed(
    solution: SelfCalibrationMode, columns: _AddedColumns, scores: DetectionScores, stars: Float
) -> _Sums:
    """Sums over the detections of a solution's stars, or of a part of them."""
    p, n, D = columns.problem, columns.sparse.stop, columns.n_params
    uneliminated, absorbed, square = (np.zeros((n, n)) for _ in range(3))
    score, psi = np.zeros(n), []
    for piece in pieces(columns):
        piece_scores = piece.scores(scores)
        sums = absorbed_by_stars(columns, piece, piece_scores, stars)
        absorbed += sums.rows.T @ sums.rows
        score -= sums.rows.T @ sums.right
        add_products(uneliminated, columns, columns, piece, piece_scores.curvature)
        add_products(square, columns, columns, piece, piece.frame.mT @ piece.frame)
        psi.append(star_scores(columns, piece, piece_scores.gradient))
    inside = np.ix_(columns.order, columns.order)
    by_star = np.concatenate(psi)
    N = (uneliminated - absorbed)[inside]
    efficient = without_parameters(solution, N, score[columns.order] + by_star.sum(axis=0))
    by_star = by_star[:, D:] - by_star[:, :D] @ efficient.gain
    # correction for the leverage of the parameters, which is small and nearly uniform
    numbers = 2 * float((scores.curvature[:, 0, 0] > 0).sum()) - p.n_star * p.n_stars
    free = max(1 - len(solution.free) / max(numbers, 1.0), 0.1)
    covariance = (
        by_star.T @ by_star / free + efficient.gain.T @ solution.prior.precision @ efficient.gain
    )
    further = np.ix_(columns.order[D:], columns.order[D:])
    return _Sums(
        uneliminated[further],
        efficient,
        covariance,
        square[further] / len(p),
        p.n_stars,
        p.model.unit,
    )


def _regressor_tests(
    sums: _Sums, columns: _AddedColumns, functions: Functions
) -> Iterator[tuple[Regressors, Outcome]]:
    """Iterate over the tests of all regressors for which there are enough stars."""
    n_chips = len(columns.problem.model.chips)
    for regressors in functions.regressors:
        indices, is_tested = columns.along_axes(regressors.every), regressors.own(n_chips)
        min_information = max(MIN_INFORMATION, regressors.least)
        result = _tested(
            sums,
            regressors.family,
            indices,
            is_tested,
            regressors.directions(n_chips),
            min_information,
        )
        if result is not None:
            yield regressors, result


def _tested(
    sums: _Sums,
    family: Family,
    which: Int,
    own: Bool,
    combinations: Float,
    least: float = MIN_INFORMATION,
) -> Outcome | None:
    """Outcome of one test; None if the data do not determine any direction.

    For `which`, `own`, `combinations` and `least` see `Directions`.
    """
    uneliminated = sums.known[np.ix_(which[own], which[own])]
    directions, n = (
        Directions.of(sums.left, which, own, combinations, uneliminated, least),
        sums.n_stars,
    )
    q = directions.q
    if q == 0 or n < STARS_PER_DIRECTION * q + 2:
        return None
    at = np.ix_(which, which)
    V = directions.basis.T @ sums.covariance[at] @ directions.basis
    T = float(directions.score @ np.linalg.solve(V, directions.score))
    square, noise = directions.squares(V, sums.square[at])
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
    """Sample of detections along the detector axes, in the unit of u and v.

    The detector axes are used because roll angles rotate the sky from exposure to exposure, and
    because errors are given in pixels.
    """
    problem, theta, model = solution.problem, solution.theta, solution.problem.model
    p, rows, pixel = some.problem, some.rows, model.pixel_size(theta)
    group = p.groups.index
    J = p.jacobians(theta, slice(0, len(p)))
    g = np.einsum("nab,na->nb", J, scores.gradient) / pixel
    H = np.swapaxes(J, 1, 2) @ scores.curvature @ J / pixel**2
    r = (p.places(theta) - p.star_places(some.stars))[..., None]
    residual = np.linalg.solve(J, r)[:, :, 0] * pixel
    variance = (p.var + solution.mixture.jitter**2) * pixel**2
    leverage = taken_by_stars(solution)[rows]
    at_rows = {name: None if column is None else column[rows] for name, column in known.items()}
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
        inlier=memberships(problem, theta, solution.mixture, solution.stars)[rows],
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
        leverage=np.stack([leverage, leverage]),
    )


def _pointings(
    problem: Problem, theta: Float, frames: Sequence[tuple[Float, Float]]
) -> tuple[Float, Float | None]:
    """Positions (2, N), and pointing offsets (2, N) of the exposures, along the detector axes.

    Lengths are in half sides of the detector.  The offsets are None without dithers.
    """
    model = problem.model
    exposure = problem.groups.exposure[problem.groups.index]
    half = model.pixel_size(theta) * max(max(c.size) for c in model.chips) / 2
    on_sky = problem.places(theta) - np.asarray(model.origin)
    offsets, positions = np.zeros((len(problem), 2)), np.empty((len(problem), 2))
    for e in np.unique(exposure):
        in_exposure = exposure == e
        M, shift = frames[e]
        back = np.linalg.inv(M).T / half
        offsets[in_exposure] = shift @ back
        positions[in_exposure] = (on_sky[in_exposure] - shift) @ back
    offsets -= offsets.mean(axis=0)  # the polynomials absorb a mean offset
    return positions.T, None if np.abs(offsets).max() < UNDITHERED else offsets.T
