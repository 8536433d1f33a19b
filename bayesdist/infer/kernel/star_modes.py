"""One star whose place is unknown: its most probable place, and its log density there.

The residual of detection i is r = z - S p: its place z on the sky as the model has it, less that of
its star, S the derivative of a star's place by its parameters p (position, then motion, then
parallax).  Errors are round on the detector: with W = (J J^T)^-1, J the derivative of z by the
pixel, r^T W r is in square pixels.

    log p = sum_i log[ (1 - f) / (2 pi s_i^2) exp(-r^T W r / (2 s_i^2)) + f / (pi R^2) ]

with s_i^2 the detection's variance, jitter included, in square pixels.  With u_i the density of
false detections over that of true ones, the membership is 1 / (1 + u_i), and the logarithms are
those of products: a detection takes one exponential.
"""

from __future__ import annotations

import math

import numba as nb

__all__ = [
    "MOST_STAR",
    "add_curvature",
    "cholesky",
    "design",
    "far_odds",
    "hessian",
    "log_root",
    "membership",
    "residual",
    "to_mode",
]

MOST_STAR = 5  # parameters of a star
MOST_STEPS = 60
CLOSE = 1e-8  # decrement at which one more step of Newton's is the last
STILL = 1e-6  # square of the step, in errors, by which it may be so
NEAR = 1.0  # decrement below which the curvature of the mixture is used
FAR = 300.0  # half the squared residual beyond which a detection is false
RANGE = 1e150  # of products whose logarithm is taken


@nb.njit(cache=True, forceinline=True)
def cholesky(A, q):
    """Lower Cholesky factor in place; False where the matrix is not positive."""
    for i in range(q):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                A[i, i] = math.sqrt(total)
            else:
                A[i, j] = total / A[j, j]
    return True


@nb.njit(cache=True, forceinline=True)
def _solve(L, b, q):
    """Solve L L^T x = b in place; the squared length of L^-1 b."""
    decrement = 0.0
    for i in range(q):
        for k in range(i):
            b[i] -= L[i, k] * b[k]
        b[i] /= L[i, i]
        decrement += b[i] * b[i]
    for i in range(q - 1, -1, -1):
        for k in range(i + 1, q):
            b[i] -= L[k, i] * b[k]
        b[i] /= L[i, i]
    return decrement


@nb.njit(cache=True, forceinline=True)
def design(S, q, i, time, factor):
    """Derivative (2, q) of a star's place by its parameters at the date of detection i."""
    S[0, 0] = S[1, 1] = 1.0
    S[0, 1] = S[1, 0] = 0.0
    if q >= 4:
        S[0, 2] = S[1, 3] = time[i]
        S[0, 3] = S[1, 2] = 0.0
    if q == 5:
        S[0, 4], S[1, 4] = factor[i, 0], factor[i, 1]


@nb.njit(cache=True, forceinline=True)
def residual(i, z, S, p, q, W):
    """W times the residual, and its square in pixels."""
    ru, rv = z[i, 0], z[i, 1]
    for k in range(q):
        ru -= S[0, k] * p[k]
        rv -= S[1, k] * p[k]
    wu, wv = W[i, 0] * ru + W[i, 1] * rv, W[i, 1] * ru + W[i, 2] * rv
    return wu, wv, ru * wu + rv * wv


@nb.njit(cache=True, forceinline=True)
def far_odds(log_core, log_out):
    """Density of false detections over that of true ones, but for s^2 exp(r^T W r / (2 s^2))."""
    return 2.0 * math.pi * math.exp(log_out - log_core)


@nb.njit(cache=True, forceinline=True)
def membership(odds, square, s2):
    """Probability that a detection is its star's; `odds` as of `far_odds`."""
    half = 0.5 * square / s2
    return 1.0 / (1.0 + odds * s2 * math.exp(half)) if half < FAR else 0.0


@nb.njit(cache=True, forceinline=True)
def add_curvature(A, S, q, h0, h1, h2):
    """Add S^T H S, lower half."""
    for k in range(q):
        a = h0 * S[0, k] + h1 * S[1, k]
        b = h1 * S[0, k] + h2 * S[1, k]
        for l in range(k + 1):
            A[k, l] += a * S[0, l] + b * S[1, l]


@nb.njit(cache=True, forceinline=True)
def hessian(i, W, wu, wv, s2, w, observed):
    """Curvature (3 numbers) of a detection by its place: of the mixture, or with its EM weight."""
    core = w / s2
    if not observed:
        return core * W[i, 0], core * W[i, 1], core * W[i, 2]
    tie = w * (1.0 - w) / (s2 * s2)
    return (
        core * W[i, 0] - tie * wu * wu,
        core * W[i, 1] - tie * wu * wv,
        core * W[i, 2] - tie * wv * wv,
    )


