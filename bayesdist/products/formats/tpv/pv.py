"""PVi_m of the TPV convention: which powers each multiplies, and the algebra of conversions.

With (X, Y) = CD (p - CRPIX) in degrees and r its length, PV1_m multiplies the m-th of

    1, X, Y, r, X^2, XY, Y^2, X^3, ..., Y^3, r^3, X^4, ...

(after each odd order n comes r^n, up to the 7th order), and PV2_m the same with X and Y exchanged.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.model import polynomial_terms

__all__ = ["HIGHEST", "POWERS", "RADIAL", "pv_value", "pv_values_of", "substitution"]

Float = NDArray[np.float64]
Powers = tuple[int, int]

HIGHEST = 7  # order of a TPV
KEYWORD = re.compile(r"PV([12])_(\d+)$")


def _numbers() -> tuple[dict[int, Powers], dict[int, int]]:
    """Powers of X and Y, and powers of r, each by m."""
    powers, radial, m = {}, {}, 0
    for n in range(HIGHEST + 1):
        for term in polynomial_terms(n)[-(n + 1) :]:
            powers[m] = term
            m += 1
        if n % 2:
            radial[m] = n
            m += 1
    return powers, radial


POWERS, RADIAL = _numbers()
_NUMBER_OF = {term: m for m, term in POWERS.items()}


def pv_value(axis: int, pv: Mapping[int, float], X: ArrayLike, Y: ArrayLike) -> Float:
    """Value of the polynomial of an axis (0 or 1) at intermediate coordinates, degrees."""
    first, second = (np.asarray(v, float) for v in ((X, Y) if axis == 0 else (Y, X)))
    r = np.hypot(first, second)
    out = np.zeros(first.shape)
    for m, value in pv.items():
        if m in RADIAL:
            out += value * r ** RADIAL[m]
        else:
            i, j = POWERS[m]
            out += value * first**i * second**j
    return out


def pv_values_of(axis: int, terms: tuple[Powers, ...], values: Float) -> dict[int, float]:
    """PVi_m of an axis, by m, from the coefficients (K,) of powers of X and Y."""
    named = {
        _NUMBER_OF[term if axis == 0 else term[::-1]]: float(value)
        for term, value in zip(terms, values, strict=True)
    }
    return dict(sorted(named.items()))


def substitution(order: int, M: Float) -> Float:
    """Matrix (K, K) whose column k has the powers of (X, Y) of term k in (x, y) = M (X, Y)."""
    terms = polynomial_terms(order)
    index = {term: k for k, term in enumerate(terms)}
    out = np.zeros((len(terms), len(terms)))
    for k, (i, j) in enumerate(terms):
        for a in range(i + 1):
            for b in range(j + 1):
                by_x = comb(i, a) * M[0, 0] ** a * M[0, 1] ** (i - a)
                by_y = comb(j, b) * M[1, 0] ** b * M[1, 1] ** (j - b)
                out[index[a + b, i + j - a - b], k] += by_x * by_y
    return out
