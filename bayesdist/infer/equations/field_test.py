"""Chi-square of a difference between polynomials, of which some fields have been taken out.

It does not depend on how they were taken out: a difference and its covariance that have both gone
through any linear projection along the same fields give one value.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.stats import chi2 as chi_square

__all__ = ["FieldTest", "determined", "field_test", "known_terms"]

Float = NDArray[np.float64]

RANK = 1e-9  # eigenvalues of a correlation matrix below it are rounding


@dataclass(frozen=True)
class FieldTest:
    """Chi-square of a whole field of differences.

    Parameters
    ----------
    chi2 : float
    dof : int
        Rank of the covariance.
    p_value : float
        Probability of a chi-square as large.
    """

    chi2: float
    dof: int
    p_value: float


def field_test(
    difference: Float, cov: Float, taken: Float, norm: Float, *, draws: float = np.inf
) -> FieldTest:
    """Chi-square of a difference from which some fields were taken out.

    Parameters
    ----------
    difference : ndarray, shape (n,)
    cov : ndarray, shape (n, n)
        Before they were taken out.  Terms without variance are no part of the test.
    taken : ndarray, shape (n, q)
    norm : ndarray, shape (n,)
        Mean square of each term, which makes them comparable.
    draws : float
        Effective draws from which the covariance was estimated: the inverse of an estimate is too
        large by (n - 1) / (n - dof - 2) (Hartlap et al. 2007), which is taken back.

    Returns
    -------
    FieldTest
    """
    known = known_terms(cov)
    root = np.sqrt(norm[known])
    fields = taken[known] * root[:, None]
    length = np.linalg.norm(fields, axis=0)
    fields = fields[:, length > 0] / length[length > 0]
    free = null_space(fields.T) if fields.shape[1] else np.eye(len(fields))
    y = free.T @ (root * difference[known])
    C = free.T @ (root[:, None] * cov[np.ix_(known, known)] * root) @ free
    root_of_inverse = determined(C)
    white = y @ root_of_inverse
    dof = len(white)
    shrink = 1.0
    if np.isfinite(draws):
        shrink = max(draws - dof - 2, 1.0) / (draws - 1) if draws > 2 else 0.0
    chi2 = float(white @ white) * shrink
    return FieldTest(chi2, dof, float(chi_square.sf(chi2, dof)))


def known_terms(cov: Float) -> NDArray[np.bool_]:
    """Which parameters a covariance speaks of."""
    variance = np.diag(cov)
    return np.asarray(variance > 1e-20 * variance.max(initial=0.0))


def determined(matrix: Float) -> Float:
    """Root R (n, rank) of the inverse of a positive matrix where it has one: R R^T.

    Parameters
    ----------
    matrix : ndarray, shape (n, n)
        Positive semidefinite, with a rank that rounding hides.

    Returns
    -------
    ndarray, shape (n, rank)
    """
    diagonal = np.diag(matrix)
    known = diagonal > 0
    unit = np.where(known, 1.0 / np.sqrt(np.where(known, diagonal, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(unit[:, None] * matrix * unit)
    good = values > RANK * max(values[-1], 1e-300)
    return np.asarray(unit[:, None] * vectors[:, good] / np.sqrt(values[good]))
