"""In-place operations on large symmetric matrices that release the GIL.

The routines are those of SciPy's LAPACK and BLAS.  SciPy's wrappers hold the global interpreter
lock while they run, so that threads would have to wait; calls through ctypes release it.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
from numba.extending import get_cython_function_address

from bayesdist.utils.arrays import Float


def _routine(module: str, name: str, n_arguments: int) -> Any:
    address = get_cython_function_address(f"scipy.linalg.{module}", name)
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * n_arguments)(address)


_POTRF, _POTRI = (_routine("cython_lapack", name, 5) for name in ("dpotrf", "dpotri"))
_TRSM, _SYRK = _routine("cython_blas", "dtrsm", 11), _routine("cython_blas", "dsyrk", 10)


def add_square(total: Float, rows: Float) -> None:
    """Add R^T R to the lower triangle of the matrix `total` (n, n), with R = `rows` (m, n).

    Both are C-contiguous float64 arrays; otherwise ValueError is raised.
    """
    n, m, unity = (
        _order(total, total.flags.c_contiguous),
        ctypes.c_int(len(rows)),
        ctypes.c_double(1),
    )
    fits = rows.shape == (len(rows), n.value) and rows.flags.c_contiguous
    if not (fits and rows.dtype == np.float64):
        raise ValueError("rows of float64 as long as those of the matrix are expected, contiguous")
    # BLAS reads C arrays as transposed: the lower triangle is the upper one, rows are columns
    at = (_at(unity), rows.ctypes.data, _at(n), _at(unity), total.ctypes.data, _at(n))
    _SYRK(b"U", b"N", _at(n), _at(m), *at)


def cholesky(matrix: Float) -> Float:
    """Lower Cholesky factor (n, n) of a symmetric matrix, computed in place.

    `matrix` must be a C-contiguous float64 array and is overwritten.  Raises
    numpy.linalg.LinAlgError if it is not positive definite.
    """
    n, info = _order(matrix, matrix.flags.c_contiguous), ctypes.c_int()
    # LAPACK reads the C array as its transpose, which is equal since the matrix is symmetric
    _POTRF(b"L", _at(n), matrix.ctypes.data, _at(n), _at(info))
    if info.value:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    for k, row in enumerate(matrix):
        row[:k] = 0.0
    return matrix.T


def inverse_of(factor: Float) -> Float:
    """Lower triangle (n, n) of (L L^T)^-1, with zeros above; `factor` L is overwritten.

    L is the result of `cholesky`.  Raises LinAlgError if it is singular.
    """
    n, info = _order(factor, factor.flags.f_contiguous), ctypes.c_int()
    _POTRI(b"L", _at(n), factor.ctypes.data, _at(n), _at(info))
    if info.value:
        raise np.linalg.LinAlgError("the factor is singular")
    return factor


def divided(factor: Float, values: Float) -> Float:
    """Solve L x = `values` (n, n) in place, with the lower triangular `factor` L (n, n).

    Both arrays must be Fortran-contiguous and of equal shape; otherwise ValueError is raised.
    """
    n, unity = _order(factor, factor.flags.f_contiguous), ctypes.c_double(1.0)
    if _order(values, values.flags.f_contiguous).value != n.value:
        raise ValueError("the shape of the values differs from that of the factor")
    sides = (b"L", b"L", b"N", b"N")
    at = (factor.ctypes.data, _at(n), values.ctypes.data, _at(n))
    _TRSM(*sides, _at(n), _at(n), _at(unity), *at)
    return values


def _order(matrix: Float, contiguous: bool) -> ctypes.c_int:
    """Order of a square matrix; raises ValueError unless it is contiguous and float64."""
    n = len(matrix)
    if matrix.shape != (n, n) or matrix.dtype != np.float64 or not contiguous:
        raise ValueError("a square matrix of float64 is expected, contiguous in the order stated")
    return ctypes.c_int(n)


def _at(value: Any) -> Any:
    return ctypes.addressof(value)
