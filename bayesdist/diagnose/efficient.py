"""Efficient scores: columns of a likelihood, with the parameters of the model projected out.

Tests add columns Z to the derivatives J of positions with respect to the parameters, which are
nuisance parameters.  With H the curvature and g the gradient of each detection, and P and r the
precision of the priors and their gradient,

    gain = C^-1 J^T H Z         C = J^T H J + P
    information = Z^T H Z - (J^T H Z)^T gain
    score = Z^T g - gain^T (J^T g + r)

If positions of stars are fitted, they are eliminated from all these sums first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.utils.arrays import Bool, Float, Int


@dataclass(frozen=True, eq=False)
class EfficientScore:
    """Information and score of n columns with the parameters projected out."""

    gain: Float  # (D, n) changes of the parameters that imitate the columns
    information: Float  # (n, n)
    score: Float  # (n,)

    @classmethod
    def of(
        cls,
        covariance: Float,
        nuisance_score: Float,
        cross: Float,
        information: Float,
        score: Float,
        rows: Int | slice = slice(None),
    ) -> EfficientScore:
        """Project the parameters out of information and score of columns.

        `covariance` (D, D) and `nuisance_score` (D,) are those of the parameters.  `cross` (m, n)
        is the information between parameters and columns, for the parameters `rows` only if the
        columns depend on few of them.
        """
        gain = covariance[:, rows] @ cross
        projected = information - cross.T @ gain[rows]
        return cls(gain, (projected + projected.T) / 2, score - gain.T @ nuisance_score)


@dataclass(frozen=True, eq=False)
class Directions:
    """Combinations of columns that the parameters do not absorb, scaled to unit information."""

    columns: Int  # (m,) indices of the columns
    basis: Float  # (m, q) with unit information after projecting out all parameters
    score: Float  # (q,) score, equal to the step of the fit

    @classmethod
    def of(
        cls,
        left: EfficientScore,
        columns: Int,
        own: Bool,
        combinations: Float,
        known: Float,
        least: float,
    ) -> Directions:
        """Directions of the columns marked as `own`, with all other columns projected out.

        `columns` (m,) are indices into `left`, and `own` (m,) is a mask of them.  `combinations`
        (k, n) are the combinations of own columns to test, `known` (k, k) is the information of
        these columns before anything is projected out, and `least` the fraction of it that a
        direction must keep.
        """
        S = left.information[np.ix_(columns, columns)]
        A = _beside_others(S, own, combinations)
        S = A.T @ S @ A
        N = independent_directions(combinations.T @ known @ combinations, S, least)
        # eigenvectors: their information is diagonal
        basis = A @ (N / np.sqrt(np.einsum("nq,nm,mq->q", N, S, N, optimize=True)))
        return cls(columns, basis, basis.T @ left.score[columns])

    @property
    def q(self) -> int:
        """Number of directions."""
        return self.basis.shape[1]

    def squares(self, covariance: Float, square: Float) -> tuple[float, float]:
        """Mean squares of the pattern that corresponds to the score, and of its noise.

        `covariance` (q, q) is that of the score, `square` (m, m) the mean products of the columns.
        """
        of_basis = self.basis.T @ square @ self.basis
        return squares_of(self.score, np.eye(self.q), covariance, of_basis)


def _beside_others(information: Float, own: Bool, directions: Float) -> Float:
    """Directions (n, q) of the `own` regressors (n,), with the other regressors projected out.

    `information` (n, n) is that of all regressors with the parameters projected out; `directions`
    are combinations of the own ones.
    """
    out = np.zeros((len(own), directions.shape[1]))
    out[own] = directions
    across = information[np.ix_(~own, own)] @ directions
    out[~own] = -np.linalg.lstsq(information[np.ix_(~own, ~own)], across)[0]
    return out


def independent_directions(whole: Float, left: Float, least: float) -> Float:
    """Directions (n, q) of regressors that the parameters do not absorb.

    `whole` and `left` (n, n) are the information of the regressors before and after the parameters
    are projected out, `least` is the fraction that a direction must keep.  Directions are scaled
    such that `whole` becomes the unit matrix.
    """
    diagonal = np.diag(whole)
    scale = np.zeros(len(diagonal))
    scale[diagonal > 0] = diagonal[diagonal > 0] ** -0.5
    values, vectors = np.linalg.eigh(whole * np.outer(scale, scale))
    good = values > 1e-8 * values.max(initial=1e-300)
    basis = scale[:, None] * vectors[:, good] / np.sqrt(values[good])
    fraction, turn = np.linalg.eigh(basis.T @ left @ basis)
    return np.asarray(basis @ turn[:, fraction > least])


def squares_of(
    score: Float, information: Float, covariance: Float, square: Float
) -> tuple[float, float]:
    """Mean squares of the pattern that corresponds to a score, noise included, and of its noise.

    `information` and `covariance` (q, q) are those of the directions and of their `score` (q,);
    `square` (q, q) contains the mean products of the directions over the detector.
    """
    inverse = np.linalg.inv(information)
    step = inverse @ score
    noise = np.trace(square @ inverse @ covariance @ inverse)
    return float(step @ square @ step), float(noise)
