"""Most probable position of a star from its detections, and the log density there.

The residual of detection i is r = z - S p.  Here z is its sky position according to the model, p
are the parameters of the star (position, then proper motion, then parallax), and S is the
derivative of the star's position with respect to p.  Errors are isotropic on the detector: with
W = (J J^T)^-1, and J the derivative of z with respect to the pixel, r^T W r is in square pixels.

    log p = sum_i log[ (1 - f) / (2 pi s_i^2) exp(-r^T W r / (2 s_i^2)) + f / (pi R^2) ]

s_i^2 is the variance of the detection, including jitter, in square pixels.  With e_i the
exponential and o_i the term of false detections, the membership probability is e_i / (e_i + o_i).
Logarithms are taken of products, so that a detection needs one exponential only.

The detections of a star are stored as one array (ROWS, n), with a row per quantity, so that sums
over them are vectorised.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from bayesdist.infer.kernel.lanes import FAST, WIDTH
from bayesdist.infer.kernel.numeric import exp_negative, whole_vectors
from bayesdist.infer.kernel.small import cholesky

MOST_STAR = 5  # maximum number of parameters of a star
MOST_STEPS = 60  # maximum number of Newton steps
CLOSE = 1e-8  # the search ends after a step with a smaller decrement
STILL = 1e-6  # limit on the square of that step, in units of the variance
NEAR = 1.0  # decrement below which the curvature of the mixture is used instead of EM weights
RANGE = 1e150  # products beyond this range are converted to logarithms

# rows of a star's detections: sky position, W (uu, uv, vv), variance, e + o
PLACE_U, PLACE_V, UU, UV, VV, VAR, TERM = range(7)
ROWS = 7


@nb.njit(cache=True, forceinline=True)
def own_rows(W, var, a, e):
    """Array (ROWS, n) of the detections a..e of a star, without their positions.

    It is padded with detections of zero weight to whole SIMD vectors, since a remainder loop would
    take as long per detection as a vector.
    """
    whole_vectors()
    padded = np.zeros((ROWS, -(-(e - a) // WIDTH) * WIDTH))
    padded[VAR] = 1.0
    for i in range(a, e):
        padded[UU, i - a], padded[UV, i - a], padded[VV, i - a] = W[i, 0], W[i, 1], W[i, 2]
        padded[VAR, i - a] = var[i]
    return padded


@nb.njit(cache=True, forceinline=True)
def _solve(L, b, q):
    """Solve L L^T x = b in place and return the squared length of L^-1 b."""
    whole_vectors()
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
    """Write to S (2, q) the derivative of a star's position with respect to its parameters.

    It is evaluated at the date of detection i.
    """
    whole_vectors()
    S[0, 0] = S[1, 1] = 1.0
    S[0, 1] = S[1, 0] = 0.0
    if q >= 4:
        S[0, 2] = S[1, 3] = time[i]
        S[0, 3] = S[1, 2] = 0.0
    if q == 5:
        S[0, 4], S[1, 4] = factor[i, 0], factor[i, 1]


@nb.njit(cache=True, forceinline=True)
def residual(i, own, S, p, q):
    """W times the residual r (two numbers) of detection i, and r^T W r in square pixels.

    `own` has the detections (`own_rows`), and p the q parameters of the star; see the module.
    """
    whole_vectors()
    ru, rv = own[PLACE_U, i], own[PLACE_V, i]
    for k in range(q):
        ru -= S[0, k] * p[k]
        rv -= S[1, k] * p[k]
    wu, wv = own[UU, i] * ru + own[UV, i] * rv, own[UV, i] * ru + own[VV, i] * rv
    return wu, wv, ru * wu + rv * wv


@nb.njit(cache=True, forceinline=True)
def far_odds(log_core, log_out):
    """Ratio of the densities of false and true detections, apart from the factor s^2 / e.

    `log_core` and `log_out` are the logs of the factors of the true and the false term.
    """
    whole_vectors()
    return 2.0 * math.pi * math.exp(log_out - log_core)


@nb.njit(cache=True, forceinline=True)
def membership(odds, square, s2):
    """Probability that a detection belongs to its star.

    `odds` is the result of `far_odds`, `square` is r^T W r and `s2` the variance, in square pixels.
    """
    whole_vectors()
    near = exp_negative(-0.5 * square / s2)
    return near / (near + odds * s2)


@nb.njit(cache=True, forceinline=True)
def add_curvature(A, S, q, h0, h1, h2):
    """Add the lower triangle of S^T H S to A, with H = (h0, h1, h2) = (uu, uv, vv)."""
    whole_vectors()
    for k in range(q):
        a = h0 * S[0, k] + h1 * S[1, k]
        b = h1 * S[0, k] + h2 * S[1, k]
        for l in range(k + 1):
            A[k, l] += a * S[0, l] + b * S[1, l]


@nb.njit(cache=True, forceinline=True)
def hessian(i, own, wu, wv, s2, w, observed):
    """Minus the second derivatives (uu, uv, vv) of a detection's log density in position.

    `w` is its probability of being true, `wu` and `wv` are its weighted residuals, and `s2` is the
    factor on its variances.  The derivatives are exact if `observed` is True; otherwise w is held
    fixed, as in the EM algorithm.
    """
    whole_vectors()
    core = w / s2
    tie = w * (1.0 - w) / (s2 * s2) if observed else 0.0
    return (
        core * own[UU, i] - tie * wu * wu,
        core * own[UV, i] - tie * wu * wv,
        core * own[VV, i] - tie * wv * wv,
    )


@nb.njit(cache=True, forceinline=True)
def _start(centre, precision, p, A, b):
    """Write curvature A and gradient b of a star's prior at p; return its log density."""
    whole_vectors()
    value = 0.0
    for k in range(len(p)):
        b[k] = 0.0
        for l in range(len(p)):
            A[k, l] = precision[k, l]
            b[k] += precision[k, l] * (centre[l] - p[l])
        value -= 0.5 * (centre[k] - p[k]) * b[k]
    return value


