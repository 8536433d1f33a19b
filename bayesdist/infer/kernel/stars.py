"""Passes that give a number for each star: residuals, and outlier probabilities."""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.kernel.blocks import BLOCK, PASS, share_out, threads_for
from bayesdist.infer.kernel.mixture import Constants, packed
from bayesdist.infer.kernel.numeric import exp_negative
from bayesdist.infer.kernel.polynomial import horner

__all__ = ["memberships", "residuals"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]


@nb.njit(**PASS)
def _residuals(first, end, blocks, X, Y, u, v, coef, order, out):
    for b in range(first, end):
        g, a, e = blocks[b]
        n = e - a
        p, work = np.empty(BLOCK), np.empty(BLOCK)
        horner(coef[g, 0], order, X[a:e], Y[a:e], n, p, work)
        for s in range(n):
            out[a + s, 0] = u[a + s] - p[s]
        horner(coef[g, 1], order, X[a:e], Y[a:e], n, p, work)
        for s in range(n):
            out[a + s, 1] = v[a + s] - p[s]


def residuals(blocks: Int, columns: tuple[Float, ...], coef: Float, order: int) -> Float:
    """Data minus model (N, 2).

    `blocks` (n, 3) are `pieces_of` size `BLOCK`; `columns` (N,) are X, Y, u, v and more; `coef` (G,
    2, K) are effective coefficients of the scaled powers.
    """
    out = np.empty((len(columns[0]), 2))
    with threads_for(len(out)):
        share_out(
            _residuals,
            len(blocks),
            blocks,
            *columns[:4],
            np.ascontiguousarray(coef),
            order,
            out,
        )
    return out


@nb.njit(**PASS)
def _memberships(first, end, blocks, X, Y, u, v, var_u, var_v, coef, order, rows, unit2, out):
    share = 1.0 / len(rows)
    constant = math.log(2 * math.pi * unit2)
    for b in range(first, end):
        g, a, e = blocks[b]
        n = e - a
        pu, pv, work = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
        for s in range(a, e):
            out[0, s] = out[1, s] = out[2, s] = 0.0
        for d in range(len(rows)):
            horner(coef[d, g, 0], order, X[a:e], Y[a:e], n, pu, work)
            horner(coef[d, g, 1], order, X[a:e], Y[a:e], n, pv, work)
            for s in range(n):
                ru, rv = u[a + s] - pu[s], v[a + s] - pv[s]
                iu, iv = 1.0 / (var_u[a + s] + rows[d, 0]), 1.0 / (var_v[a + s] + rows[d, 0])
                q_in = 0.5 * (ru * ru * iu + rv * rv * iv)
                q_out = (ru * ru + rv * rv) * rows[d, 3] + rows[d, 4]
                t = exp_negative(-abs(q_in - q_out))
                is_core = q_in <= q_out
                peak = rows[d, 1] * math.sqrt(iu * iv)
                d_in = peak if is_core else peak * t
                d_out = rows[d, 2] * t if is_core else rows[d, 2]
                loglik = math.log(d_in + d_out) - min(q_in, q_out) - constant
                out[0, a + s] += share * d_out / (d_in + d_out)
                out[1, a + s] += share * loglik
                out[2, a + s] += share * loglik * loglik


def memberships(
    blocks: Int, columns: tuple[Float, ...], coef: Float, order: int, constants: Constants
) -> Float:
    """Outlier probability, log-likelihood and its square (3, N) of each star, averaged over draws.

    `coef` (D, G, 2, K) and the constants are those of D draws; other arguments as in `residuals`.
    """
    out = np.empty((3, len(columns[0])))
    with threads_for(4 * out.shape[1] * len(coef)):
        share_out(
            _memberships,
            len(blocks),
            blocks,
            *columns,
            np.ascontiguousarray(coef),
            order,
            packed(constants),
            constants.unit2,
            out,
        )
    return out
