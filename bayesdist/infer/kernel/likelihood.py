"""Log-likelihood of all stars for many parameter vectors: the pass of which sampling consists."""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.kernel.blocks import BLOCK, threads_for
from bayesdist.infer.kernel.mixture import Constants, log_of_product, packed
from bayesdist.infer.kernel.numeric import exp_negative
from bayesdist.infer.kernel.polynomial import FAST, horner

__all__ = ["log_likelihood"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

SCRATCH = 16_000_000  # bytes of partial sums in memory at a time


@nb.njit(cache=True, nogil=True, parallel=True, fastmath=FAST)
def _partial_sums(blocks, X, Y, u, v, var_u, var_v, coef, order, rows, unit2):
    n_blocks, n_draws = len(blocks), len(rows)
    sums = np.empty((n_blocks, n_draws))
    for b in nb.prange(n_blocks):
        g, a, e = blocks[b]
        n = e - a
        pu, pv, work = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
        density, low = np.empty(BLOCK), np.zeros(BLOCK)
        Xb, Yb, ub, vb, su, sv = X[a:e], Y[a:e], u[a:e], v[a:e], var_u[a:e], var_v[a:e]
        for d in range(n_draws):
            horner(coef[d, g, 0], order, Xb, Yb, n, pu, work)
            horner(coef[d, g, 1], order, Xb, Yb, n, pv, work)
            j2, core, outlier, half, never = (
                rows[d, 0],
                rows[d, 1],
                rows[d, 2],
                rows[d, 3],
                rows[d, 4],
            )
            for s in range(n):
                ru, rv = ub[s] - pu[s], vb[s] - pv[s]
                ru *= ru
                rv *= rv
                au, av = su[s] + j2, sv[s] + j2
                inverse = 1.0 / (au * av)
                peak = core * math.sqrt(inverse)
                # the smaller exponent is taken out, so that exp never overflows
                q_in = 0.5 * (ru * av + rv * au) * inverse
                q_out = (ru + rv) * half + never
                t = exp_negative(-abs(q_in - q_out))
                is_core = q_in <= q_out
                low[s] = q_in if is_core else q_out
                density[s] = peak + outlier * t if is_core else peak * t + outlier
            total = 0.0
            for s in range(0, BLOCK, 4):
                total += (low[s] + low[s + 1]) + (low[s + 2] + low[s + 3])
            sums[b, d] = (
                log_of_product(density, n, work) - total - n * math.log(2 * math.pi * unit2)
            )
    return sums


def log_likelihood(
    blocks: Int,
    columns: tuple[Float, ...],
    coef: Float,
    order: int,
    constants: Constants,
) -> Float:
    """Log-likelihood (D,) of all stars for D parameter vectors.

    `blocks` (n, 3) are `pieces_of` size `BLOCK`; `columns` (N,) are X, Y, u, v, var_u, var_v;
    `coef` (D, G, 2, K) are effective coefficients of the scaled powers X^i Y^j.
    """
    rows, coef = packed(constants), np.ascontiguousarray(coef)
    out = np.empty(len(coef))
    step = max(1, SCRATCH // (8 * max(len(blocks), 1)))
    with threads_for(len(columns[0]) * len(coef)):
        for a in range(0, len(coef), step):
            some = slice(a, a + step)
            sums = _partial_sums(blocks, *columns, coef[some], order, rows[some], constants.unit2)
            # draws along the first axis: else numpy adds in another order where there is but one
            out[some] = np.ascontiguousarray(sums.T).sum(axis=1)
    return out
