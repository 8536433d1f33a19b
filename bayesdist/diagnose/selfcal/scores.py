"""Scores of single detections by their sky positions in the model, at a solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.diagnose.correlated.noise import MAX_BLOCKS, STARS_PER_BLOCK, block_ratios
from bayesdist.diagnose.selfcal.leverage import taken_by_stars
from bayesdist.infer.selfcal.elimination import memberships
from bayesdist.infer.selfcal.mode import SelfCalibrationMode
from bayesdist.infer.selfcal.problem import Problem
from bayesdist.model.grid import cell_index

__all__ = ["DetectionScores", "score_excess", "scores_of_detections"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DetectionScores:
    """Gradient and curvature of the log density of each detection by its sky position."""

    gradient: Float  # (N, 2)
    # minus the second derivatives (N, 2, 2); zero where a detection may or may not belong to its
    # star, so that every sum is that of a possible likelihood
    curvature: Float

    def at(self, rows: slice | NDArray[np.bool_]) -> DetectionScores:
        """Scores of some detections."""
        return DetectionScores(self.gradient[rows], self.curvature[rows])

    def flattened(self, excess: Float) -> DetectionScores:
        """Scores of a likelihood whose variances are larger by factors (N,)."""
        return DetectionScores(
            self.gradient / excess[:, None], self.curvature / excess[:, None, None]
        )


def scores_of_detections(solution: SelfCalibrationMode) -> DetectionScores:
    """Scores of all detections of a solution, their stars at their modes."""
    p, mixture = solution.problem, solution.mixture
    member = memberships(p, solution.theta, mixture, solution.stars)
    r = p.places(solution.theta) - p.star_places(solution.stars)
    W = _square(p)
    inverse = 1.0 / (p.var + mixture.jitter**2)
    pulled = inverse[:, None] * np.einsum("nab,nb->na", W, r)
    H = (member * inverse)[:, None, None] * W
    # derivative of the membership by position
    H -= (member * (1 - member))[:, None, None] * (pulled[:, :, None] * pulled[:, None, :])
    good = (H[:, 0, 0] > 0) & (np.linalg.det(H) > 0)
    return DetectionScores(-member[:, None] * pulled, np.where(good[:, None, None], H, 0.0))


def score_excess(solution: SelfCalibrationMode, scores: DetectionScores) -> Float:
    """Ratio (N,) of the variance of the scores to their curvature, by blocks of the detector.

    Stars absorb a part of the residuals of their detections, for which the ratios are corrected;
    those of blocks are shrunk to their mean as for matched stars.
    """
    p = solution.problem
    free = 1.0 - taken_by_stars(solution)
    free *= max(1.0 - len(solution.free) / max(2 * float(free.sum()), 1.0), 0.1)
    to_pixels = np.linalg.inv(_square(p))  # of a squared gradient
    top = np.einsum("na,nab,nb->n", scores.gradient, to_pixels, scores.gradient) / free
    bottom = np.einsum("nab,nba->n", to_pixels, scores.curvature)
    chip = p.groups.chip[p.groups.index]
    out = np.ones(len(p))
    for code in range(len(p.model.chips)):
        here = np.flatnonzero(chip == code)
        if not len(here) or bottom[here].sum() <= 0:
            continue
        side = int(np.clip(np.sqrt(len(here) / STARS_PER_BLOCK), 1, MAX_BLOCKS))
        block = cell_index(p.X[here], p.Y[here], (side, side))
        out[here] = block_ratios(block, np.stack([top, bottom, 2 * free], axis=1)[here], side**2)
    return out


def _square(problem: Problem) -> Float:
    return np.asarray(problem.W[:, [0, 1, 1, 2]].reshape(-1, 2, 2))
