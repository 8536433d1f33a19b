"""Scores of single detections of a self-calibration, and the fraction of them that stars absorb."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bayesdist.diagnose.clusters import sums_over
from bayesdist.diagnose.correlated.noise import MAX_BLOCKS, STARS_PER_BLOCK, block_ratios
from bayesdist.infer.selfcal.calibrate import MOST_TAKEN
from bayesdist.infer.selfcal.elimination import STARS, memberships
from bayesdist.infer.selfcal.mode import SelfCalibrationMode
from bayesdist.infer.selfcal.problem import Problem
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Bool, Float, Int

# relative curvature below which a combination of parameters, or of a star's parameters, counts as
# undetermined
UNKNOWN = 1e-10


@dataclass(frozen=True, eq=False)
class DetectionScores:
    """Gradient and curvature of each detection's log density with respect to sky position."""

    gradient: Float  # (N, 2)
    # (N, 2, 2) minus the second derivatives; zero for detections with uncertain membership, so that
    # every sum is positive definite
    curvature: Float

    def at(self, rows: slice | Bool) -> DetectionScores:
        """Scores of the given detections."""
        return DetectionScores(self.gradient[rows], self.curvature[rows])

    def flattened(self, excess: Float) -> DetectionScores:
        """Scores of a likelihood with variances multiplied by factors (N,)."""
        return DetectionScores(
            self.gradient / excess[:, None], self.curvature / excess[:, None, None]
        )


def scores_of_detections(solution: SelfCalibrationMode) -> DetectionScores:
    """Scores of all detections of a solution, with the stars at their modes."""
    p, mixture = solution.problem, solution.mixture
    member = memberships(p, solution.theta, mixture, solution.stars)
    r = p.places(solution.theta) - p.star_places(solution.stars)
    W = _square(p)
    inverse = 1.0 / (p.var + mixture.jitter**2)
    pulled = inverse[:, None] * np.einsum("nab,nb->na", W, r)
    H = (member * inverse)[:, None, None] * W
    # derivative of the membership with respect to position
    H -= (member * (1 - member))[:, None, None] * (pulled[:, :, None] * pulled[:, None, :])
    good = (H[:, 0, 0] > 0) & (np.linalg.det(H) > 0)
    return DetectionScores(-member[:, None] * pulled, np.where(good[:, None, None], H, 0.0))


def score_excess(solution: SelfCalibrationMode, scores: DetectionScores) -> Float:
    """Ratio (N,) of the variance of the scores to their curvature, in blocks of the detector.

    The ratios are corrected for the part of the residuals that stars absorb.  Those of the blocks
    are shrunk to their mean, as for matched stars.
    """
    p = solution.problem
    free = 1.0 - taken_by_stars(solution)
    free *= max(1.0 - len(solution.free) / max(2 * float(free.sum()), 1.0), 0.1)
    to_pixels = np.linalg.inv(_square(p))  # converts squared gradients to pixels
    top = np.einsum("na,nab,nb->n", scores.gradient, to_pixels, scores.gradient) / free
    bottom = np.einsum("nab,nba->n", to_pixels, scores.curvature)
    chip = p.groups.chip[p.groups.index]
    out = np.ones(len(p))
    for code in range(len(p.model.chips)):
        on_chip = np.flatnonzero(chip == code)
        if not len(on_chip) or bottom[on_chip].sum() <= 0:
            continue
        side = int(np.clip(np.sqrt(len(on_chip) / STARS_PER_BLOCK), 1, MAX_BLOCKS))
        block = cell_index(p.X[on_chip], p.Y[on_chip], (side, side))
        out[on_chip] = block_ratios(
            block, np.stack([top, bottom, 2 * free], axis=1)[on_chip], side**2
        )
    return out


def _square(problem: Problem) -> Float:
    return np.asarray(problem.W[:, [0, 1, 1, 2]].reshape(-1, 2, 2))


@dataclass(frozen=True, eq=False)
class StarBlock:
    """A block of stars with their n detections, in detector pixels."""

    rows: slice  # range of detections in the problem
    star: Int  # (n,) index of each detection's star in the block
    member: Float  # (n,) probability of belonging to the star
    weight: Float  # (n,) inverse variance per axis, times that probability
    residual: Float  # (n, 2) detection minus star
    # (n, q, 2) R B: B is the curvature of the log density with respect to the star's parameters and
    # the detection's pixels, R^T R the inverse of that with respect to the star's parameters
    ties: Float


def star_blocks(solution: SelfCalibrationMode) -> Iterator[StarBlock]:
    """Iterate over the stars of a solution in blocks, with their detections."""
    p, theta, mixture = solution.problem, solution.theta, solution.mixture
    members = memberships(p, theta, mixture, solution.stars)
    weights = members / (p.var + mixture.jitter**2)
    residuals = p.places(theta) - p.star_places(solution.stars)
    for first in range(0, p.n_stars, STARS):
        last = min(first + STARS, p.n_stars)
        rows = slice(int(p.starts[first]), int(p.starts[last]))
        to_pixels = np.linalg.inv(p.jacobians(theta, rows))
        w, star = weights[rows], p.star[rows] - first
        by_star = np.swapaxes(to_pixels @ places_by_star(p, rows), 1, 2)
        curvature = w[:, None, None] * by_star @ np.swapaxes(by_star, 1, 2)
        information = p.priors.precision[first:last] + sums_over(star, curvature, last - first)
        roots = inverse_roots(information)
        residual = np.einsum("nij,nj->ni", to_pixels, residuals[rows])
        ties = w[:, None, None] * (roots[star] @ by_star)
        yield StarBlock(rows, star, members[rows], w, residual, ties)


def taken_by_stars(solution: SelfCalibrationMode) -> Float:
    """Fraction (N,) of each detection's variance that its star absorbs, at most `MOST_TAKEN`."""
    out = np.empty(len(solution.problem))
    for block in star_blocks(solution):
        square = np.sum(block.ties**2, axis=(1, 2))
        out[block.rows] = square / (2 * np.maximum(block.weight, np.finfo(float).tiny))
    return np.minimum(out, MOST_TAKEN)


def inverse_roots(matrices: Float) -> Float:
    """Matrices R with R^T R the inverse of each matrix (S, q, q).

    Undetermined directions are left out.
    """
    scale = np.sqrt(np.maximum(np.einsum("sqq->sq", matrices), 1e-300))
    values, vectors = np.linalg.eigh(matrices / (scale[:, :, None] * scale[:, None, :]))
    good = values > UNKNOWN
    roots = np.where(good, np.where(good, values, 1.0) ** -0.5, 0.0)
    return np.asarray(roots[:, :, None] * np.swapaxes(vectors, 1, 2) / scale[:, None, :])


def places_by_star(problem: Problem, rows: slice) -> Float:
    """Derivatives (n, 2, q) of positions with respect to the parameters of their stars."""
    n, q, unit = rows.stop - rows.start, problem.n_star, np.eye(2)
    out = np.broadcast_to(unit, (n, 2, 2))
    if q >= 4:
        out = np.concatenate([out, problem.time[rows, None, None] * unit], axis=2)
    return out if q < 5 else np.concatenate([out, problem.factor[rows, :, None]], axis=2)
