"""The stars of a self-calibration, with the covariance of their parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.infer.selfcal.elimination import Mixture, eliminated_rows, memberships
from bayesdist.infer.selfcal.mode import SelfCalibrationMode
from bayesdist.infer.selfcal.pieces import StarPiece, in_pieces
from bayesdist.infer.stars.shards import Compute
from bayesdist.utils.arrays import Float, Int


@dataclass(frozen=True, eq=False)
class StarCatalogue:
    """Stars on the sky of the solution."""

    values: Float  # (S, q), position at `epoch`, then motion per year, then parallax
    cov: Float  # (S, q, q), with the errors of distortion and frames, in the gauge of the solution
    own: Float  # (S, q, q), without these: by the star's own detections alone
    n: Int  # (S,), detections
    n_members: Float  # (S,), expected number of true detections among these
    epoch: float
    unit: str

    def __len__(self) -> int:
        return len(self.values)


def star_catalogue(
    solution: SelfCalibrationMode, cov: Float | None = None, *, compute: Compute | None = None
) -> StarCatalogue:
    """Stars at their modes, with Laplace covariances.

    The covariance of a star is that by its own detections for a known distortion, plus that by
    the error of the distortion: A^-1 + A^-1 B Sigma B^T A^-1.

    `cov` (D, D): sigma; that of the solution by default. `compute`: where the passes over the
    detections are made; in this process by default.
    """
    problem = solution.problem
    root = np.zeros((len(solution.theta), len(solution.free)))
    if cov is None:
        root[solution.free] = np.linalg.inv(np.linalg.cholesky(solution.precision)).T
    else:
        scale = np.sqrt(np.diag(cov)[solution.free])
        inner = cov[np.ix_(solution.free, solution.free)] / np.outer(scale, scale)
        root[solution.free] = scale[:, None] * np.linalg.cholesky(inner)
    with in_pieces(problem, solution.stars, compute) as pieces:
        parts = list(pieces.each(_covariances, solution.theta, solution.mixture, root))
    total, own, members = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    # a star without members is somewhere in the match circle
    widest = problem.least_root**-2
    lost = (members < 0.5) & (np.trace(own[:, :2, :2], axis1=1, axis2=2) > 2 * widest)
    for matrices in (own, total):
        matrices[lost, :2] = matrices[lost, :, :2] = 0.0
        matrices[lost, :2, :2] = widest * np.eye(2)
    return StarCatalogue(
        solution.stars,
        total,
        own,
        problem.counts,
        members,
        problem.epoch0,
        problem.model.unit,
    )


def _covariances(
    piece: StarPiece, theta: Float, mixture: Mixture, root: Float
) -> tuple[Float, Float, Float]:
    """Covariances (S, q, q) of the stars of a piece, in all and of their own; members (S,).

    `root` (D, F) is a square root of the covariance of the parameters.
    """
    p, stars = piece.problem, piece.stars
    S, q = p.n_stars, p.n_star
    total, own = np.empty((S, q, q)), np.empty((S, q, q))
    for some, rows, factors in eliminated_rows(p, theta, mixture, stars):
        back = np.linalg.inv(np.tril(factors))  # L^-1
        own[some] = np.swapaxes(back, 1, 2) @ back
        # A^-1 B = L^-T (L^-1 B)
        spread = np.swapaxes(back, 1, 2) @ (rows @ root)
        total[some] = own[some] + spread @ np.swapaxes(spread, 1, 2)
    w = memberships(p, theta, mixture, stars)
    return total, own, np.asarray(np.bincount(p.star, w, minlength=S), float)
