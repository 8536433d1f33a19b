"""Log-likelihood of all stars for many parameter vectors: the pass that dominates sampling.

Densities are in units of 1 / (2 pi unit2), with unit2 a typical variance.  They are then of order
one, and the product of eight densities stays in range.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from bayesdist.infer.kernel.blocks import (
    BLOCK,
    PASS,
    lay_out,
    modelled,
    put_ones,
    scratch,
    share_out,
    star_room,
    threads_for,
)
from bayesdist.infer.kernel.lanes import (
    INNER,
    WIDTH,
    choose,
    first_lanes,
    larger,
    load,
    product,
    put,
    smaller,
    spread,
    total,
)
from bayesdist.infer.kernel.numeric import (
    bits_of,
    exp_negative,
    from_bits,
    inverse_root,
    whole_vectors,
)
from bayesdist.utils.arrays import Float, Int

SCRATCH = 16_000_000  # bytes of partial sums in memory at a time

NO_OUTLIERS, GAUSSIAN, UNIFORM = 0, 1, 2
NEVER = 1e300  # chi-square of outliers if the model has none
# A product of eight densities within these limits has not lost digits by underflow, unless its
# factors differ by more than 1e129, that is, errors by more than 1e64.
LEAST, MOST = 1e-100, 1e100


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
            modelled(columns, coef[d, g], order, stars, n, model)
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
        `Stars.columns`.
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


# -- constants of the outlier mixture as used in the compiled loops --------------------------------


class Constants(NamedTuple):
    """Constants of the outlier mixture for D parameter vectors, in the unit of u, v.

    Parameters
    ----------
    j2 : ndarray, shape (D,)
        Squared jitter.
    log_f, log_1_f : ndarray, shape (D,)
        Logarithms of the outlier fraction f and of 1 - f.
    out : ndarray, shape (D,)
        Variance of Gaussian outliers, or area of the match circle.
    kind : int
        `NO_OUTLIERS`, `GAUSSIAN` or `UNIFORM`.
    unit2 : float
        Typical variance, the unit of the densities.
    radius : float
        Radius of the match circle about nominal positions; 0 for none.
    """

    j2: Float
    log_f: Float
    log_1_f: Float
    out: Float
    kind: int
    unit2: float
    radius: float = 0.0

    def of(self, rows: slice) -> Constants:
        """Constants of a subset of the parameter vectors, given by a slice."""
        j2, log_f, log_1_f, out = (c[rows] for c in self[:4])
        return Constants(j2, log_f, log_1_f, out, self.kind, self.unit2, self.radius)


def packed(constants: Constants) -> Float:
    """Constants as rows (D, 7) for the compiled loops.

    The columns are j^2, the peak densities of the core (for unit variances) and of the outliers,
    half the inverse variance of the outliers, the constant added to half their chi-square, f, and
    the inverse variance of the outliers.
    """
    j2, log_f, log_1_f, out = (np.atleast_1d(c) for c in constants[:4])
    f = np.exp(log_f)
    core = np.exp(log_1_f) * constants.unit2
    zero = np.zeros_like(j2)
    if constants.kind == GAUSSIAN:
        rows = (j2, core, f * constants.unit2 / out, 0.5 / out, zero, f, 1.0 / out)
    elif constants.kind == UNIFORM:
        rows = (j2, core, f * 2 * math.pi * constants.unit2 / out, zero, zero, f, zero)
    else:
        rows = (j2, core, zero, zero, zero + NEVER, zero, zero)
    return np.ascontiguousarray(np.stack(rows, axis=1))


@nb.njit(**INNER)
def log_of_product(density):
    """Sum of the logarithms of a block (1, BLOCK), computed with a single logarithm."""
    whole_vectors()
    mantissa = load(density, 0, 0)
    exponent, mantissa, safe = spread(0, mantissa), spread(1.0, mantissa), spread(0.0, mantissa)
    for a in range(0, BLOCK, 8 * WIDTH):
        eight = load(density, 0, a)
        for s in range(a + WIDTH, a + 8 * WIDTH, WIDTH):
            eight = eight * load(density, 0, s)
        safe += choose(LEAST, eight, choose(eight, MOST, 1.0, spread(0.0, eight)), 0.0)
        bits = bits_of(eight)
        exponent += (bits >> 52) - 1023
        mantissa = mantissa * from_bits((bits & 0x000FFFFFFFFFFFFF) | 0x3FF0000000000000)
    if total(safe) == BLOCK / 8:
        # the product of mantissas is at most 2^32
        return math.log(product(mantissa)) + total(exponent) * 0.6931471805599453
    result = 0.0
    for s in range(BLOCK):  # extreme errors or fractions: one logarithm per star
        result += math.log(density[0, s])
    return result
