"""Score tests of self-calibrations: what a model lacks, with the stars eliminated.

As for matched stars (`diagnose.score.regressor_tests`), with the positions of stars among the
parameters that are projected out, and with the scores of a star's detections added up.  What stars
take up cannot be tested: directions in which known stars would say much more are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.diagnose.correlated.deviations import deviation_columns
from bayesdist.diagnose.score.directions import independent_directions, squares_of
from bayesdist.diagnose.score.families import FAMILIES, Family, order_family
from bayesdist.diagnose.score.motions import SHORTEST, StarResiduals, motion_outcome
from bayesdist.diagnose.score.noise import noise_tests
from bayesdist.diagnose.score.result import Outcome, ScoreTest, corrected, outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.diagnose.selfcal.columns import AddedColumns, pointing_terms
from bayesdist.diagnose.selfcal.correlated import MAX_EXPOSURES
from bayesdist.diagnose.selfcal.eliminated import (
    absorbed_by_stars,
    add_products,
    even_stars,
    pieces,
    without_parameters,
)
from bayesdist.diagnose.selfcal.leverage import taken_by_stars
from bayesdist.diagnose.selfcal.sandwich import star_scores
from bayesdist.diagnose.selfcal.scores import scores_of_detections
from bayesdist.diagnose.significance import hotelling_p
from bayesdist.infer.selfcal.elimination import memberships
from bayesdist.infer.selfcal.mode import SelfCalibrationMode

__all__ = ["selfcal_score_tests"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

MAX_DETECTIONS = 60_000  # that are looked at
STARS_PER_DIRECTION = 2  # below, a covariance of the scores says nothing
MIN_INFORMATION = 0.02  # of a direction, relative to that with known stars
REMEDIES = {
    "magnitude": "cut the faint stars, or correct the charge-transfer efficiency",
    "exposures": "give selfcal.frames a scale where it has none, or leave out exposures",
}
OUTSIDE = 0.5  # per cent of the magnitudes at either end that are moved to the others


@dataclass(frozen=True, eq=False)
class _Sums:
    """Information and score of the further columns of a problem."""

    known: Float  # (n, n) information if stars and parameters were known
    # information, score (n, n) or (n,): with both eliminated
    information: Float
    score: Float
    covariance: Float  # (n, n) of the score, by the scores of single stars
    square: Float  # (n, n) mean products of displacements over the detections
    n_stars: int
    unit: str


def selfcal_score_tests(
    solution: SelfCalibrationMode, *, mag: Float | None = None, epoch: Float | None = None
) -> tuple[ScoreTest, ...]:
    """Targeted tests of a self-calibration for what its model lacks, and for its noise.

    A test is left out where the data cannot be asked.  `mag` and `epoch` (N,) are those of each
    detection of its problem, the latter in decimal years.
    """
    whole = solution.problem
    some = even_stars(whole, MAX_DETECTIONS)
    rows = np.isin(whole.star, some)
    problem, model = whole.of_stars(some), whole.model
    varied = None
    if mag is not None and np.ptp(mag) > 0:
        low, high = np.percentile(mag, [OUTSIDE, 100 - OUTSIDE])
        inside = np.clip(mag, low, high)[rows]
        varied = inside - inside.mean()
    counts = np.bincount(problem.groups.index, minlength=len(problem.groups)).astype(float)
    deviations = deviation_columns(
        model, solution.theta, problem.groups, counts, most=MAX_EXPOSURES
    )
    pointed = pointing_terms(problem, solution.theta)
    columns = AddedColumns(problem, solution.theta, {}, deviations, varied, pointed)
    sums = _summed(solution, columns, rows, solution.stars[some])
    found = [_tested(sums, name, which, model.order) for name, which in columns.families()]
    if epoch is not None and whole.n_star == 2 and np.ptp(epoch) > SHORTEST:
        found.append(_motions(solution, epoch))
    found += noise_tests(_noise_sample(solution, some, rows, mag))
    return corrected([one for one in found if one is not None])


def _summed(
    solution: SelfCalibrationMode, columns: AddedColumns, rows: NDArray[np.bool_], stars: Float
) -> _Sums:
    """Sums over some of the detections of a solution."""
    p, scores = columns.problem, scores_of_detections(solution).at(rows)
    n, D = columns.sparse.stop, columns.n_params
    known, taken, square = (np.zeros((n, n)) for _ in range(3))
    score, psi = np.zeros(n), []
    unit = np.broadcast_to(np.eye(2), (len(p), 2, 2))
    for piece in pieces(columns):
        here = scores.at(piece.rows)
        sums = absorbed_by_stars(columns, piece, here, stars)
        taken += sums.rows.T @ sums.rows
        score -= sums.rows.T @ sums.right
        add_products(known, columns, columns, piece, here.curvature)
        add_products(square, columns, columns, piece, unit[piece.rows])
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
        left.information,
        left.score,
        covariance,
        square[further] / len(p),
        p.n_stars,
        p.model.unit,
    )


def _tested(sums: _Sums, name: str, which: Int, order: int) -> Outcome | None:
    """Outcome of one test; None where the data cannot be asked."""
    at = np.ix_(which, which)
    N = independent_directions(sums.known[at], sums.information[at], MIN_INFORMATION)
    q, n = N.shape[1], sums.n_stars
    if q == 0 or n < STARS_PER_DIRECTION * q + 2:
        return None
    U, S, V = N.T @ sums.score[which], N.T @ sums.information[at] @ N, N.T @ sums.covariance[at] @ N
    T = float(U @ np.linalg.solve(V, U))
    square, noise = squares_of(U, S, V, N.T @ sums.square[at] @ N)
    return outcome(
        _family(name, order),
        T,
        q,
        float(n - q),
        hotelling_p(T, q, n),
        square=square,
        noise=noise,
        unit=sums.unit,
    )


def _family(name: str, order: int) -> Family:
    """Words of a test, with what can be done in a self-calibration."""
    if name.startswith("order "):
        return order_family(int(name.removeprefix("order ")), order)
    return replace(FAMILIES[name], remedy=REMEDIES.get(name, FAMILIES[name].remedy))


def _motions(solution: SelfCalibrationMode, epoch: Float) -> Outcome | None:
    """Test for stars that move."""
    p, scores = solution.problem, scores_of_detections(solution)
    family = replace(
        FAMILIES["motions"],
        remedy="set selfcal.motion to 'proper_motion'",
        present="stars move between the dates of the exposures, and are taken to stand still",
    )
    residuals = StarResiduals(p.star, epoch, scores.gradient, scores.curvature, p.priors.precision)
    return motion_outcome(residuals, p.model.unit, family)


def _noise_sample(
    solution: SelfCalibrationMode, some: Int, rows: NDArray[np.bool_], mag: Float | None
) -> ScoredSample:
    """Sample of detections along the axes of the detector, in the unit of u and v.

    Rolls turn the axes of the sky from exposure to exposure, and errors are those of pixels.
    """
    whole, theta, model = solution.problem, solution.theta, solution.problem.model
    p, pixel = whole.of_stars(some), model.pixel_size(theta)
    group = p.groups.index
    scores = scores_of_detections(solution).at(rows)
    J = p.jacobians(theta, slice(0, len(p)))
    g = np.einsum("nab,na->nb", J, scores.gradient) / pixel
    H = np.swapaxes(J, 1, 2) @ scores.curvature @ J / pixel**2
    r = (p.places(theta) - p.star_places(solution.stars[some]))[..., None]
    residual = np.linalg.solve(J, r)[:, :, 0] * pixel
    variance = (p.var + solution.mixture.jitter**2) * pixel**2
    taken = taken_by_stars(solution)[rows]
    return ScoredSample(
        model=model,
        X=p.X,
        Y=p.Y,
        score=g.T,
        curvature=np.stack([H[:, 0, 0], H[:, 0, 1], H[:, 1, 1]]),
        residual=np.asarray(residual.T, float),
        variance=np.stack([variance, variance]),
        inlier=memberships(whole, theta, solution.mixture, solution.stars)[rows],
        mag=None if mag is None else mag[rows],
        colour=None,
        epoch=None,
        star=p.star,
        chip=p.groups.chip[group],
        exposure=p.groups.exposure[group],
        leverage=np.stack([taken, taken]),
    )
