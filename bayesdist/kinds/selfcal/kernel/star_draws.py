"""Marginal densities of stars of unknown position, for many draws of the model at once.

The draws are processed in SIMD lanes.  The data of a detection are read once for all of them, and
sums over the detections of a star are independent between lanes.  If the Newton search for the mode
of a star does not converge directly for a draw, `to_mode` handles that draw.

If it is doubtful which detections belong to a star, its position has several modes, which appear
and disappear as the model changes, so that an expansion about one of them would be discontinuous.
In this case the product over the detections is expanded: each choice of members gives a Gaussian in
the position with a known integral, and the integrals are added.
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.kernel.blocks import PASS, share_out
from bayesdist.infer.kernel.lanes import WIDTH, choose, larger, load, put, spread
from bayesdist.infer.kernel.numeric import bits_of, exp_negative, from_bits, whole_vectors
from bayesdist.infer.kernel.stars import legendre
from bayesdist.kinds.selfcal.kernel.star_modes import (
    CLOSE,
    MOST_STAR,
    NEAR,
    PLACE_U,
    PLACE_V,
    STILL,
    log_root,
    own_rows,
    to_mode,
)
from bayesdist.utils.arrays import Float

Flags = NDArray[np.int8]

# state of a detection: member of its star, doubtful, or false
MEMBER, DOUBTFUL, FALSE = range(3)
MOST_DOUBTFUL = 6  # maximum number of doubtful detections of a star
PIECES = 8  # number of partial sums, independent of the number of threads
STEPS = 4  # maximum number of Newton steps before a draw is passed to `to_mode`
LEAST = 1e-300  # smallest factor of a product, to avoid denormal numbers
LN2 = 0.6931471805599453
LOG_2_PI = math.log(2.0 * math.pi)

# rows of the results of a Newton step, with one draw per lane
GAIN, FAR, MANTISSA, EXPONENT, DET = range(5)
# rows of sums over members, and of each doubtful detection: curvature uu, uv, vv, gradient u, v,
# squared residual
C00, C10, C11, G0, G1, SQUARE = range(6)


@nb.njit(cache=True, forceinline=True)
def _place(coef, start, phi, offset_u, offset_v):
    """Position offset + sum phi_k coef_k in lanes; the 2 K coefficient rows begin at `start`."""
    whole_vectors()
    K = len(phi)
    u, v = load(coef, start, 0) * phi[0] + offset_u, load(coef, start + K, 0) * phi[0] + offset_v
    for k in range(1, K):
        u = u + load(coef, start + k, 0) * phi[k]
        v = v + load(coef, start + K + k, 0) * phi[k]
    return u, v


@nb.njit(cache=True, forceinline=True)
def _times(mantissa, exponent, factor):
    """Multiply a product, kept as mantissas in [1, 2) and exponents, by one more factor."""
    whole_vectors()
    bits = bits_of(mantissa * larger(factor, LEAST))
    # an integer below 2^52 in the low bits of 2^52
    exponent = exponent + (from_bits((bits >> 52) | 0x4330000000000000) - (2.0**52 + 1023.0))
    return from_bits((bits & 0x000FFFFFFFFFFFFF) | 0x3FF0000000000000), exponent


@nb.njit(cache=True)
def _newton(n, a, W, var, at, d, constants, centre, precision, p, least, found):
    """Newton step for a star without proper motion, in lanes; moves p (2, WIDTH).

    Writes to `found` (5, WIDTH): GAIN, the log prior density plus half the decrement of the step;
    FAR, the larger of the decrement and the squared step relative to their limits, or infinity if
    the curvature is not positive or the step is long; MANTISSA and EXPONENT of the product of the
    densities of the detections; DET, the determinant of the curvature.
    """
    whole_vectors()
    jitter, far_odds = load(constants, 0, d), load(constants, 1, d)
    pu, pv = load(p, 0, 0), load(p, 1, 0)
    zero = spread(0.0, pu)
    a00, a10, a11, b0, b1 = zero, zero, zero, zero, zero
    mantissa, exponent = spread(1.0, pu), zero
    for i in range(n):
        uu, uv, vv = W[a + i, 0], W[a + i, 1], W[a + i, 2]
        inverse = 1.0 / (jitter + var[a + i])
        ru, rv = load(at, 2 * i, 0) - pu, load(at, 2 * i + 1, 0) - pv
        wu, wv = ru * uu + rv * uv, ru * uv + rv * vv
        core = exp_negative((ru * wu + rv * wv) * inverse * -0.5) * inverse
        density = core + far_odds
        member = core / density
        core = member * inverse
        tie = (1.0 - member) * core * inverse
        a00 += core * uu - tie * wu * wu
        a10 += core * uv - tie * wu * wv
        a11 += core * vv - tie * wv * wv
        b0 += core * wu
        b1 += core * wv
        mantissa, exponent = _times(mantissa, exponent, density)
    du, dv = centre[0] - pu, centre[1] - pv
    g0 = du * precision[0, 0] + dv * precision[1, 0]
    g1 = du * precision[1, 0] + dv * precision[1, 1]
    gain = (du * g0 + dv * g1) * -0.5
    a00, a10, a11 = a00 + precision[0, 0], a10 + precision[1, 0], a11 + precision[1, 1]
    b0, b1 = b0 + g0, b1 + g1
    schur = a11 - a10 * a10 / a00
    z1 = b1 - a10 * b0 / a00
    dv = z1 / schur
    du = (b0 - a10 * dv) / a00
    decrement = b0 * b0 / a00 + z1 * dv
    square = du * du * W[a, 0] + du * dv * (2.0 * W[a, 1]) + dv * dv * W[a, 2]
    far = larger(decrement / CLOSE, square / ((jitter + var[a]) * STILL))
    far = choose(NEAR, decrement, math.inf, far)
    far = choose(a00, least * least, math.inf, far)
    far = choose(schur, least * least, math.inf, far)
    put(p, 0, 0, pu + du)
    put(p, 1, 0, pv + dv)
    put(found, GAIN, 0, gain + decrement * 0.5)
    put(found, FAR, 0, far)
    put(found, MANTISSA, 0, mantissa)
    put(found, EXPONENT, 0, exponent)
    put(found, DET, 0, a00 * schur)


@nb.njit(cache=True)
def _members(n, a, W, var, at, d, constants, state, centre, precision, p, members, doubtful):
    """Sums over the members of a star without proper motion, in lanes, at p (2, WIDTH).

    Writes to `members` (8, WIDTH) the sums, and mantissas and exponents of the product of the peak
    densities of the members times 2 pi.  Writes to `doubtful` seven rows (WIDTH,) per doubtful
    detection: its terms of the sums and its peak density.  Returns the number of doubtful
    detections.
    """
    whole_vectors()
    jitter = load(constants, 0, d)
    pu, pv = load(p, 0, 0), load(p, 1, 0)
    du, dv = centre[0] - pu, centre[1] - pv
    g0 = du * precision[0, 0] + dv * precision[1, 0]
    g1 = du * precision[1, 0] + dv * precision[1, 1]
    square = du * g0 + dv * g1
    zero = spread(0.0, pu)
    c00, c10, c11 = zero + precision[0, 0], zero + precision[1, 0], zero + precision[1, 1]
    mantissa, exponent, k = spread(1.0, pu), zero, 0
    for i in range(n):
        if state[a + i] == FALSE:
            continue
        inverse = 1.0 / (jitter + var[a + i])
        u, v = load(at, 2 * i, 0) - pu, load(at, 2 * i + 1, 0) - pv
        uu, uv, vv = inverse * W[a + i, 0], inverse * W[a + i, 1], inverse * W[a + i, 2]
        by_u, by_v = u * uu + v * uv, u * uv + v * vv
        square_term = u * by_u + v * by_v
        if state[a + i] == DOUBTFUL:
            row = 7 * k
            put(doubtful, row + C00, 0, uu)
            put(doubtful, row + C10, 0, uv)
            put(doubtful, row + C11, 0, vv)
            put(doubtful, row + G0, 0, by_u)
            put(doubtful, row + G1, 0, by_v)
            put(doubtful, row + SQUARE, 0, square_term)
            put(doubtful, row + 6, 0, inverse)
            k += 1
            continue
        c00, c10, c11 = c00 + uu, c10 + uv, c11 + vv
        g0, g1, square = g0 + by_u, g1 + by_v, square + square_term
        mantissa, exponent = _times(mantissa, exponent, inverse)
    put(members, C00, 0, c00)
    put(members, C10, 0, c10)
    put(members, C11, 0, c11)
    put(members, G0, 0, g0)
    put(members, G1, 0, g1)
    put(members, SQUARE, 0, square)
    put(members, 6, 0, mantissa)
    put(members, 7, 0, exponent)
    return k


@nb.njit(cache=True)
def _over_choices(members, doubtful, k, l, log_norm, log_out, least):
    """Log marginal density of the draw in lane l, summed over all 2^k choices of members.

    Up to a factor of 2 pi it has the same normalisation as the Laplace approximation, log density
    minus `log_root`.  A star without members and prior may be anywhere in the match circle.
    """
    whole_vectors()
    top, total, floor = -math.inf, 0.0, 2.0 * math.log(least)
    sure = math.log(members[6, l]) + LN2 * members[7, l]
    for choice in range(1 << k):
        c00, c10, c11 = members[C00, l], members[C10, l], members[C11, l]
        g0, g1, square, value = members[G0, l], members[G1, l], members[SQUARE, l], sure
        for i in range(k):
            if not choice >> i & 1:
                value += log_out
                continue
            row = 7 * i
            c00 += doubtful[row + C00, l]
            c10 += doubtful[row + C10, l]
            c11 += doubtful[row + C11, l]
            g0, g1 = g0 + doubtful[row + G0, l], g1 + doubtful[row + G1, l]
            square += doubtful[row + SQUARE, l]
            value += log_norm + math.log(doubtful[row + 6, l])
        det = c00 * c11 - c10 * c10
        if det > 0.0:
            square -= (c11 * g0 * g0 - 2.0 * c10 * g0 * g1 + c00 * g1 * g1) / det
            value -= 0.5 * square + max(0.5 * math.log(det), floor)
        else:
            value -= floor
        if value > top:
            total = total * math.exp(top - value) + 1.0
            top = value
        else:
            total += math.exp(value - top)
    return top + math.log(total)


@nb.njit(cache=True)
def _at_modes(n, a, W, var, at, d, constants, centre, precision, place, least, found, value):
    """Write log marginal densities of a star without proper motion (Laplace), in lanes, to `value`.

    The search for the mode starts at `place`, which is changed.  NaN if it does not converge.
    """
    whole_vectors()
    value[:] = math.nan
    for _ in range(STEPS):
        _newton(n, a, W, var, at, d, constants, centre, precision, place, least, found)
        searching = False
        for l in range(WIDTH):
            if found[FAR, l] <= 1.0:
                mantissa, exponent = found[MANTISSA, l], found[EXPONENT, l]
                value[l] = found[GAIN, l] + LN2 * exponent + n * (constants[2, d + l] - LOG_2_PI)
                value[l] += 0.5 * math.log(mantissa * mantissa / found[DET, l])
                place[0, l] = math.nan
            elif found[FAR, l] < math.inf:
                searching = True
            else:
                place[0, l] = math.nan
        if not searching:
            break


@nb.njit(**PASS)
def _log_marginals(
    start, stop, starts, group, X, Y, offset, W, var, time, factor, centre, precision, stars,
    middles, response, state, coef, G, order, constants, least, sums,
):  # fmt: skip
    whole_vectors()
    q, K, n_draws = stars.shape[1], (order + 1) * (order + 2) // 2, sums.shape[1]
    step = -(-len(stars) // PIECES)
    for piece in range(start, stop):
        S, A, b = np.zeros((2, MOST_STAR)), np.zeros((MOST_STAR, MOST_STAR)), np.zeros(MOST_STAR)
        px, py, p = np.empty(order + 1), np.empty(order + 1), np.empty(q)
        first, place, value = np.empty((2, WIDTH)), np.empty((2, WIDTH)), np.empty(WIDTH)
        newton_rows, members = np.empty((5, WIDTH)), np.empty((8, WIDTH))
        doubtful = np.empty((7 * MOST_DOUBTFUL, WIDTH))
        phi, at = np.empty((16, K)), np.empty((32, WIDTH))
        for s in range(piece * step, min((piece + 1) * step, len(stars))):
            a, n = starts[s], starts[s + 1] - starts[s]
            if n > len(phi):
                phi, at = np.empty((2 * n, K)), np.empty((4 * n, WIDTH))
            several, n_false = False, 0
            for i in range(n):
                legendre(X[a + i], Y[a + i], order, px, py, phi[i])
                several |= state[a + i] == DOUBTFUL
                n_false += state[a + i] == FALSE
            for block in range(constants.shape[1] // WIDTH):
                d = block * WIDTH
                pu = spread(stars[s, 0] - middles[s, 0], load(place, 0, 0))
                pv = spread(stars[s, 1] - middles[s, 1], pu)
                for i in range(n):
                    begin = (block * G + group[a + i]) * 2 * K
                    u, v = _place(coef, begin, phi[i], offset[a + i, 0], offset[a + i, 1])
                    pu += u * response[a + i, 0, 0] + v * response[a + i, 0, 1]
                    pv += u * response[a + i, 1, 0] + v * response[a + i, 1, 1]
                    put(at, 2 * i, 0, u)
                    put(at, 2 * i + 1, 0, v)
                put(first, 0, 0, pu)
                put(first, 1, 0, pv)
                if several:
                    k = _members(
                        n, a, W, var, at, d, constants, state, centre[s], precision[s], first,
                        members, doubtful,
                    )  # fmt: skip
                    for l in range(min(WIDTH, n_draws - d)):
                        log_norm, log_out = constants[2, d + l] - LOG_2_PI, constants[3, d + l]
                        sums[piece, d + l] += n_false * log_out + (n - n_false - k) * log_norm
                        sums[piece, d + l] += _over_choices(
                            members, doubtful, k, l, log_norm, log_out, least
                        )
                    continue
                value[:] = math.nan
                if q == 2:
                    place[:] = first
                    _at_modes(
                        n, a, W, var, at, d, constants, centre[s], precision[s], place, least,
                        newton_rows, value,
                    )  # fmt: skip
                for l in range(min(WIDTH, n_draws - d)):
                    if not math.isfinite(value[l]):
                        rows = own_rows(W, var, a, a + n)
                        for i in range(n):
                            rows[PLACE_U, i], rows[PLACE_V, i] = (
                                at[2 * i, l],
                                at[2 * i + 1, l],
                            )
                        p[:] = stars[s]
                        p[0], p[1] = first[0, l], first[1, l]
                        value[l], _ = to_mode(
                            rows, n, constants[0, d + l], constants[2, d + l], constants[3, d + l],
                            time[a : a + n] if q >= 4 else time,
                            factor[a : a + n] if q == 5 else factor,
                            centre[s], precision[s], p, S, A, b, True, least,
                        )  # fmt: skip
                        value[l] -= log_root(A, q, least)
                    sums[piece, d + l] += value[l]


def log_marginals(
    detections: tuple[Any, ...], stars: Float, middles: Float, response: Float, state: Flags,
    coef: Float, order: int, rows: Float, least: float,
) -> Float:  # fmt: skip
    """Log densities of the detections for D draws, with the parameters of S stars integrated out.

    The integral is a Laplace approximation.  For stars with doubtful detections it is the sum over
    all choices of members.

    Parameters
    ----------
    detections : tuple
        Arrays starts, group, X, Y, offset, W, var, time, factor, centre and precision.
    stars : ndarray, shape (S, q)
        Parameters of the stars at the reference solution.
    middles : ndarray, shape (S, 2)
        Sum of response times detection position over a star's detections, at the reference.
    response : ndarray, shape (N, 2, 2)
        Derivative of a star's position with respect to the position of a detection. It predicts
        where the search starts for a draw: stars + sum(response * position) - middles.
    state : ndarray of int8, shape (N,)
        `MEMBER`, `DOUBTFUL` or `FALSE` for each detection.
    coef : ndarray, shape (D, G, 2, K)
        Coefficients of the Legendre products.
    order : int
        Total order of the polynomials.
    rows : ndarray, shape (D, 3)
        Squared jitter, log of the core fraction, log density of outliers.
    least : float
        Square root of the smallest curvature allowed for the position of a star.

    Returns
    -------
    ndarray, shape (PIECES, D)
        Partial sums over the stars.
    """
    D, G, _, K = coef.shape
    blocks = -(-D // WIDTH)
    in_lanes = np.zeros((blocks, G, 2, K, WIDTH))
    for block in range(blocks):
        block_coef = coef[block * WIDTH : (block + 1) * WIDTH]
        in_lanes[block, ..., : len(block_coef)] = np.moveaxis(block_coef, 0, -1)
    j2, log_core, log_out = np.pad(rows, ((0, -D % WIDTH), (0, 0)), mode="edge").T
    constants = np.stack([j2, 2 * np.pi * np.exp(log_out - log_core), log_core, log_out])
    sums = np.zeros((PIECES, D))
    share_out(
        _log_marginals, PIECES, *detections, stars, middles, response, state,
        in_lanes.reshape(-1, WIDTH), G, order, constants, least, sums,
    )  # fmt: skip
    return sums
