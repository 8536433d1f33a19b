"""Mixture of one star in the passes: constants of a parameter vector, and densities.

Densities are in units of 1 / (2 pi unit2), unit2 a typical variance, so that they are numbers of
order one and the product of eight stays in range.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.kernel.blocks import BLOCK
from bayesdist.infer.kernel.numeric import bits_of, from_bits

__all__ = [
    "GAUSSIAN",
    "NO_OUTLIERS",
    "UNIFORM",
    "Constants",
    "log_of_product",
    "packed",
    "total_of",
]

Float = NDArray[np.float64]

NO_OUTLIERS, GAUSSIAN, UNIFORM = 0, 1, 2
NEVER = 1e300  # chi-square of an outlier where there are none
LANES = BLOCK // 8
# A product of eight within these limits has lost no digits to underflow on the way, unless its
# factors differ by more than 1e129: errors that differ by more than 1e64.
LEAST, MOST = 1e-100, 1e100


class Constants(NamedTuple):
    """Constants of the mixture at D parameter vectors."""

    j2: Float  # squared jitter (D,)
    log_f: Float
    log_1_f: Float
    out: Float  # variance of Gaussian outliers, or area of the match circle (D,)
    kind: int  # `NO_OUTLIERS`, `GAUSSIAN` or `UNIFORM`
    unit2: float  # a typical variance
    radius: float = 0.0  # of the match circle about nominal positions; 0 without one

    def of(self, rows: slice) -> Constants:
        """Constants of some of the parameter vectors."""
        j2, log_f, log_1_f, out = (c[rows] for c in self[:4])
        return Constants(j2, log_f, log_1_f, out, self.kind, self.unit2, self.radius)


def packed(constants: Constants) -> Float:
    """Rows (D, 7) for the compiled loops.

    j^2; heights of the core (for unit variances) and of the outliers; half the inverse variance of
    the outliers; the constant added to their half chi-square; f; their inverse variance.
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


@nb.njit(cache=True, forceinline=True)
def log_of_product(density, n, work):
    """Sum of the logarithms of density[:n], which has room for a block; one logarithm in all."""
    for s in range(n, BLOCK):
        density[s] = 1.0
    for s in range(LANES):
        work[s] = density[s]
    for m in range(1, 8):
        for s in range(LANES):
            work[s] *= density[s + LANES * m]
    safe = True
    for s in range(LANES):
        safe &= (work[s] > LEAST) & (work[s] < MOST)
    total = 0.0
    if safe:
        exponent = 0
        for s in range(LANES):
            bits = bits_of(work[s])
            exponent += (bits >> 52) - 1023
            work[s] = from_bits((bits & 0x000FFFFFFFFFFFFF) | 0x3FF0000000000000)
        mantissa = 1.0  # at most 2^32
        for s in range(LANES):
            mantissa *= work[s]
        total = math.log(mantissa) + exponent * 0.6931471805599453
    else:  # extreme errors or fractions: each star alone
        for s in range(n):
            total += math.log(density[s])
    return total


@nb.njit(cache=True, forceinline=True)
def total_of(values, work):
    """Sum of the values of a whole block, those of one lane first."""
    for s in range(LANES):
        work[s] = values[s]
    for m in range(1, 8):
        for s in range(LANES):
            work[s] += values[s + LANES * m]
    total = 0.0
    for s in range(LANES):
        total += work[s]
    return total