@nb.njit(cache=True, forceinline=True)
def _start(centre, precision, p, A, b):
    """What is known of a star beforehand: curvature, gradient, log density."""
    value = 0.0
    for k in range(len(p)):
        b[k] = 0.0
        for l in range(len(p)):
            A[k, l] = precision[k, l]
            b[k] += precision[k, l] * (centre[l] - p[l])
        value -= 0.5 * (centre[k] - p[k]) * b[k]
    return value


@nb.njit(cache=True)
def _expanded(
    z, W, var, j2, log_core, log_out, time, factor, centre, precision, p, S, A, b, observed
):  # fmt: skip
    """Log density of one star, its gradient b and the lower half of its curvature A."""
    q, odds = len(p), far_odds(log_core, log_out)
    value, product, n_near = _start(centre, precision, p, A, b), 1.0, 0
    scale = 1.0 / (var[0] + j2)  # keeps products near one
    a00 = a10 = a11 = b0 = b1 = 0.0
    for i in range(len(z)):
        s2 = var[i] + j2
        if q == 2:  # the loops below, unrolled: most stars stand still
            ru, rv = z[i, 0] - p[0], z[i, 1] - p[1]
            wu, wv = W[i, 0] * ru + W[i, 1] * rv, W[i, 1] * ru + W[i, 2] * rv
            square = ru * wu + rv * wv
        else:
            design(S, q, i, time, factor)
            wu, wv, square = residual(i, z, S, p, q, W)
        half = 0.5 * square / s2
        if half > FAR:
            value += log_out
            continue
        n_near += 1
        more = 1.0 + odds * s2 * math.exp(half)
        w = 1.0 / more
        value -= half
        product *= more / (scale * s2)
        if not 1.0 / RANGE < product < RANGE:
            value += math.log(product)
            product = 1.0
        h0, h1, h2 = hessian(i, W, wu, wv, s2, w, observed)
        core = w / s2
        if q == 2:
            a00 += h0
            a10 += h1
            a11 += h2
            b0 += core * wu
            b1 += core * wv
        else:
            add_curvature(A, S, q, h0, h1, h2)
            for k in range(q):
                b[k] += core * (S[0, k] * wu + S[1, k] * wv)
    if q == 2:
        A[0, 0] += a00
        A[1, 0] += a10
        A[1, 1] += a11
        b[0] += b0
        b[1] += b1
    return (
        value + math.log(product) + n_near * (log_core - math.log(2.0 * math.pi) + math.log(scale))
    )


@nb.njit(cache=True)
def to_mode(
    z, W, var, j2, log_core, log_out, time, factor, centre, precision, p, S, A, b, seen, least
):  # fmt: skip
    """Move p to the mode of one star; leaves the factor of the curvature there in A.

    `least` is the root of the least curvature that its place may have: a star without members has
    less, and stays where it is.

    Returns the log density, and whether the curvature is the mixture's, or with EM weights: as
    asked by `seen`, or in need.
    """
    q, observed, failed, value, left = len(p), True, False, 0.0, 1.0
    for _ in range(MOST_STEPS):
        value = _expanded(
            z, W, var, j2, log_core, log_out, time, factor, centre, precision, p, S, A, b, observed
        )  # fmt: skip
        if not cholesky(A, q):
            if not observed:
                break  # nothing known: a star without members
            observed, failed = False, True
            continue
        left = _solve(A, b, q)
        if observed and left > NEAR:
            observed = False
            continue
        if A[0, 0] < least:
            return value, observed
        for k in range(q):
            p[k] += b[k]
        # a step may be long and gain little; the curvature is another one where it ends
        moved = W[0, 0] * b[0] * b[0] + 2.0 * W[0, 1] * b[0] * b[1] + W[0, 2] * b[1] * b[1]
        if left < CLOSE and moved < STILL * (var[0] + j2):
            if observed == seen:  # the last step changes the curvature by next to nothing
                return value + 0.5 * left, observed
            break
        observed = left < NEAR and not failed
    for attempt in range(2):
        observed = seen and attempt == 0
        value = _expanded(
            z, W, var, j2, log_core, log_out, time, factor, centre, precision, p, S, A, b, observed
        )  # fmt: skip
        if cholesky(A, q):
            return value, observed
    return value, False


@nb.njit(cache=True, forceinline=True)
def log_root(A, q, least):
    """Half the log determinant of the curvature whose factor A is.

    Without members a star may be anywhere; it is not, for its detections lie in one circle.
    """
    total = 0.0
    for k in range(q):
        total += math.log(max(A[k, k], least) if k < 2 else A[k, k])
    return total