@nb.njit(cache=True, forceinline=True, fastmath=FAST | {"reassoc"})
def _sums(own, j2, odds, pu, pv, share):
    """Curvature and gradient of the detections of a star without proper motion at (pu, pv).

    `share` is 1 for the curvature of the mixture, 0 for that with EM weights.
    """
    whole_vectors()
    a00 = a10 = a11 = b0 = b1 = 0.0
    for i in range(own.shape[1]):
        s2, uu, uv, vv = own[VAR, i] + j2, own[UU, i], own[UV, i], own[VV, i]
        inverse = 1.0 / s2
        ru, rv = own[PLACE_U, i] - pu, own[PLACE_V, i] - pv
        wu, wv = uu * ru + uv * rv, uv * ru + vv * rv
        near = exp_negative(-0.5 * (ru * wu + rv * wv) * inverse)
        term = near + odds * s2
        own[TERM, i] = term
        w = near / term
        core = w * inverse
        tie = share * (1.0 - w) * core * inverse
        a00 += core * uu - tie * wu * wu
        a10 += core * uv - tie * wu * wv
        a11 += core * vv - tie * wv * wv
        b0 += core * wu
        b1 += core * wv
    return a00, a10, a11, b0, b1


@nb.njit(cache=True)
def _expanded(own, n, j2, odds, time, factor, centre, precision, p, S, A, b, observed):
    """Write the gradient b and the lower triangle of the curvature A of a star at p.

    Both include the prior; its log density is returned.  The densities of the detections are
    written to the row TERM of `own` (see `_log_density`).
    """
    whole_vectors()
    q, value = len(p), _start(centre, precision, p, A, b)
    for i in range(n):
        s2 = own[VAR, i] + j2
        design(S, q, i, time, factor)
        wu, wv, square = residual(i, own, S, p, q)
        near = exp_negative(-0.5 * square / s2)
        own[TERM, i] = near + odds * s2
        w = near / own[TERM, i]
        h0, h1, h2 = hessian(i, own, wu, wv, s2, w, observed)
        add_curvature(A, S, q, h0, h1, h2)
        core = w / s2
        for k in range(q):
            b[k] += core * (S[0, k] * wu + S[1, k] * wv)
    return value


@nb.njit(cache=True)
def _log_density(own, n, j2, log_core):
    """Log density of the detections of a star, from the row TERM of its last expansion."""
    whole_vectors()
    value, product = 0.0, 1.0
    scale = own[VAR, 0] + j2  # keeps products near one
    for i in range(n):
        product *= own[TERM, i] * scale / (own[VAR, i] + j2)
        if not 1.0 / RANGE < product < RANGE:
            value += math.log(product)
            product = 1.0
    return value + math.log(product) + n * (log_core - math.log(2.0 * math.pi * scale))


@nb.njit(cache=True, forceinline=True)
def _expanded_at_rest(own, j2, odds, c0, c1, p00, p10, p11, pu, pv, observed):
    """Like `_expanded`, for a star without proper motion at (pu, pv).

    Returns the log prior density, the gradient (2 numbers) and the Cholesky factor of the curvature
    (3 numbers); the first of the latter is 0 if the curvature is not positive.
    """
    whole_vectors()
    a00, a10, a11, b0, b1 = _sums(own, j2, odds, pu, pv, 1.0 if observed else 0.0)
    du, dv = c0 - pu, c1 - pv
    g0, g1 = p00 * du + p10 * dv, p10 * du + p11 * dv
    a00, a10, a11 = a00 + p00, a10 + p10, a11 + p11
    schur = a11 - a10 * a10 / a00 if a00 > 0.0 else -1.0
    l00, l11 = (math.sqrt(a00), math.sqrt(schur)) if schur > 0.0 else (0.0, 1.0)
    l10 = a10 / l00 if schur > 0.0 else 0.0
    return -0.5 * (du * g0 + dv * g1), b0 + g0, b1 + g1, l00, l10, l11


