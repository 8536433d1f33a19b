"""Efficient scores: columns of a likelihood, with the parameters of the model projected out.

Tests add columns Z to the derivatives J of positions by the parameters, which are nuisance: with H
the curvature and g the gradient of each detection, and P and r precision and pull of the priors,

    gain = C^-1 J^T H Z         C = J^T H J + P
    information = Z^T H Z - (J^T H Z)^T gain
    score = Z^T g - gain^T (J^T g + r)

Where positions of stars are solved for, these are eliminated from all of the sums before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.utils.arrays import Bool, Float, Int


@dataclass(frozen=True, eq=False)
class EfficientScore:
    """Information and score of n columns, the parameters projected out."""

    gain: Float  # (D, n) parameters that the columns are taken for
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
        """From the sums before, by the covariance (D, D) and the score (D,) of the parameters.

        `cross` (m, n) are products of parameters and columns, of some `rows` alone where the
        columns have to do with few of the parameters.
        """
        gain = covariance[:, rows] @ cross
        left = information - cross.T @ gain[rows]
        return cls(gain, (left + left.T) / 2, score - gain.T @ nuisance_score)


@dataclass(frozen=True, eq=False)
class Directions:
    """Combinations of columns that the parameters have left, in units of their information."""

    columns: Int  # (m,)
    basis: Float  # (m, q) with unit information, all parameters projected out
    score: Float  # (q,) also the step by which the fit would move

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
        """Directions of the `own` ones of some columns (m,), without what the others say of them.

        `combinations` (k, n) are those of the own ones that are asked for, `known` (k, k) their
        information before anything is projected out, of which a direction must keep `least`.
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
        """Mean squares of the pattern that the score stands for, and of what noise makes of it.

        `covariance` (q, q) is that of the score, `square` (m, m) the mean products of the columns.
        """
        of_basis = self.basis.T @ square @ self.basis
        return squares_of(self.score, np.eye(self.q), covariance, of_basis)


def _beside_others(information: Float, own: Bool, directions: Float) -> Float:
    """Directions (n, q) of the `own` regressors (n,), without what the others say of them.

    `information` (n, n) is that of all, the parameters projected out; `directions` are combinations
    of the own ones.
    """
    out = np.zeros((len(own), directions.shape[1]))
    out[own] = directions
    across = information[np.ix_(~own, own)] @ directions
    out[~own] = -np.linalg.lstsq(information[np.ix_(~own, ~own)], across)[0]
    return out


def independent_directions(whole: Float, left: Float, least: float) -> Float:
    """Directions (n, q) of regressors that the parameters have left.

    `whole` and `left` (n, n) are the information of the regressors before and after the parameters
    are projected out, `least` the fraction of it that a direction must keep. Directions are in
    units in which `whole` is the unit matrix.
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
    """Mean squares of the pattern that a score stands for, and of what noise makes of it.

    The first holds the second. `information` and `covariance` (q, q) are those of the directions
    and of their `score` (q,), `square` (q, q) the mean products of the directions over the
    detector.
    """
    inverse = np.linalg.inv(information)
    step = inverse @ score
    noise = np.trace(square @ inverse @ covariance @ inverse)
    return float(step @ square @ step), float(noise)
