"""Probability mass of a Gaussian within a circle, with its first and second derivatives.

The Gaussian has variances A, B and is centred on the origin; the circle has radius R and centre d.
Points on the circle are (x, y) = d + R (cos t, sin t), and q = (x^2/A + y^2/B) / 2.  By the
divergence theorem, applied to the radial field with the Gaussian as its divergence, the integral
over the disc becomes an integral over the circle,

    Z = R / (4 pi sqrt(A B))  integral of E(q) (R + d_u cos t + d_v sin t) dt,
    E(q) = (1 - e^-q) / q.

Derivatives with respect to d are integrals of the Gaussian and its derivatives over the circle.
Those with respect to the variances follow from dZ/dA = (1/2) d^2Z/dd_u^2.  The integrands are
periodic and entire, so that the trapezoidal rule converges faster than any power: about thirty
nodes are enough for a circle of four sigma.

If the origin is outside the circle, the two terms of E cancel up to an exponentially small
remainder.  In that case the term 1/q, which integrates to zero, is omitted, and the largest e^-q
is factored out of the sum.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from bayesdist.infer.kernel.lanes import FAST
from bayesdist.infer.kernel.numeric import exp_negative, whole_vectors
from bayesdist.utils.arrays import Float, Int

SURE = 8.6**2  # squared distance from the edge in sigma at which the probability is 1 in float64
# smallest resolved variance over R^2; smaller variances are replaced by it, which affects only
# stars within a few such errors of the edge
STEEP = 512.0**-2
CANCELLED = 1e3  # sum of absolute values over the sum, above which the term 1/q is omitted
EDGE = 0.02  # for smaller q, E is computed from its series

COUNTS = (
    *(12, 16, 20, 24, 28, 32, 36, 40, 44, 48, 56, 64, 72, 80, 96, 112, 128, 160, 192, 224),
    *(256, 320, 384, 448, 512, 640, 768, 1024, 1536, 2048, 3072, 4096, 6144, 8192),
)
MOST = COUNTS[-1]


def _table() -> tuple[Int, Int, Float, Float]:
    """Node counts, the index of the first node of each set, and cosines and sines of all nodes."""
    angles = np.concatenate([2 * np.pi * np.arange(n) / n for n in COUNTS])
    begin = np.concatenate([[0], np.cumsum(COUNTS)[:-1]]).astype(np.int64)
    return np.array(COUNTS, np.int64), begin, np.cos(angles), np.sin(angles)


NODES = _table()

# All functions are inlined, for the reason given at `numeric.exp_negative`.


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def inside(du, dv, A, B, R):
    """True if the probability outside the circle is below the float64 precision.

    The module explains the arguments.
    """
    whole_vectors()
    d2 = du * du + dv * dv
    room = R - math.sqrt(d2)
    return room > 0.0 and room * room > SURE * max(A, B)


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def nodes_for(du, dv, A, B, R, counts):
    """Index of the smallest set of nodes, among `counts`, that resolves the integrand.

    The module explains the other arguments.
    """
    whole_vectors()
    bend = R * math.sqrt(du * du / (A * A) + dv * dv / (B * B)) + R * R * abs(1.0 / A - 1.0 / B)
    wanted = 9.0 + 7.2 * math.sqrt(bend)
    if du * du + dv * dv > R * R:
        wanted *= 1.8
    k = 0
    while k < len(counts) - 1 and counts[k] < wanted:
        k += 1
    return k


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _total(values, n):
    """Sum of the first n values, n a multiple of four."""
    whole_vectors()
    total = 0.0
    for s in range(0, n, 4):
        total += (values[s] + values[s + 1]) + (values[s + 2] + values[s + 3])
    return total


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _flux(e, away):
    """Contribution of a node to the sum: E(e) times the outward component `away`."""
    whole_vectors()
    series = 1.0 - e * (1.0 / 2 - e * (1.0 / 6 - e * (1.0 / 24 - e * (1.0 / 120 - e / 720))))
    safe = max(e, EDGE)
    return away * (series if e < EDGE else (1.0 - exp_negative(-safe)) / safe)


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _log_from_within(du, dv, A, B, R, n, first, cosine, sine, work):
    """Logarithm of the probability if the centre of the Gaussian is inside the circle.

    All terms are positive in this case.
    """
    whole_vectors()
    half_a, half_b = 0.5 / A, 0.5 / B
    for k in range(n):
        c, s = cosine[first + k], sine[first + k]
        x, y = du + R * c, dv + R * s
        work[k] = _flux(x * x * half_a + y * y * half_b, R + du * c + dv * s)
    return math.log(R / (2.0 * n * math.sqrt(A * B)) * _total(work, n))


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _exponents(du, dv, A, B, R, n, first, cosine, sine, q):
    """Write q at the nodes to `q` and return the smallest value."""
    whole_vectors()
    half_a, half_b = 0.5 / A, 0.5 / B
    q_min = math.inf
    for k in range(n):
        x, y = du + R * cosine[first + k], dv + R * sine[first + k]
        q[k] = x * x * half_a + y * y * half_b
    for k in range(n):
        q_min = min(q_min, q[k])
    return q_min


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _log_from_outside(du, dv, A, B, R, n, first, cosine, sine, q, least, work):
    """Logarithm of the probability if the centre is outside the circle, from q at the nodes."""
    whole_vectors()
    scale = R / (2.0 * n * math.sqrt(A * B))
    for k in range(n):
        work[k] = _flux(q[k], R + du * cosine[first + k] + dv * sine[first + k])
    total = _total(work, n)
    for k in range(n):
        work[k] = abs(work[k])
    if _total(work, n) < CANCELLED * total:
        return math.log(scale * total)
    for k in range(n):
        away = R + du * cosine[first + k] + dv * sine[first + k]
        work[k] = -away * exp_negative(least - q[k]) / q[k]
    return math.log(scale * _total(work, n)) - least


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def log_circle(du, dv, A, B, R, nodes, q, work):
    """Logarithm of the probability mass within the circle about d = (du, dv).

    The module explains A, B and R.  `q` and `work` are scratch arrays of at least `MOST` numbers.
    """
    whole_vectors()
    if inside(du, dv, A, B, R):
        return 0.0
    A, B = max(A, STEEP * R * R), max(B, STEEP * R * R)
    counts, begin, cosine, sine = nodes
    k = nodes_for(du, dv, A, B, R, counts)
    n, first = counts[k], begin[k]
    if du * du + dv * dv <= R * R:
        return _log_from_within(du, dv, A, B, R, n, first, cosine, sine, work)
    q_min = _exponents(du, dv, A, B, R, n, first, cosine, sine, q)
    return _log_from_outside(du, dv, A, B, R, n, first, cosine, sine, q, q_min, work)


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def slopes(du, dv, A, B, R, nodes, q, work, out):
    """Write `log_circle` and its derivatives to out (10,).

    With t a variance added on both axes, the entries are the logarithm and its derivatives with
    respect to u, v, uu, uv, vv, t, tu, tv, tt.
    """
    whole_vectors()
    for m in range(10):
        out[m] = 0.0
    if inside(du, dv, A, B, R):
        return
    # 0 if the variance is replaced by its lower limit and does not depend on the jitter
    free_a, free_b = 1.0, 1.0
    if A < STEEP * R * R:
        A, free_a = STEEP * R * R, 0.0
    if B < STEEP * R * R:
        B, free_b = STEEP * R * R, 0.0
    counts, begin, cosine, sine = nodes
    k = nodes_for(du, dv, A, B, R, counts)
    n, first = counts[k], begin[k]
    q_min = _exponents(du, dv, A, B, R, n, first, cosine, sine, q)
    if du * du + dv * dv <= R * R:
        log_z = _log_from_within(du, dv, A, B, R, n, first, cosine, sine, work)
    else:
        log_z = _log_from_outside(du, dv, A, B, R, n, first, cosine, sine, q, q_min, work)
    for k in range(n):
        work[k] = exp_negative(q_min - q[k])
    ia, ib = 1.0 / A, 1.0 / B
    u = v = uu = uv = vv = t = tu = tv = tt = 0.0
    for k in range(n):
        c, s, g = cosine[first + k], sine[first + k], work[k]
        x, y = (du + R * c) * ia, (dv + R * s) * ib
        w = 0.5 * (free_a * (x * x - ia) + free_b * (y * y - ib))  # d log(g) / dt
        gc, gs = g * c, g * s
        across = free_a * gc * x + free_b * gs * y
        u += gc
        v += gs
        uu -= gc * x
        uv -= gc * y
        vv -= gs * y
        t -= across
        tu += w * gc
        tv += w * gs
        tt -= w * across - free_a * gc * x * ia - free_b * gs * y * ib
    # derivatives of Z, divided by Z; the factors 1/2 of t and tt were left out of the sums
    scale = R / (n * math.sqrt(A * B)) * math.exp(-q_min - log_z)
    u, v, uu, uv, vv = scale * u, scale * v, scale * uu, scale * uv, scale * vv
    t, tu, tv, tt = 0.5 * scale * t, scale * tu, scale * tv, 0.5 * scale * tt
    out[0], out[1], out[2] = log_z, u, v
    out[3], out[4], out[5] = uu - u * u, uv - u * v, vv - v * v
    out[6], out[7], out[8], out[9] = t, tu - t * u, tv - t * v, tt - t * t
