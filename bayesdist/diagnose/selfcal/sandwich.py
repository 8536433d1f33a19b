"""Covariance of a self-calibration from the scatter of the scores of its stars."""

from __future__ import annotations

import numpy as np

from bayesdist.diagnose.correlated.squares import MIN_FREE, SquaredScores
from bayesdist.diagnose.selfcal.eliminated import Columns, Piece, absorbed_by_stars, pieces
from bayesdist.diagnose.selfcal.scores import DetectionScores
from bayesdist.infer.selfcal.mode import SelfCalibrationMode
from bayesdist.utils.arrays import Float


def squared_scores(solution: SelfCalibrationMode, scores: DetectionScores) -> SquaredScores:
    """Sums over the stars of products of their scores, and their expectation.

    0 for fixed parameters.

    The detections of a star share its position, so that their scores are summed.  The leverage is
    that of the star's detections per degree of freedom, beyond the star's parameters.
    """
    p, free = solution.problem, solution.free
    columns = Columns(p, solution.theta)
    root = np.zeros((columns.n_params, len(free)))
    root[free] = np.linalg.inv(np.linalg.cholesky(solution.precision)).T
    inside = np.empty_like(root)
    inside[columns.order] = root
    unbiased, jackknife = np.zeros((2, columns.n_params, columns.n_params))
    products = np.zeros(3)
    for piece in pieces(columns):
        piece_scores = piece.scores(scores)
        sums = absorbed_by_stars(columns, piece, piece_scores, solution.stars)
        S, q = piece.stars.stop - piece.stars.start, p.n_star
        moved = _displacements(columns, piece, inside)
        total_leverage = np.einsum(
            "nab,naf,nbf->n", piece_scores.curvature, moved, moved, optimize=True
        )
        leverage = np.bincount(piece.star, total_leverage, S)
        leverage -= np.sum((sums.rows @ inside) ** 2, axis=1).reshape(S, q).sum(axis=1)
        number = np.maximum(
            2 * np.bincount(piece.star, piece_scores.curvature[:, 0, 0] > 0, S) - q, 1
        )
        mean = np.clip(leverage / number, 0.0, 1 - MIN_FREE)
        psi = star_scores(columns, piece, piece_scores.gradient) / np.sqrt(1 - mean)[:, None]
        unbiased += psi.T @ psi
        square = np.sum((psi @ root) ** 2, axis=1)
        # expected squares of a star are assumed equal for all its degrees of freedom
        products += [square @ square, square @ mean, leverage @ mean]
        psi /= np.sqrt(1 - mean)[:, None]
        jackknife += psi.T @ psi
    prior = np.array(solution.prior.precision)
    expected = np.zeros_like(prior)
    expected[np.ix_(free, free)] = solution.precision - prior[np.ix_(free, free)]
    return SquaredScores(
        root @ root.T,
        expected,
        prior,
        unbiased,
        jackknife,
        (float(products[0]), float(products[1]), float(products[2])),
    )


def star_scores(columns: Columns, piece: Piece, gradient: Float) -> Float:
    """Scores (S, n) of each star of a chunk with respect to all columns.

    Stars are at their modes: the gradient with respect to their parameters is zero, so that nothing
    needs to be eliminated.
    """
    S = piece.stars.stop - piece.stars.start
    out = np.zeros((S, columns.sparse.stop))
    # one value per star
    for code, (members, values) in enumerate(piece.dense):
        for axis in (0, 1):
            summed = piece.of_stars(gradient[:, None, axis, None])[:, members] @ values
            out[:, columns.dense(code, axis)] = summed
    out[:, columns.sparse] = (piece.of_stars(gradient[:, None, :]) @ piece.sparse).toarray()
    return out[:, columns.order]


def _displacements(columns: Columns, piece: Piece, root: Float) -> Float:
    """Displacements (n, 2, f) of detections due to changes `root` (internal columns, f)."""
    out = np.zeros((len(piece), 2, root.shape[1]))
    for code, (members, values) in enumerate(piece.dense):
        for axis in (0, 1):
            out[members, axis] = values @ root[columns.dense(code, axis)]
    out += (piece.sparse @ root[columns.sparse]).reshape(out.shape)
    return np.asarray(out)
