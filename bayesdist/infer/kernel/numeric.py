"""Elementary functions and polynomials of scalars and lanes.

exp is a branch-free polynomial, since the library function cannot be vectorised.  The logarithm of
a product is computed from the exponents, read from the bits of the doubles and added, and the
mantissas, which are multiplied.

By default LLVM uses half the vector width of AVX-512, because occasional use of full vectors can
reduce the clock rate.  The passes consist of vector code and are a third faster with full width.
"""

from __future__ import annotations

from typing import Any

import numba as nb
from numba import config, types
from numba.extending import intrinsic

from bayesdist.infer.kernel.lanes import (
    FAST,
    HAS_512,
    INNER,
    WIDE,
    Lanes,
    larger,
    load_wide,
    near_inverse_root,
    put,
    spread,
)

LOWEST = -700.0  # exp(-700) = 1e-304 is negligible compared with the larger term of a mixture
ROUND = 6755399441055744.0  # 1.5 * 2^52: adding it leaves the nearest integer in the low bits
LOG2_E = 1.4426950408889634
# ln 2 in two parts, the first with trailing zeros, so that n times it is exact (Cody and Waite)
LN2_HIGH, LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10

WHOLE = HAS_512 and config.CPU_FEATURES is None  # a choice by the user takes precedence


def _same_bits(element: Any) -> Any:
    """Intrinsic that reinterprets the bits of a number, or of lanes, as another type."""

    @intrinsic
    def same(typingctx: Any, x: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            return builder.bitcast(values[0], context.get_value_type(signature.return_type))

        return (Lanes(x.width, element) if isinstance(x, Lanes) else element)(x), build

    return same


bits_of, from_bits = _same_bits(types.int64), _same_bits(types.float64)


# Inlined by LLVM rather than by numba: adding and subtracting ROUND must not be reordered in a loop
# that may reorder its sums. Always inlined: a function that is called is compiled twice, and which
# version is used (hence the last bit of a sum) would depend on whether the cache was warm.
@nb.njit(**INNER, forceinline=True, fastmath={"contract"})
def exp_negative(x):
    """exp(x) for x <= 0, accurate to two units in the last place; exp(-700) for x < -700."""
    x = larger(x, LOWEST)
    shifted = x * LOG2_E + ROUND
    n = shifted - ROUND
    r = (x - n * LN2_HIGH) - n * LN2_LOW
    # best polynomial approximation of degree 11 to exp on |r| <= ln(2) / 2; error 3e-18
    p = 2.5110049204818658e-08
    p = p * r + 2.763265472252779e-07
    p = p * r + 2.755724088722987e-06
    p = p * r + 2.4801485441561313e-05
    p = p * r + 0.00019841269890076403
    p = p * r + 0.0013888888952352863
    p = p * r + 0.008333333333319589
    p = p * r + 0.04166666666648795
    p = p * r + 0.1666666666666668
    p = p * r + 0.5000000000000019
    p = p * r + 1.0
    p = p * r + 1.0
    # 2^n by adding n to the exponent
    return from_bits(bits_of(p) + (bits_of(shifted) << 52))


@nb.njit(**INNER, forceinline=True, fastmath={"contract"})
def _nearer(x, r):
    """Improve an approximation r of 1 / sqrt(x): raises its relative error to the 4th power."""
    e = 1.0 - (x * r) * r
    return r + r * (e * (0.5 + e * (0.375 + e * 0.3125)))


if HAS_512:

    @nb.njit(**INNER, forceinline=True)
    def _near(x):
        return near_inverse_root(x)

else:

    @nb.njit(**INNER, forceinline=True)
    def _near(x):
        # halving and negating the exponent gives an accuracy of 3.5 %
        return _nearer(x, from_bits(0x5FE6EB50C7B537A9 - (bits_of(x) >> 1)))


@nb.njit(**INNER, forceinline=True)
def inverse_root(x):
    """1 / sqrt(x) of positive normal lanes, accurate to two units in the last place.

    Division and square root share one unit of the processor and would take longer than all other
    arithmetic of a star.
    """
    return _nearer(x, _near(x))


# -- polynomials at the stars of a block: values by Horner's rule, and Legendre functions ----------


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


# -- SIMD vector width for which the passes are compiled -------------------------------------------


@intrinsic
def whole_vectors(typingctx: Any) -> Any:
    """Compile the calling function for the full vector width.

    This sets an attribute of that function only.  The configuration of numba, and with it the
    code and cache of all other functions in the process, is unchanged.
    """

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        if WHOLE:
            # bypasses the `add` of llvmlite, which refuses attributes with a value
            set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.none(), build
