"""Log-likelihood of all stars for many parameter vectors: the pass of which sampling consists."""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.kernel.blocks import BLOCK, PASS, share_out, threads_for
from bayesdist.infer.kernel.mixture import Constants, log_of_product, packed, total_of
from bayesdist.infer.kernel.numeric import exp_negative, inverse_root
from bayesdist.infer.kernel.polynomial import polynomial

__all__ = ["log_likelihood"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

SCRATCH = 16_000_000  # bytes of partial sums in memory at a time


@nb.njit(**PASS)
def _partial_sums(first, end, blocks, X, Y, u, v, var_u, var_v, coef, powers, rows, unit2, sums):
    order = len(powers)  # in the type: it is compiled for one order
    pu, pv, work = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    density, low = np.empty(BLOCK), np.empty(BLOCK)
    for b in range(first, end):
        g, a, e = blocks[b]
        n = e - a
        low[n:] = 0.0
        Xb, Yb, ub, vb, su, sv = X[a:e], Y[a:e], u[a:e], v[a:e], var_u[a:e], var_v[a:e]
        for d in range(len(rows)):
            cu, cv = coef[d, g, 0], coef[d, g, 1]
            for s in range(n):
                pu[s] = polynomial(cu, order, Xb[s], Yb[s])
            for s in range(n):
                pv[s] = polynomial(cv, order, Xb[s], Yb[s])
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
                root = inverse_root(au * av)
                peak, inverse = core * root, root * root
                # the smaller exponent is taken out, so that exp never overflows
                q_in = 0.5 * (ru * av + rv * au) * inverse
                q_out = (ru + rv) * half + never
                t = exp_negative(-abs(q_in - q_out))
                is_core = q_in <= q_out
                low[s] = q_in if is_core else q_out
                density[s] = peak + outlier * t if is_core else peak * t + outlier
            exponents = total_of(low, work) + n * math.log(2 * math.pi * unit2)
            sums[b, d] = log_of_product(density, n, work) - exponents


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
    rows, coef, powers = packed(constants), np.ascontiguousarray(coef), (0,) * order
    out = np.empty(len(coef))
    step = max(1, SCRATCH // (8 * max(len(blocks), 1)))
    with threads_for(len(columns[0]) * len(coef)):
        for a in range(0, len(coef), step):
            some = slice(a, a + step)
            sums = np.empty((len(blocks), len(rows[some])))
            share_out(
                _partial_sums,
                len(blocks),
                blocks,
                *columns,
                coef[some],
                powers,
                rows[some],
                constants.unit2,
                sums,
            )
            # draws along the first axis: else numpy adds in another order where there is but one
            out[some] = np.ascontiguousarray(sums.T).sum(axis=1)
    return out
