"""Sums over the stars of each cluster: gradients, and the moments of second derivatives."""

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.kernel.blocks import BLOCK, threads_for
from bayesdist.infer.kernel.moments import product_table
from bayesdist.infer.kernel.polynomial import FAST, legendre

__all__ = ["cluster_moments", "products_of"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

EVALUATIONS = 5  # what the sums of one star cost, in likelihood evaluations


# as in the moments of whole groups, only here may the compiler choose the order of a sum
@nb.njit(cache=True, forceinline=True, fastmath=FAST | {"reassoc"})
def _dot(a, b, n):
    """Sum of the products of the first n numbers."""
    total = 0.0
    for s in range(n):
        total += a[s] * b[s]
    return total


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _add(column, n, P, Q, top, work, out):
    """Add the moments of a column with P_i Q_j, i + j <= top, by total order, then falling i."""
    for i in range(top + 1):
        for s in range(n):
            work[s] = column[s] * P[i, s]
        for j in range(top + 1 - i):
            t = i + j
            out[t * (t + 1) // 2 + j] += _dot(work, Q[j], n)


@nb.njit(cache=True, nogil=True, parallel=True, fastmath=FAST)
def _moments(starts, X, Y, columns, order, tied):
    n_clusters, top = len(starts) - 1, 2 * order
    K, M = (order + 1) * (order + 2) // 2, (top + 1) * (top + 2) // 2
    right, weight = np.zeros((n_clusters, 2, K)), np.zeros((n_clusters, 3, M))
    for c in nb.prange(n_clusters):
        P, Q = np.empty((top + 1, BLOCK)), np.empty((top + 1, BLOCK))
        work = np.empty(BLOCK)
        for a in range(starts[c], starts[c + 1], BLOCK):
            e = min(a + BLOCK, starts[c + 1])
            n = e - a
            legendre(X[a:e], n, top, P)
            legendre(Y[a:e], n, top, Q)
            for axis in range(2):
                _add(columns[axis, a:e], n, P, Q, order, work, right[c, axis])
            for pair in range(0, 3, 1 if tied else 2):
                _add(columns[2 + pair, a:e], n, P, Q, top, work, weight[c, pair])
    return right, weight


def cluster_moments(
    X: Float, Y: Float, cluster: Int, columns: Float, order: int, n_clusters: int
) -> tuple[Float, Float]:
    """Sums of columns times basis functions over the stars of each cluster.

    Parameters
    ----------
    X, Y : ndarray, shape (N,)
        Scaled positions.
    cluster : ndarray of int, shape (N,)
        From 0 to `n_clusters` - 1.
    columns : ndarray, shape (5, N)
        Gradients by u and v of the model; second derivatives uu, uv, vv.
    order, n_clusters : int

    Returns
    -------
    right : ndarray, shape (C, 2, K)
        Gradients times the basis functions.
    weight : ndarray, shape (C, 3, M)
        Second derivatives times the basis functions of twice the order: see `products_of`.
    """
    small = cluster.astype(np.uint16 if n_clusters <= 2**16 else np.int64)  # sorted by digits
    rows = np.argsort(small, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(cluster, minlength=n_clusters))])
    # one by one: rows of a table are gathered several times as slowly
    X, Y, *several = (column.take(rows) for column in (X, Y, *columns))
    with threads_for(EVALUATIONS * len(X)):
        return _moments(starts, X, Y, np.stack(several), order, bool(several[3].any()))


def products_of(moments: Float, order: int) -> Float:
    """Sums (..., K, K) of products of two basis functions from moments (..., M)."""
    return np.asarray(np.einsum("...m,klm->...kl", moments, product_table(order), optimize=True))
