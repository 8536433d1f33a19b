"""Linear algebra of very many very small symmetric matrices.

The matrix axes come first and the batch axes last, and the loops run over the matrix: for 3 x 3 or
8 x 8 matrices this is tens of times faster than one call of LAPACK for each.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["cholesky", "inverse_of_factor", "precision_of", "solve_factor"]

Float = NDArray[np.float64]


def cholesky(matrix: Float) -> Float:
    """Lower Cholesky factors of matrices (k, k, ...).

    A matrix that is not positive definite gives NaN there, and no error: see `numpy.sqrt`.
    """
    k = len(matrix)
    out = np.zeros_like(matrix)
    for j in range(k):
        column = matrix[j:, j].copy()
        for m in range(j):
            column -= out[j:, m] * out[j, m]
        column[0] = np.sqrt(column[0])
        column[1:] /= column[0]
        out[j:, j] = column
    return out


def solve_factor(factor: Float, vector: Float) -> Float:
    """Solve factor @ x = vector for lower factors (k, k, ...) and vectors (k, ...)."""
    out = np.empty(np.broadcast_shapes(vector.shape, factor.shape[1:]))
    for i in range(len(factor)):
        row = np.array(np.broadcast_to(vector[i], out.shape[1:]))
        for m in range(i):
            row -= factor[i, m] * out[m]
        out[i] = row / factor[i, i]
    return out


def inverse_of_factor(factor: Float) -> Float:
    """Inverses (k, k, ...) of lower factors."""
    k = len(factor)
    out = np.zeros_like(factor)
    for j in range(k):
        out[j, j] = 1.0 / factor[j, j]
        for i in range(j + 1, k):
            total = factor[i, j] * out[j, j]
            for m in range(j + 1, i):
                total = total + factor[i, m] * out[m, j]
            out[i, j] = -total / factor[i, i]
    return out


def precision_of(factor: Float) -> Float:
    """Inverses (k, k, ...) of the matrices that have these lower factors."""
    k = len(factor)
    half = inverse_of_factor(factor)
    out = np.empty_like(factor)
    for i in range(k):
        for j in range(i + 1):
            total = half[i, i] * half[i, j]
            for m in range(i + 1, k):
                total = total + half[m, i] * half[m, j]
            out[i, j] = out[j, i] = total
    return out
