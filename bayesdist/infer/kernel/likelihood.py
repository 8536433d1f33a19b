"""Log-likelihood of all stars for many parameter vectors: the pass that dominates sampling."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from bayesdist.infer.kernel.blocks import (
    PASS,
    lay_out,
    put_ones,
    scratch,
    share_out,
    star_room,
    threads_for,
)
from bayesdist.infer.kernel.lanes import (
    WIDTH,
    choose,
    first_lanes,
    larger,
    load,
    put,
    smaller,
    spread,
    total,
)
from bayesdist.infer.kernel.mixture import Constants, log_of_product, packed
from bayesdist.infer.kernel.numeric import exp_negative, inverse_root
from bayesdist.infer.kernel.polynomial import evaluate
from bayesdist.infer.kernel.vectors import whole_vectors
from bayesdist.utils.arrays import Float, Int

SCRATCH = 16_000_000  # bytes of partial sums in memory at a time


@nb.njit(**PASS)
def _partial_sums(
    first, end, stars, model, density, blocks, columns, coef, order, rows, unit2, sums
):
    whole_vectors()
    for b in range(first, end):
        g, a, e = blocks[b]
        n = e - a
        lay_out(columns, a, e, stars)
        put_ones(density, n)
        for d in range(len(rows)):
            evaluate(coef[d, g], order, stars, n, model)
            j2, core, outlier = rows[d, 0], rows[d, 1], rows[d, 2]
            half, never = rows[d, 3], rows[d, 4]
            exponents = spread(0.0, load(density, 0, 0))
            for s in range(0, n, WIDTH):
                ru = load(stars, 2, s) - load(model, 0, s)
                rv = load(stars, 3, s) - load(model, 1, s)
                ru, rv = ru * ru, rv * rv
                au, av = load(stars, 4, s) + j2, load(stars, 5, s) + j2
                root = inverse_root(au * av)
                peak, inverse = core * root, root * root
                q_in = 0.5 * (ru * av + rv * au) * inverse
                q_out = (ru + rv) * half + never
                # factor out the smaller exponent, so that exp never overflows
                low = smaller(q_in, q_out)
                t = exp_negative(low - larger(q_in, q_out))
                # this order avoids a denormal (slow) product for stars far off
                larger_density = choose(q_in, q_out, peak, outlier)
                density_sum = larger_density + t * choose(q_in, q_out, outlier, peak)
                put(density, 0, s, first_lanes(n - s, density_sum, 1.0))
                exponents += first_lanes(n - s, low, 0.0)
            constant = total(exponents) + n * math.log(2 * math.pi * unit2)
            sums[b, d] = log_of_product(density) - constant


def log_likelihood(
    blocks: Int,
    columns: tuple[Float, ...],
    coef: Float,
    order: int,
    constants: Constants,
) -> Float:
    """Log-likelihood of all stars for D parameter vectors.

    Parameters
    ----------
    blocks : ndarray of int, shape (n, 3)
        Pieces of size `BLOCK` from `pieces_of`.
    columns : tuple of ndarray, shape (N,)
        X, Y, u, v, var_u, var_v.
    coef : ndarray, shape (D, G, 2, K)
        Effective coefficients of the powers X^i Y^j of the scaled pixel coordinates, for G groups.
    order : int
        Polynomial order.
    constants : Constants
        Constants of the mixture for the D parameter vectors.

    Returns
    -------
    ndarray, shape (D,)
    """
    rows, coef = packed(constants), np.ascontiguousarray(coef)
    out = np.empty(len(coef))
    step = max(1, SCRATCH // (8 * max(len(blocks), 1)))
    with threads_for(len(columns[0]) * len(coef)):
        for a in range(0, len(coef), step):
            draws = slice(a, a + step)
            sums = np.empty((len(blocks), len(rows[draws])))
            share_out(
                _partial_sums,
                len(blocks),
                blocks,
                columns,
                coef[draws],
                order,
                rows[draws],
                constants.unit2,
                sums,
                room=lambda: (*star_room(), scratch(1)),
            )
            # draws along the first axis, so that the order of summation is the same for one draw
            out[draws] = np.ascontiguousarray(sums.T).sum(axis=1)
    return out
