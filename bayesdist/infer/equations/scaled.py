"""Linear algebra of covariances and normal matrices, and chi-square tests with them.

The parameters of a model differ by many orders of magnitude.  Matrices are therefore scaled to unit
diagonal, which avoids the loss of digits.

The chi-square of a difference between polynomials can exclude some fields (such as a shift).  The
result does not depend on how these fields were removed: any linear projection along them, applied
to the difference and to its covariance, gives the same value.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
import scipy.linalg
from threadpoolctl import threadpool_limits

from bayesdist.utils.arrays import Bool, Float
from bayesdist.utils.distributions import chi2_sf

RANK = 1e-9  # relative size below which an eigenvalue of a correlation matrix is rounding

F = TypeVar("F", bound=Callable[..., Any])


def one_thread(function: F) -> F:
    """Decorator that limits the linear algebra of a function to one thread.

    The matrices are small: a second thread gains little, and costs much on a busy machine.
    """
    limited: F = threadpool_limits.wrap(limits=1, user_api="blas")(function)
    return limited


def unit_diagonal(matrix: Float) -> tuple[Float, Float]:
    """Matrix (n, n) scaled to unit diagonal, and the square roots (n,) of its diagonal."""
    scale = np.sqrt(np.diag(matrix))
    return matrix / np.outer(scale, scale), scale


def scaled_cholesky(cov: Float) -> Float:
    """Lower Cholesky factor (n, n) of a covariance (n, n), with zero rows for zero variances."""
    free = np.flatnonzero(np.diag(cov) > 0)
    inner = np.ix_(free, free)
    unit, scale = unit_diagonal(cov[inner])
    out = np.zeros_like(cov)
    out[inner] = np.linalg.cholesky(unit) * scale[:, None]
    return out


def scaled_inverse(matrix: Float) -> Float:
    """Inverse (n, n) of a symmetric matrix with a positive diagonal."""
    unit, scale = unit_diagonal(matrix)
    inverse = np.linalg.inv(unit) / np.outer(scale, scale)
    return (inverse + inverse.T) / 2


def recolouring(before: Float, after: Float) -> Float:
    """Linear map A (D, D) with A before A^T = after; the identity if the two are equal.

    Both covariances must be positive definite apart from parameters of zero variance, which A
    leaves unchanged.
    """
    free = np.flatnonzero(np.diag(before) > 0)
    inner = np.ix_(free, free)
    old, new = (scaled_cholesky(cov[inner]) for cov in (before, after))
    out = np.eye(len(before))
    out[inner] = scipy.linalg.solve_triangular(old, new.T, trans="T", lower=True).T
    return out


class FieldTest(NamedTuple):
    """Chi-square test of a difference between two distortion fields."""

    chi2: float
    dof: int  # rank of the covariance
    p_value: float  # probability of a larger chi-square if the fields are equal

    @classmethod
    def of(cls, white: Float, *, shrink: float = 1.0) -> FieldTest:
        """Test of differences `white` (dof,) that were divided by their errors (whitened).

        The chi-square is multiplied by `shrink`.
        """
        chi2, dof = float(white @ white) * shrink, len(white)
        return cls(chi2, dof, float(chi2_sf(chi2, dof)))


def chi_square(
    difference: Float,
    cov: Float,
    *,
    without: Float | None = None,
    norm: Float | None = None,
    draws: float = np.inf,
) -> FieldTest:
    """Chi-square test of a difference between coefficients, optionally excluding some fields.

    Parameters
    ----------
    difference : ndarray, shape (n,)
        Differences between the coefficients.
    cov : ndarray, shape (n, n)
        Covariance of the difference, before any field is removed. Terms of zero variance are
        excluded from the test.
    without : ndarray, shape (n, q), optional
        Coefficients of the fields to exclude.
    norm : ndarray, shape (n,), optional
        Mean square over the detector of each basis function, to weight the terms.
    draws : float
        Effective number of draws from which `cov` was estimated. The inverse of an estimated
        covariance is too large by (draws - 1) / (draws - dof - 2) (Hartlap et al. 2007); this is
        corrected.

    Returns
    -------
    FieldTest
    """
    varying = known_terms(cov)
    y, C = difference[varying], cov[np.ix_(varying, varying)]
    if norm is not None:
        root = np.sqrt(norm[varying])
        y, C = root * y, root[:, None] * C * root
    if without is not None:
        fields = without[varying] if norm is None else without[varying] * root[:, None]
        length = np.linalg.norm(fields, axis=0)
        if (length > 0).any():
            free = scipy.linalg.null_space((fields[:, length > 0] / length[length > 0]).T)
            y, C = free.T @ y, free.T @ C @ free
    white = y @ determined(C)
    shrink = 1.0
    if np.isfinite(draws):
        shrink = max(draws - len(white) - 2, 1.0) / (draws - 1) if draws > 2 else 0.0
    return FieldTest.of(white, shrink=shrink)


def known_terms(cov: Float) -> Bool:
    """Boolean mask (n,) that is True for parameters of non-zero variance in `cov` (n, n)."""
    variance = np.diag(cov)
    return np.asarray(variance > 1e-20 * variance.max(initial=0.0))


def determined(matrix: Float, rank: float = RANK) -> Float:
    """Matrix R (n, r) such that R R^T is the pseudo-inverse of a positive semidefinite matrix.

    The matrix is scaled to unit diagonal first; its eigenvalues below `rank` times the largest
    count as zero.  r is the number of other eigenvalues.
    """
    diagonal = np.diag(matrix)
    positive = diagonal > 0
    unit = np.where(positive, 1.0 / np.sqrt(np.where(positive, diagonal, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(unit[:, None] * matrix * unit)
    good = values > rank * values.max(initial=1e-300)
    return np.asarray(unit[:, None] * vectors[:, good] / np.sqrt(values[good]))
