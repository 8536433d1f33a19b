"""Polynomials in two variables by their coefficients {(i, j): c} of x^i y^j, and their names.

Coefficients of this package and of FITS headers with SIP (Shupe et al. 2005, ASP Conf. 347, 491)
multiply these powers of the pixel offsets x, y from the reference pixel:

=========  =======================  ==========
format     coefficient              multiplies
=========  =======================  ==========
bayesdist  term (i, j)              x^i y^j
SIP        A_p_q, B_p_q, AP_, BP_   x^p y^q
=========  =======================  ==========

Names of other formats are in their own modules.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from math import comb, isclose

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.errors import DegenerateError
from bayesdist.model import polynomial_terms
from bayesdist.model.basis import polynomial_values
from bayesdist.utils.arrays import Float

Coefficients = Mapping[tuple[int, int], float]

SINGULAR = 1e-12  # determinant over the largest coefficient squared

_SIP = re.compile(r"(A|B|AP|BP|AE|BE)_(\d)_(\d)")
# Search for an extremum: points per axis of the starting grid, and number of points to refine.
_GRID, _BEST = 65, 8
_HALVINGS = 30  # of the grid step; the remaining error is below rounding at a smooth maximum
_BORDER = 2**16  # most steps along an edge, because a stated size may be a misprint


def sip_keyword(prefix: str, i: int, j: int) -> str:
    """Keyword that multiplies x^i y^j, as ``sip_keyword("A", 2, 0) == "A_2_0"``."""
    return f"{prefix}_{i}_{j}"


def sip_powers(keyword: str) -> tuple[str, int, int] | None:
    """Prefix and powers (i, j) of a SIP keyword or of its sigma; None for any other keyword."""
    match = _SIP.fullmatch(keyword)
    return None if match is None else (match[1], int(match[2]), int(match[3]))


def coefficient_matrix(coefficients: Coefficients, order: int | None = None) -> Float:
    """Matrix (n + 1, n + 1) with element [i, j] the coefficient of x^i y^j.

    Terms above the total `order` are left out, as astropy.wcs does.
    """
    selected = {k: c for k, c in coefficients.items() if order is None or sum(k) <= order}
    n = max((max(k) for k in selected), default=0)
    out = np.zeros((n + 1, n + 1))
    for (i, j), c in selected.items():
        out[i, j] = c
    return out


def evaluate(
    coefficients: Coefficients, x: ArrayLike, y: ArrayLike, order: int | None = None
) -> Float:
    """Values of a polynomial at points of any shape; terms above the total `order` are left out."""
    return polynomial_values(coefficient_matrix(coefficients, order), x, y)


def substitution(order: int, M: Float) -> Float:
    """Matrix (K, K) that converts terms under the linear map (x, y) = M (X, Y).

    Column k holds the coefficients, in powers of X and Y, of term k in powers of x and y.
    """
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


def propagated_sigma(jacobian: Float, cov: Float) -> Float:
    """Standard deviations (K,) of K quantities with this Jacobian (K, P) and covariance (P, P)."""
    variance = np.einsum("kl,lm,km->k", jacobian, cov, jacobian, optimize=True)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))  # -1e-40 is a rounded zero


def require_regular(linear: Float, chip: int) -> None:
    """Raise DegenerateError if the linear part (2, 2) of a chip is singular."""
    if abs(np.linalg.det(linear)) <= SINGULAR * np.abs(linear).max() ** 2:
        raise DegenerateError(
            f"the linear part of chip {chip} is singular",
            do="check that the stars cover the detector in x and in y",
        )


def largest_magnitude(
    coefficients: Coefficients,
    x_range: tuple[float, float],
    y_range: tuple[float, float],
    order: int | None = None,
) -> float:
    """Largest |p(x, y)| over a rectangle including its border.

    The border is sampled at unit steps and the interior on a grid. The best points are then refined
    with successively halved steps, so that the result is a maximum rather than a sample.

    Parameters
    ----------
    coefficients : mapping
        Coefficients {(i, j): c} of x^i y^j.
    x_range, y_range : tuple of float
        Lowest and highest values of x and of y.
    order : int, optional
        Terms above this total order are left out.

    Returns
    -------
    float
    """
    c = coefficient_matrix(coefficients, order)
    low = np.array([x_range[0], y_range[0]], float)
    high = np.array([x_range[1], y_range[1]], float)
    x, y = _candidates(low, high)
    values = np.abs(polynomial_values(c, x, y))
    start = np.argsort(values)[-_BEST:]
    best = np.stack([x[start], y[start]], axis=1)  # (_BEST, 2)
    step = (high - low) / (_GRID - 1)
    around = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 2), axis=-1).reshape(-1, 2)
    for _ in range(_HALVINGS):
        near = np.clip(best[:, None] + around * step, low, high)
        size = np.abs(polynomial_values(c, near[..., 0], near[..., 1]))
        best = np.take_along_axis(near, size.argmax(axis=1)[:, None, None], axis=1)[:, 0]
        step = step / 2
    return float(size.max())


def _candidates(low: Float, high: Float) -> tuple[Float, Float]:
    """Points on a grid over the rectangle, and at unit steps along its border."""
    gx, gy = np.meshgrid(*np.linspace(low, high, _GRID).T)
    ex, ey = (
        np.linspace(a, b, min(int(np.ceil(b - a)), _BORDER) + 1)
        for a, b in zip(low, high, strict=True)
    )
    x = [gx.ravel(), ex, ex, np.full(ey.size, low[0]), np.full(ey.size, high[0])]
    y = [gy.ravel(), np.full(ex.size, low[1]), np.full(ex.size, high[1]), ey, ey]
    return np.concatenate(x), np.concatenate(y)


def radial_orders(
    x: Mapping[tuple[int, int], float], y: Mapping[tuple[int, int], float]
) -> frozenset[int]:
    """Orders n at which coefficients {(i, j): c} include those of a purely radial distortion.

    A distortion k r^(n-1) (x, y), with n odd, has the coefficients k binomial((n-1)/2, j) of
    x^(n-2j) y^2j along x, and those with x and y exchanged along y. Other terms of that order may
    be present.
    """
    orders = {i + j for i, j in x} | {i + j for i, j in y}
    out = set()
    for n in orders:
        k = x.get((n, 0), 0.0)
        if n < 3 or n % 2 == 0 or k == 0:
            continue
        half = (n - 1) // 2
        wanted = [comb(half, j) * k for j in range(half + 1)]
        along_x = [x.get((n - 2 * j, 2 * j), 0.0) for j in range(half + 1)]
        along_y = [y.get((2 * j, n - 2 * j), 0.0) for j in range(half + 1)]
        coefficients = [*along_x, *along_y]
        if all(isclose(a, b, rel_tol=1e-9) for a, b in zip(coefficients, 2 * wanted, strict=True)):
            out.add(n)
    return frozenset(out)
