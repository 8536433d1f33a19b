"""Residuals that correlate with the proper motions of the stars, because the epochs are wrong.

    r_i = -mu_i dt        mu_i the proper motion of star i, dt the same for all

The part of both sides that the model can absorb, a polynomial of the model's order on each chip of
each exposure, is subtracted.  A scan of dt finds the smallest median residual, which is robust
against false matches and fast stars.  A reweighted fit that starts there gives dt and, from the
scores of single stars, its error.  Errors s_i of the motions would bias dt towards 0.  Only stars
with well known motions are therefore used, and for these

    dt = -sum w r mu / sum w (mu^2 - s^2)
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bayesdist.data.magnitude_errors import MAD_TO_SIGMA
from bayesdist.data.matches import Matches
from bayesdist.diagnose.score.sample import ScoredSample, scored_sample
from bayesdist.diagnose.statistics import squares_over
from bayesdist.infer.solution.solution import Solution
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.checks import EPOCH_SHIFT

SAMPLE = 20_000  # largest number of detections that are used
MIN_STARS = 30  # stars with motions
FARTHEST = 60.0  # largest shift in the scan, years
STEPS = 481  # number of steps in the scan, a quarter of a year each
MAX_ITERATIONS = 30
# largest error of a motion, relative to the scatter of motions; larger errors are often quoted too
# small
WELL_KNOWN = 0.2
BIWEIGHT = 4.685  # robust standard deviations beyond which a star has no weight (Tukey)


@dataclass(frozen=True)
class EpochShift:
    """An error of the epochs that explains residuals."""

    years: float  # from the epoch of the reference positions to that of the exposures
    sigma: float  # its standard error
    # before, after: robust scatter of the residuals per axis without and with the shift, in `unit`,
    # for stars with well known motions
    before: float
    after: float
    unit: str  # of u and v
    significant: bool  # True if it exceeds five standard errors and reduces the scatter

    @property
    def sentence(self) -> str:
        """Interpretation of the shift, and remedy."""
        when = "after" if self.years > 0 else "before"
        return (
            f"the residuals go with the proper motions of the stars: the exposures were taken "
            f"{abs(self.years):.2f} +- {self.sigma:.2f} years {when} the epoch that the reference "
            f"positions have (the scatter falls from {self.before:.2g} to {self.after:.2g} "
            f"{self.unit}); check the epochs of the exposures (data.epoch or a column) and of the "
            "catalogue (column ref_epoch, or data.catalogue_epoch)"
        )


def epoch_shift(table: Matches, solution: Solution) -> EpochShift | None:
    """Error of the epochs according to the residuals.

    Every k-th row is used if the table has more than `SAMPLE` rows.  Returns None without proper
    motions, or with too few.
    """
    if table.pm_u is None or table.pm_v is None:
        return None
    sample = scored_sample(table.sample(SAMPLE), solution)
    motion = sample.motion
    if motion is None:
        return None
    moving = np.any(motion != 0, axis=0)  # zero on both axes means that no motion was measured
    if moving.sum() < MIN_STARS:
        return None
    error = np.zeros_like(motion) if sample.motion_sigma is None else sample.motion_sigma
    well_known = moving & (error < WELL_KNOWN * _scatter(motion[:, moving])).all(axis=0)
    if well_known.sum() < MIN_STARS:
        return None
    residual, P = _left_over(sample, well_known * sample.inlier, sample.residual, motion)
    grid = np.linspace(-FARTHEST, FARTHEST, STEPS)
    known_residual, moved = residual[:, well_known], P[:, well_known]
    sizes = [float(np.median(np.abs(known_residual + dt * moved))) for dt in grid]
    dt = float(grid[int(np.argmin(sizes))])
    before = _scatter(residual[:, well_known])
    weight = information = np.zeros(0)
    for _ in range(MAX_ITERATIONS):
        scale = np.sqrt(_scatter((residual + dt * P)[:, well_known]) ** 2 + (dt * error) ** 2)
        if not (scale > 0).all():
            return None
        z2 = (((residual + dt * P) / scale) ** 2).sum(axis=0) / (2 * BIWEIGHT**2)
        single = np.where(well_known & (z2 < 1), (1 - np.minimum(z2, 1)) ** 2, 0.0)
        weight = single / scale**2
        residual, P = _left_over(sample, single, sample.residual, motion)
        information = (weight * (P**2 - error**2)).sum()
        if not information > 0:
            return None
        new = -float((weight * residual * P).sum() / information)
        if abs(new - dt) < 1e-6:
            break
        dt = new
    corrected = residual + dt * P
    # a star has one motion in all of its detections, and the error of the motion is in both factors
    _, star = np.unique(motion, axis=1, return_inverse=True)
    score = (weight * (corrected * P - dt * error**2)).sum(axis=0)
    sigma = float(np.sqrt(squares_over(star.ravel(), score)[0]) / information)
    after = _scatter(corrected[:, well_known])
    is_significant = abs(dt) > EPOCH_SHIFT.value * sigma and after < before
    return EpochShift(dt, sigma, before, after, sample.model.unit, bool(is_significant))


def _scatter(values: Float) -> float:
    """Robust standard deviation about the median of each axis, both axes together."""
    middle = np.median(values, axis=1, keepdims=True)
    return MAD_TO_SIGMA * float(np.median(np.abs(values - middle)))


def _left_over(sample: ScoredSample, weight: Float, *fields: Float) -> Iterator[Float]:
    """Vectors (2, N) minus polynomials on each chip of each exposure."""
    out = [field.copy() for field in fields]
    for rows in _together(sample):
        basis = sample.model.basis().evaluate_scaled(sample.X[rows], sample.Y[rows])
        w = np.sqrt(weight[rows])
        if (w > 0).sum() < 2 * basis.shape[1]:  # too few for a polynomial: only a shift
            basis = basis[:, :1]
        for field in out:
            coefficients = np.linalg.lstsq(w[:, None] * basis, (w * field[:, rows]).T)[0]
            field[:, rows] -= (basis @ coefficients).T
    yield from out


def _together(sample: ScoredSample) -> list[Int]:
    """Indices of the rows of each chip and exposure."""
    keys = np.column_stack([sample.chip, sample.exposure])
    code = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
    return np.split(np.argsort(code, kind="stable"), np.cumsum(np.bincount(code))[:-1])
