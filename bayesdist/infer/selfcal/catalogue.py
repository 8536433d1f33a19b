"""Catalogue of the stars of a self-calibration, with the covariances of their parameters."""

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
    """Parameters of S stars in the coordinate system of the solution."""

    values: Float  # (S, q): position at `epoch`, then proper motion per year, then parallax
    cov: Float  # (S, q, q): covariance including the errors of distortion and frames
    own: Float  # (S, q, q): covariance for exactly known distortion and frames
    n: Int  # number (S,) of detections
    n_members: Float  # expected number (S,) of true detections
    epoch: float  # date of the positions in decimal years
    unit: str  # unit of u, v

    def __len__(self) -> int:
        return len(self.values)


def star_catalogue(
    solution: SelfCalibrationMode, cov: Float | None = None, *, compute: Compute | None = None
) -> StarCatalogue:
    """Make a catalogue of the stars at their modes, with covariances (Laplace approximation).

    The covariance of a star is the sum of that for a known distortion, from the star's detections,
    and that caused by the error of the distortion: A^-1 + A^-1 B Sigma B^T A^-1.

    Parameters
    ----------
    solution : SelfCalibrationMode
    cov : ndarray, shape (D, D), optional
        Covariance Sigma of the parameters of the model; that of the solution by default.
    compute : Compute, optional
        Computing engine; this process by default.

    Returns
    -------
    StarCatalogue
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
    total, star_cov, members = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    # a star without true detections may be anywhere in the match circle
    widest = problem.least_root**-2
    lost = (members < 0.5) & (np.trace(star_cov[:, :2, :2], axis1=1, axis2=2) > 2 * widest)
    for matrices in (star_cov, total):
        matrices[lost, :2] = matrices[lost, :, :2] = 0.0
        matrices[lost, :2, :2] = widest * np.eye(2)
    return StarCatalogue(
        solution.stars,
        total,
        star_cov,
        problem.counts,
        members,
        problem.epoch0,
        problem.model.unit,
    )


def _covariances(
    piece: StarPiece, theta: Float, mixture: Mixture, root: Float
) -> tuple[Float, Float, Float]:
    """Total covariances, covariances for a known distortion (S, q, q each), and members (S,).

    `root` (D, F) is a matrix square root of the covariance of the parameters.
    """
    p, stars = piece.problem, piece.stars
    S, q = p.n_stars, p.n_star
    total, star_cov = np.empty((S, q, q)), np.empty((S, q, q))
    for selection, rows, factors in eliminated_rows(p, theta, mixture, stars):
        back = np.linalg.inv(np.tril(factors))  # L^-1
        star_cov[selection] = np.swapaxes(back, 1, 2) @ back
        # A^-1 B = L^-T (L^-1 B)
        spread = np.swapaxes(back, 1, 2) @ (rows @ root)
        total[selection] = star_cov[selection] + spread @ np.swapaxes(spread, 1, 2)
    w = memberships(p, theta, mixture, stars)
    return total, star_cov, np.asarray(np.bincount(p.star, w, minlength=S), float)
