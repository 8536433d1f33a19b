"""The error of a pair that a published formal uncertainty implies.

WSDC D-T033, section 6, draws at each position of the array four vectors, to all combinations of
+-sigma_x and +-sigma_y, and prints the largest radius hypot(sigma_x, sigma_y).  Pairs that lie
evenly over the array determine products of Legendre polynomials independently of each other: the
product of degrees i and j has the variance (2i + 1)(2j + 1) / N in a corner, where the radius is
largest.
"""

from __future__ import annotations

from math import sqrt

from bayesdist.errors import InputError
from bayesdist.model.basis import polynomial_terms

__all__ = ["implied_sigma"]


def implied_sigma(radius_max: float, n_pairs: int, *, order: int = 4) -> float:
    """Error of a pair, equal on both axes, that a largest radius implies.

    `radius_max`: largest hypot(sigma_x, sigma_y) of a polynomial's position over the array.
    `n_pairs`: pairs that determine the polynomial, evenly over the array. `order`: of the
    polynomial. The result is in the unit of the radius. InputError for no pairs.
    """
    if n_pairs < 1:
        raise InputError(f"{n_pairs} pairs are given", do="give one pair or more")
    corner = sum((2 * i + 1) * (2 * j + 1) for i, j in polynomial_terms(order))
    return radius_max / sqrt(2 * corner / n_pairs)
