"""The fused likelihood kernel: one pass over the stars for many parameter vectors.

Polynomials are evaluated on the fly by Horner's rule from the effective coefficients, so that no
design matrix is read from memory.  The sum is taken over fixed blocks of stars and therefore does
not depend on the number of threads.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

__all__ = ["BLOCK", "blocks_of", "log_likelihood"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

BLOCK = 256  # stars whose scratch arrays stay in the first-level cache
THREADS_PAY = 200_000  # evaluations of a star below which one thread is faster
LOG_EVERY = 8  # stars multiplied together before one logarithm

NO_OUTLIERS, GAUSSIAN, UNIFORM = 0, 1, 2


def blocks_of(starts: Int) -> Int:
    """Blocks (n, 3) of (group, first star, end) that never straddle two groups."""
    out = []
    for g in range(len(starts) - 1):
        for a in range(int(starts[g]), int(starts[g + 1]), BLOCK):
            out.append((g, a, min(a + BLOCK, int(starts[g + 1]))))
    return np.array(out, dtype=np.int64).reshape(-1, 3)


@nb.njit(cache=True, fastmath={"contract", "nsz", "arcp"}, inline="always")
def _horner(coef, order, X, Y, n, out, inner):
    """Sum of c_ij X^i Y^j with i + j <= order, terms sorted as `polynomial_terms`."""
    for s in range(n):
        out[s] = 0.0
    for i in range(order, -1, -1):
        first = order
        c = coef[first * (first + 1) // 2 + (order - i)]
        for s in range(n):
            inner[s] = c
        for j in range(order - i - 1, -1, -1):
            total = i + j
            c = coef[total * (total + 1) // 2 + j]
            for s in range(n):
                inner[s] = inner[s] * Y[s] + c
        for s in range(n):
            out[s] = out[s] * X[s] + inner[s]


@nb.njit(cache=True, parallel=True, fastmath={"contract", "nsz", "arcp"})
def _partial_sums(blocks, X, Y, u, v, var_u, var_v, coef, order, j2, lf, l1f, out, kind, unit2):
    n_blocks, n_draws = len(blocks), len(j2)
    sums = np.empty((n_blocks, n_draws))
    for b in nb.prange(n_blocks):
        g, a, e = blocks[b]
        n = e - a
        pu, pv, inner = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
        Xb, Yb = X[a:e], Y[a:e]
        for d in range(n_draws):
            _horner(coef[d, g, 0], order, Xb, Yb, n, pu, inner)
            _horner(coef[d, g, 1], order, Xb, Yb, n, pv, inner)
            # densities are kept in units of 1 / unit2, so that a product of eight stays in range
            cin = math.exp(l1f[d])
            if kind == GAUSSIAN:
                cout = math.exp(lf[d]) * unit2 / out[d]
            elif kind == UNIFORM:
                cout = math.exp(lf[d]) * 2 * math.pi * unit2 / out[d]
            else:
                cout = 0.0
            total, product, count = 0.0, 1.0, 0
            for s in range(n):
                ru, rv = u[a + s] - pu[s], v[a + s] - pv[s]
                au, av = var_u[a + s] + j2[d], var_v[a + s] + j2[d]
                qin = 0.5 * (ru * ru / au + rv * rv / av)
                peak = cin * unit2 / math.sqrt(au * av)
                if kind == NO_OUTLIERS:
                    total -= qin
                    product *= peak
                else:
                    qout = 0.5 * (ru * ru + rv * rv) / out[d] if kind == GAUSSIAN else 0.0
                    low = min(qin, qout)
                    t = math.exp(low - max(qin, qout))
                    total -= low
                    product *= peak + cout * t if qin <= qout else peak * t + cout
                count += 1
                if count == LOG_EVERY:
                    total += math.log(product)
                    product, count = 1.0, 0
            sums[b, d] = total + math.log(product) - n * math.log(2 * math.pi * unit2)
    return sums


def log_likelihood(
    blocks: Int,
    columns: tuple[Float, Float, Float, Float, Float, Float],
    coef: Float,
    order: int,
    constants: tuple[Float, Float, Float, Float],
    kind: int,
    unit2: float,
) -> Float:
    """Log-likelihood of all stars for many parameter vectors.

    Parameters
    ----------
    blocks : ndarray of int, shape (n, 3)
        From `blocks_of`.
    columns : tuple of ndarray, shape (N,)
        X, Y, u, v, var_u, var_v.
    coef : ndarray, shape (D, G, 2, K)
        Effective coefficients of the scaled powers X^i Y^j.
    order : int
    constants : tuple of ndarray, shape (D,)
        j^2, log f, log(1 - f) and the variance (or area) of the outliers.
    kind : int
        `NO_OUTLIERS`, `GAUSSIAN` or `UNIFORM`.
    unit2 : float
        A typical variance, which makes densities numbers of order one.

    Returns
    -------
    ndarray, shape (D,)
    """
    # threads that wait for each other cost more than they bring on little work
    threads = nb.get_num_threads()
    nb.set_num_threads(threads if len(columns[0]) * len(coef) > THREADS_PAY else 1)
    sums = _partial_sums(
        blocks, *columns, np.ascontiguousarray(coef), order, *constants, kind, unit2
    )
    nb.set_num_threads(threads)
    return sums.sum(axis=0)
