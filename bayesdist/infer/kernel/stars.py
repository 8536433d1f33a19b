"""Passes with results per star: residuals and outlier probabilities."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from bayesdist.infer.kernel.blocks import PASS, lay_out, share_out, star_room, threads_for
from bayesdist.infer.kernel.mixture import Constants, packed
from bayesdist.infer.kernel.numeric import exp_negative
from bayesdist.infer.kernel.polynomial import evaluate
from bayesdist.infer.kernel.vectors import whole_vectors
from bayesdist.utils.arrays import Float, Int


@nb.njit(**PASS)
def _residuals(first, end, stars, model, blocks, columns, coef, order, out):
    whole_vectors()
    for b in range(first, end):
        g, a, e = blocks[b]
        lay_out(columns, a, e, stars)
        evaluate(coef[g], order, stars, e - a, model)
        for s in range(e - a):
            out[a + s, 0] = stars[2, s] - model[0, s]
            out[a + s, 1] = stars[3, s] - model[1, s]


def residuals(blocks: Int, columns: tuple[Float, ...], coef: Float, order: int) -> Float:
    """Residuals of the stars: data minus model.

    Parameters
    ----------
    blocks : ndarray of int, shape (n, 3)
        Pieces of size `BLOCK` from `pieces_of`.
    columns : tuple of ndarray, shape (N,)
        X, Y, u, v, var_u, var_v.
    coef : ndarray, shape (G, 2, K)
        Effective coefficients of the scaled powers.
    order : int
        Polynomial order.

    Returns
    -------
    ndarray, shape (N, 2)
    """
    out = np.empty((len(columns[0]), 2))
    with threads_for(len(out)):
        share_out(
            _residuals,
            len(blocks),
            blocks,
            columns,
            np.ascontiguousarray(coef),
            order,
            out,
            room=star_room,
        )
    return out


@nb.njit(**PASS)
def _memberships(first, end, stars, model, blocks, columns, coef, order, rows, unit2, out):
    whole_vectors()
    each = len(rows) // len(out)
    share, constant = 1.0 / each, math.log(2 * math.pi * unit2)
    for b in range(first, end):
        g, a, e = blocks[b]
        n = e - a
        lay_out(columns, a, e, stars)
        for d in range(len(rows)):
            mean = out[d // each]
            evaluate(coef[d, g], order, stars, n, model)
            for s in range(n):
                ru, rv = stars[2, s] - model[0, s], stars[3, s] - model[1, s]
                iu, iv = 1.0 / (stars[4, s] + rows[d, 0]), 1.0 / (stars[5, s] + rows[d, 0])
                q_in = 0.5 * (ru * ru * iu + rv * rv * iv)
                q_out = (ru * ru + rv * rv) * rows[d, 3] + rows[d, 4]
                t = exp_negative(-abs(q_in - q_out))
                is_core = q_in <= q_out
                peak = rows[d, 1] * math.sqrt(iu * iv)
                d_in = peak if is_core else peak * t
                d_out = rows[d, 2] * t if is_core else rows[d, 2]
                loglik = math.log(d_in + d_out) - min(q_in, q_out) - constant
                mean[0, a + s] += share * d_out / (d_in + d_out)
                mean[1, a + s] += share * loglik
                mean[2, a + s] += share * loglik * loglik


def memberships(
    blocks: Int,
    columns: tuple[Float, ...],
    coef: Float,
    order: int,
    constants: Constants,
    each: int,
) -> Float:
    """Outlier probability, log-likelihood and its square for each star, averaged over draws.

    Parameters
    ----------
    blocks, columns, order
        See `residuals`.
    coef : ndarray, shape (D, G, 2, K)
        Effective coefficients of the scaled powers for D draws.
    constants : Constants
        Constants of the mixture for the D draws.
    each : int
        Number of consecutive draws over which the results are averaged.

    Returns
    -------
    ndarray, shape (D / each, 3, N)
    """
    out = np.zeros((len(coef) // each, 3, len(columns[0])))
    with threads_for(4 * out.shape[2] * len(coef)):
        share_out(
            _memberships,
            len(blocks),
            blocks,
            columns,
            np.ascontiguousarray(coef),
            order,
            packed(constants),
            constants.unit2,
            out,
            room=star_room,
        )
    return out
