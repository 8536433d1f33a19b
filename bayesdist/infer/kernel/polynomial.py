"""Polynomials of a block of stars: values by Horner's rule, and Legendre functions."""

from __future__ import annotations

import numba as nb

__all__ = ["horner", "legendre", "polynomial"]

# sums of products may be fused; nothing that would change NaN or infinity
FAST = {"contract", "nsz", "arcp"}


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def horner(coef, order, X, Y, n, out, inner):
    """Sum of c_ij X^i Y^j with i + j <= order, terms sorted as `polynomial_terms`."""
    for s in range(n):
        out[s] = 0.0
    for i in range(order, -1, -1):
        c = coef[order * (order + 1) // 2 + (order - i)]
        for s in range(n):
            inner[s] = c
        for j in range(order - i - 1, -1, -1):
            total = i + j
            c = coef[total * (total + 1) // 2 + j]
            for s in range(n):
                inner[s] = inner[s] * Y[s] + c
        for s in range(n):
            out[s] = out[s] * X[s] + inner[s]


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def polynomial(coef, order, x, y):
    """Sum of c_ij x^i y^j of one star, as `horner`, for an order that the compiler knows.

    Its loops are then unrolled and nothing is stored between terms: a loop over stars becomes
    vector instructions at the rate of multiply-adds.  One such loop takes one polynomial: two of
    high order exceed what the compiler unrolls.
    """
    value = 0.0
    for i in range(order, -1, -1):
        inner = 0.0
        for j in range(order - i, -1, -1):
            total = i + j
            inner = inner * y + coef[total * (total + 1) // 2 + j]
        value = value * x + inner
    return value


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def legendre(X, n, top, P):
    """P[k, s] = P_k(X[s]) for k <= top; zero beyond n."""
    for s in range(P.shape[1]):
        P[0, s] = 1.0
    if top > 0:
        for s in range(n):
            P[1, s] = X[s]
        for s in range(n, P.shape[1]):
            P[1, s] = 0.0
    for k in range(1, top):
        a, b = (2.0 * k + 1.0) / (k + 1.0), k / (k + 1.0)
        for s in range(P.shape[1]):
            P[k + 1, s] = a * P[1, s] * P[k, s] - b * P[k - 1, s]