@nb.njit(cache=True)
def _to_mode_at_rest(own, n, j2, odds, log_core, c0, c1, p00, p10, p11, pu, pv, seen, least):
    """`to_mode` for a star without proper motion, with scalars only, which takes half as long.

    c0, c1 are the centre of the prior, p00, p10, p11 its precision, pu, pv the starting point.
    Returns the log density, True if the curvature is that of the mixture, the mode, and the
    Cholesky factor of the curvature.
    """
    whole_vectors()
    observed, failed = True, False
    for _ in range(MOST_STEPS):
        value, b0, b1, l00, l10, l11 = _expanded_at_rest(
            own, j2, odds, c0, c1, p00, p10, p11, pu, pv, observed
        )
        if observed and min(l00, l11) < least:
            # hardly curved, or not at all: eliminating the star would divide by almost nothing
            observed, failed = False, True
            continue
        if not l00 > 0.0:
            break  # nothing known: a star without members
        z0 = b0 / l00
        z1 = (b1 - l10 * z0) / l11
        decrement = z0 * z0 + z1 * z1
        if observed and decrement > NEAR:
            observed = False
            continue
        if l00 < least:
            return value + _log_density(own, n, j2, log_core), observed, pu, pv, l00, l10, l11
        dv = z1 / l11
        du = (z0 - l10 * dv) / l00
        pu, pv = pu + du, pv + dv
        # a step may be long and gain little; the curvature at its end is different
        moved = own[UU, 0] * du * du + 2.0 * own[UV, 0] * du * dv + own[VV, 0] * dv * dv
        if decrement < CLOSE and moved < STILL * (own[VAR, 0] + j2):
            if observed == seen:  # the last step hardly changes the curvature
                value += _log_density(own, n, j2, log_core) + 0.5 * decrement
                return value, observed, pu, pv, l00, l10, l11
            break
        observed = decrement < NEAR and not failed
    observed = seen
    value, b0, b1, l00, l10, l11 = _expanded_at_rest(
        own, j2, odds, c0, c1, p00, p10, p11, pu, pv, observed
    )
    if observed and min(l00, l11) < least:
        observed = False
        value, b0, b1, l00, l10, l11 = _expanded_at_rest(
            own, j2, odds, c0, c1, p00, p10, p11, pu, pv, observed
        )
    return value + _log_density(own, n, j2, log_core), observed, pu, pv, l00, l10, l11


@nb.njit(cache=True)
def to_mode(
    own, n, j2, log_core, log_out, time, factor, centre, precision, p, S, A, b, seen, least
):  # fmt: skip
    """Move p to the mode of a star, and write the Cholesky factor of the curvature to A.

    `own` has the n detections (`own_rows`), with positions.  `least` is the square root of the
    smallest curvature allowed for the position; a star with less has no members and is not moved.
    `seen` is True to request the curvature of the mixture, False for EM weights.

    Returns the log density, and True if the curvature is that of the mixture.  EM weights are also
    used if the curvature of the mixture in position is below the square of `least`.
    """
    whole_vectors()
    q, observed, failed, value, decrement = len(p), True, False, 0.0, 1.0
    odds = far_odds(log_core, log_out)
    if q == 2:  # most stars have no motion
        value, observed, p[0], p[1], A[0, 0], A[1, 0], A[1, 1] = _to_mode_at_rest(
            own, n, j2, odds, log_core, centre[0], centre[1], precision[0, 0], precision[1, 0],
            precision[1, 1], p[0], p[1], seen, least,
        )  # fmt: skip
        return value, observed
    for _ in range(MOST_STEPS):
        value = _expanded(own, n, j2, odds, time, factor, centre, precision, p, S, A, b, observed)
        positive = cholesky(A, q)
        if observed and not (positive and min(A[0, 0], A[1, 1]) >= least):
            # hardly curved, or not at all: eliminating the star would divide by almost nothing
            observed, failed = False, True
            continue
        if not positive:
            break  # nothing known: a star without members
        decrement = _solve(A, b, q)
        if observed and decrement > NEAR:
            observed = False
            continue
        if A[0, 0] < least:
            return value + _log_density(own, n, j2, log_core), observed
        for k in range(q):
            p[k] += b[k]
        # a step may be long and gain little; the curvature at its end is different
        moved = own[UU, 0] * b[0] ** 2 + 2.0 * own[UV, 0] * b[0] * b[1] + own[VV, 0] * b[1] ** 2
        if decrement < CLOSE and moved < STILL * (own[VAR, 0] + j2):
            if observed == seen:  # the last step hardly changes the curvature
                return value + _log_density(own, n, j2, log_core) + 0.5 * decrement, observed
            break
        observed = decrement < NEAR and not failed
    for attempt in range(2):
        observed = seen and attempt == 0
        value = _expanded(own, n, j2, odds, time, factor, centre, precision, p, S, A, b, observed)
        if cholesky(A, q) and (not observed or min(A[0, 0], A[1, 1]) >= least):
            break
    return value + _log_density(own, n, j2, log_core), observed


@nb.njit(cache=True, forceinline=True)
def log_root(A, q, least):
    """Half the log determinant of the curvature, from its Cholesky factor A.

    The curvature in position is at least `least` squared, since even a star without members is
    confined to the match circle.
    """
    whole_vectors()
    total = 0.0
    for k in range(q):
        total += math.log(max(A[k, k], least) if k < 2 else A[k, k])
    return total
