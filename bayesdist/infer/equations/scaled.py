"""Algebra of covariances and normal matrices: scaled to unit diagonal on the way, on one thread.

Parameters of one model differ by many powers of ten, and scaled matrices keep their digits.  The
chi-square of a difference between polynomials may leave some fields out.  It does not depend on how
these were taken out: a difference and its covariance that have both gone through any linear
projection along the same fields give one value.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
import scipy.linalg
from threadpoolctl import threadpool_limits

from bayesdist.utils.arrays import Bool, Float
from bayesdist.utils.distributions import chi2_sf

RANK = 1e-9  # eigenvalues of a correlation matrix below it are rounding

F = TypeVar("F", bound=Callable[..., Any])


def one_thread(function: F) -> F:
    """Decorator by which a function does all its linear algebra on one thread.

    The matrices are small: a second thread gains little on them, and loses much on a machine that
    has other work.
    """
    limited: F = threadpool_limits.wrap(limits=1, user_api="blas")(function)
    return limited


def unit_diagonal(matrix: Float) -> tuple[Float, Float]:
    """A matrix (n, n) scaled to unit diagonal, and the roots (n,) of its diagonal."""
    scale = np.sqrt(np.diag(matrix))
    return matrix / np.outer(scale, scale), scale


def scaled_cholesky(cov: Float) -> Float:
    """Lower root (n, n) of a covariance; rows of zeros where there is no variance."""
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
    """Linear map A (D, D) with A before A^T = after; the identity where the two are equal.

    Both are positive definite, but for parameters without variance, which A leaves as they are.
    """
    free = np.flatnonzero(np.diag(before) > 0)
    inner = np.ix_(free, free)
    old, new = (scaled_cholesky(cov[inner]) for cov in (before, after))
    out = np.eye(len(before))
    out[inner] = scipy.linalg.solve_triangular(old, new.T, trans="T", lower=True).T
    return out


class FieldTest(NamedTuple):
    """Chi-square of a whole field of differences."""

    chi2: float
    dof: int  # rank of the covariance
    p_value: float  # probability of a larger chi-square

    @classmethod
    def of(cls, white: Float, *, shrink: float = 1.0) -> FieldTest:
        """Test of independent standard normal numbers (dof,), their squares times `shrink`."""
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
    """Chi-square of a difference (n,), from which some fields may have been taken out.

    `cov` (n, n) is the covariance before that; terms without variance are no part of the test.
    `without` (n, q) are the fields, and `norm` (n,) the mean square of each term, which makes them
    comparable.  `draws` is the effective number of draws from which the covariance was estimated:
    the inverse of an estimate is too large by (n - 1) / (n - dof - 2) (Hartlap et al. 2007), which
    is corrected.
    """
    known = known_terms(cov)
    y, C = difference[known], cov[np.ix_(known, known)]
    if norm is not None:
        root = np.sqrt(norm[known])
        y, C = root * y, root[:, None] * C * root
    if without is not None:
        fields = without[known] if norm is None else without[known] * root[:, None]
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
    """Boolean mask (n,) of the parameters with variance."""
    variance = np.diag(cov)
    return np.asarray(variance > 1e-20 * variance.max(initial=0.0))


def determined(matrix: Float, rank: float = RANK) -> Float:
    """Root R (n, rank) of the inverse, R R^T, of a positive semidefinite matrix where it has one.

    Eigenvalues below `rank` times the largest, at the level of rounding by default, count as zero.
    """
    diagonal = np.diag(matrix)
    known = diagonal > 0
    unit = np.where(known, 1.0 / np.sqrt(np.where(known, diagonal, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(unit[:, None] * matrix * unit)
    good = values > rank * values.max(initial=1e-300)
    return np.asarray(unit[:, None] * vectors[:, good] / np.sqrt(values[good]))
