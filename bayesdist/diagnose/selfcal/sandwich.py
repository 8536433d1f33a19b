"""Covariance of a self-calibration by the scatter of its detections, star by star."""

from __future__ import annotations

import numpy as np

from bayesdist.diagnose.selfcal.eliminated import Columns, Piece, absorbed_by_stars, pieces
from bayesdist.diagnose.selfcal.scores import DetectionScores
from bayesdist.infer.selfcal.mode import SelfCalibrationMode
from bayesdist.utils.arrays import Float

# A star that alone determines a parameter has no residual: its squared score is uninformative.
MIN_FREE = 0.1


def sandwich(solution: SelfCalibrationMode, scores: DetectionScores) -> Float:
    """Covariance (D, D) of the parameters, valid for any errors of single stars; 0 for fixed ones.

    The detections of a star share its position, so that their scores are added up.  Each sum is
    divided by one minus the leverage of the star's detections (HC3 of MacKinnon and White 1985,
    Journal of Econometrics 29, 305, with stars for observations): a jackknife over stars, to first
    order.
    """
    p, free = solution.problem, solution.free
    columns = Columns(p, solution.theta)
    root = np.zeros((columns.n_params, len(free)))
    root[free] = np.linalg.inv(np.linalg.cholesky(solution.precision)).T
    inside = np.empty_like(root)
    inside[columns.order] = root
    meat = np.array(solution.prior.precision)
    for piece in pieces(columns):
        here = piece.scores(scores)
        sums = absorbed_by_stars(columns, piece, here, solution.stars)
        S, q = piece.stars.stop - piece.stars.start, p.n_star
        moved = _displacements(columns, piece, inside)
        whole = np.einsum("nab,naf,nbf->n", here.curvature, moved, moved, optimize=True)
        leverage = np.bincount(piece.star, whole, S)
        leverage -= np.sum((sums.rows @ inside) ** 2, axis=1).reshape(S, q).sum(axis=1)
        # per degree of freedom of its detections, in excess of the star's own parameters
        number = 2 * np.bincount(piece.star, here.curvature[:, 0, 0] > 0, S) - q
        mean = np.clip(leverage / np.maximum(number, 1), 0.0, 1 - MIN_FREE)
        psi = star_scores(columns, piece, here.gradient) / (1 - mean)[:, None]
        meat += psi.T @ psi
    cov = root @ root.T
    return np.asarray(cov @ meat @ cov)


def star_scores(columns: Columns, piece: Piece, gradient: Float) -> Float:
    """Scores (S, n) of each star of a piece, by all columns.

    At the stars' modes: their own parameters have no gradient, and nothing is to be eliminated.
    """
    S = piece.stars.stop - piece.stars.start
    out = np.zeros((S, columns.sparse.stop))
    # one value for each star
    for code, (here, values) in enumerate(piece.dense):
        for axis in (0, 1):
            summed = piece.of_stars(gradient[:, None, axis, None])[:, here] @ values
            out[:, columns.dense(code, axis)] = summed
    out[:, columns.sparse] = (piece.of_stars(gradient[:, None, :]) @ piece.sparse).toarray()
    return out[:, columns.order]


def _displacements(columns: Columns, piece: Piece, root: Float) -> Float:
    """Displacements (n, 2, f) of detections by some changes (internal columns, f)."""
    out = np.zeros((len(piece), 2, root.shape[1]))
    for code, (here, values) in enumerate(piece.dense):
        for axis in (0, 1):
            out[here, axis] = values @ root[columns.dense(code, axis)]
    out += (piece.sparse @ root[columns.sparse]).reshape(out.shape)
    return np.asarray(out)
