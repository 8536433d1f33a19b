"""Constants of the outlier mixture as used in the compiled loops.

Densities are in units of 1 / (2 pi unit2), with unit2 a typical variance.  They are then of order
one, and the product of eight densities stays in range.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from bayesdist.infer.kernel.blocks import BLOCK
from bayesdist.infer.kernel.lanes import INNER, WIDTH, choose, load, product, spread, total
from bayesdist.infer.kernel.numeric import bits_of, from_bits
from bayesdist.infer.kernel.vectors import whole_vectors
from bayesdist.utils.arrays import Float

NO_OUTLIERS, GAUSSIAN, UNIFORM = 0, 1, 2
NEVER = 1e300  # chi-square of outliers if the model has none
# A product of eight densities within these limits has not lost digits by underflow, unless its
# factors differ by more than 1e129, that is, errors by more than 1e64.
LEAST, MOST = 1e-100, 1e100


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
        """Constants of a subset of the parameter vectors."""
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
