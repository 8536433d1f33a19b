"""Polynomials at the stars of a block: values by Horner's rule, and Legendre functions."""

from __future__ import annotations

import numba as nb

from bayesdist.infer.kernel.lanes import FAST, INNER, WIDE, load_wide, put, spread
from bayesdist.infer.kernel.vectors import whole_vectors


@nb.njit(**INNER, fastmath=FAST)
def evaluate(coef, order, stars, n, out):
    """Write the sums of c_ij X^i Y^j with i + j <= order, for both axes, to out (2, BLOCK).

    `coef` (2, K) are in the order of `polynomial_terms`; X and Y are the first two rows of `stars`.
    """
    whole_vectors()
    cu, cv = coef[0], coef[1]
    for s in range(0, n, WIDE):
        x, y = load_wide(stars, 0, s), load_wide(stars, 1, s)
        u = v = spread(0.0, x)
        for i in range(order, -1, -1):
            k = order * (order + 1) // 2 + (order - i)
            inner_u, inner_v = spread(cu[k], x), spread(cv[k], x)
            for j in range(order - i - 1, -1, -1):
                k = (i + j) * (i + j + 1) // 2 + j
                inner_u, inner_v = inner_u * y + cu[k], inner_v * y + cv[k]
            u, v = u * x + inner_u, v * x + inner_v
        put(out, 0, s, u)
        put(out, 1, s, v)


@nb.njit(**INNER, fastmath=FAST)
def legendre(stars, n, top, P, Q):
    """Write the Legendre polynomials P[k, s] = P_k(X[s]) and Q[k, s] = P_k(Y[s]) for k <= top.

    X and Y are the first two rows of `stars`.
    """
    whole_vectors()
    for s in range(0, n, WIDE):
        x, y = load_wide(stars, 0, s), load_wide(stars, 1, s)
        a = b = spread(1.0, x)
        p, q = x, y
        put(P, 0, s, a)
        put(Q, 0, s, a)
        for k in range(1, top + 1):
            put(P, k, s, p)
            put(Q, k, s, q)
            part = 1.0 / (k + 1)
            a, p = p, x * p * (2.0 - part) - a * (1.0 - part)
            b, q = q, y * q * (2.0 - part) - b * (1.0 - part)
