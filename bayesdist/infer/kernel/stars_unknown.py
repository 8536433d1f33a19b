"""Detections of stars whose positions are unknown: these are solved for, and eliminated, in a pass.

Detections are sorted by star.  The residual of detection i is r = z - S p: its place z on the sky
as the model has it, less that of its star, S the derivative of a star's place by its parameters p
(position, then motion, then parallax).  Errors are round on the detector: W = (J J^T)^-1 turns r
into square pixels, r^T W r, with J the derivative of z by the pixel.

The model is taken where the star lies by a solution at hand, at the pixel x', and not where it was
detected: z = z(x') + J (x - x').  J may then be constant, for z(x') - S p is as small as the
solution is good.  At the detection itself it would be as large as the error is, and a model that
made pixels smaller would make errors smaller.

    log p = sum_i log[ (1 - f) / (2 pi s_i^2) exp(-r^T W r / (2 s_i^2)) + f / (pi R^2) ]

with s_i^2 the detection's variance, jitter included, in square pixels.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.kernel.polynomial import FAST

__all__ = ["eliminate_stars", "linearised", "log_marginals", "positions", "weighted_stars"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

MOST_STAR = 5  # parameters of a star
PIECES = 8  # whose sums are kept apart, whatever the number of threads
MOST_STEPS = 60
CLOSE = 1e-7  # decrement at which a star's place is found


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _legendre(x, y, order, px, py, phi):
    """All basis functions of one position, by total order, then by falling power of x."""
    px[0] = py[0] = 1.0
    if order > 0:
        px[1], py[1] = x, y
    for k in range(1, order):
        a, b = (2.0 * k + 1.0) / (k + 1.0), k / (k + 1.0)
        px[k + 1] = a * x * px[k] - b * px[k - 1]
        py[k + 1] = a * y * py[k] - b * py[k - 1]
    n = 0
    for total in range(order + 1):
        for j in range(total + 1):
            phi[n] = px[total - j] * py[j]
            n += 1


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _powers(coef, order, x, y):
    """Sum of c_ij x^i y^j by Horner's rule, terms sorted as the basis functions."""
    out = 0.0
    for i in range(order, -1, -1):
        inner = coef[order * (order + 1) // 2 + (order - i)]
        for j in range(order - i - 1, -1, -1):
            total = i + j
            inner = inner * y + coef[total * (total + 1) // 2 + j]
        out = out * x + inner
    return out


@nb.njit(cache=True, nogil=True, parallel=True, fastmath=FAST)
def positions(group, X, Y, coef, order):
    """Places (N, 2) of detections from coefficients (G, 2, K) of the scaled powers."""
    out = np.empty((len(X), 2))
    for i in nb.prange(len(X)):
        out[i, 0] = _powers(coef[group[i], 0], order, X[i], Y[i])
        out[i, 1] = _powers(coef[group[i], 1], order, X[i], Y[i])
    return out


@nb.njit(cache=True, nogil=True, parallel=True, fastmath=FAST)
def linearised(group, seen_X, seen_Y, X, Y, places, coef, by_X, by_Y, half, order):
    """Where stars lie on the detector by a solution, and the plane about it.

    Parameters
    ----------
    group : ndarray of int, shape (N,)
    seen_X, seen_Y, X, Y : ndarray, shape (N,)
        Scaled positions of the detections, and where their stars lie as far as is known.
    places : ndarray, shape (N, 2)
        Of the stars on the sky.
    coef, by_X, by_Y : ndarray, shape (G, 2, K)
        Coefficients of the scaled powers, of the model and of its derivatives by X and by Y.
    half : ndarray, shape (G, 2)
        What X = 1 and Y = 1 are in pixels.
    order : int

    Returns
    -------
    X, Y : ndarray, shape (N,)
        One step of Newton's further.
    offset : ndarray, shape (N, 2)
        J times the pixels from there to the detection.
    W : ndarray, shape (N, 3)
        uu, uv, vv of the inverse of J J^T.
    """
    n = len(X)
    new_X, new_Y, offset, W = np.empty(n), np.empty(n), np.empty((n, 2)), np.empty((n, 3))
    for i in nb.prange(n):
        g, x, y = group[i], X[i], Y[i]
        ru = _powers(coef[g, 0], order, x, y) - places[i, 0]
        rv = _powers(coef[g, 1], order, x, y) - places[i, 1]
        for last in range(2):
            ux, uy = _powers(by_X[g, 0], order, x, y), _powers(by_Y[g, 0], order, x, y)
            vx, vy = _powers(by_X[g, 1], order, x, y), _powers(by_Y[g, 1], order, x, y)
            if last == 0:
                det = ux * vy - uy * vx
                x -= (vy * ru - uy * rv) / det
                y -= (ux * rv - vx * ru) / det
        dx, dy = seen_X[i] - x, seen_Y[i] - y
        offset[i, 0], offset[i, 1] = ux * dx + uy * dy, vx * dx + vy * dy
        ux, uy, vx, vy = ux / half[g, 0], uy / half[g, 1], vx / half[g, 0], vy / half[g, 1]
        uu, uv, vv = ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy
        det = uu * vv - uv * uv
        W[i, 0], W[i, 1], W[i, 2] = vv / det, -uv / det, uu / det
        new_X[i], new_Y[i] = x, y
    return new_X, new_Y, offset, W


@nb.njit(cache=True, forceinline=True)
def _factor(A, q):
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
def _design(S, q, i, time, factor):
    """Derivative (2, q) of a star's place by its parameters at the date of detection i."""
    S[0, 0] = S[1, 1] = 1.0
    S[0, 1] = S[1, 0] = 0.0
    if q >= 4:
        S[0, 2] = S[1, 3] = time[i]
        S[0, 3] = S[1, 2] = 0.0
    if q == 5:
        S[0, 4], S[1, 4] = factor[i, 0], factor[i, 1]


@nb.njit(cache=True, forceinline=True)
def _residual(i, z, S, p, q, W):
    """Residual, W times it, and its square in pixels."""
    ru, rv = z[i, 0], z[i, 1]
    for k in range(q):
        ru -= S[0, k] * p[k]
        rv -= S[1, k] * p[k]
    wu, wv = W[i, 0] * ru + W[i, 1] * rv, W[i, 1] * ru + W[i, 2] * rv
    return wu, wv, ru * wu + rv * wv


@nb.njit(cache=True, forceinline=True)
def _member(ratio, square, variance):
    """Probability that a detection is its star's; `ratio` as of `_ratios`."""
    exponent = ratio - 0.5 * square / variance
    if exponent > 40.0:
        return 1.0
    if exponent < -700.0:
        return 0.0
    return 1.0 - 1.0 / (1.0 + math.exp(exponent))


@nb.njit(cache=True, forceinline=True)
def _log_density(ratio, square, variance, log_out):
    """Log density of a detection."""
    exponent = ratio - 0.5 * square / variance
    if exponent > 0.0:
        return log_out + exponent + math.log1p(math.exp(-exponent))
    return log_out + math.log1p(math.exp(exponent))


@nb.njit(cache=True, forceinline=True)
def _add_curvature(A, S, q, h0, h1, h2):
    """Add S^T H S, lower half."""
    for k in range(q):
        a = h0 * S[0, k] + h1 * S[1, k]
        b = h1 * S[0, k] + h2 * S[1, k]
        for l in range(k + 1):
            A[k, l] += a * S[0, l] + b * S[1, l]


@nb.njit(cache=True, forceinline=True)
def _hessian(i, W, wu, wv, s2, w, observed):
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


@nb.njit(cache=True)
def _ratios(var, j2, log_core, log_out, ratio):
    """Log ratio of the densities, core to false, of detections without residual."""
    for i in range(len(var)):
        ratio[i] = log_core - math.log(2 * math.pi * (var[i] + j2)) - log_out


@nb.njit(cache=True)
def _expanded(
    z, W, var, j2, ratio, time, factor, centre, precision, p, S, A, b, observed
):  # fmt: skip
    """Gradient b and lower half of the curvature A of one star's log density."""
    q = len(p)
    for k in range(q):
        b[k] = 0.0
        for l in range(q):
            A[k, l] = precision[k, l]
            b[k] += precision[k, l] * (centre[l] - p[l])
    for i in range(len(z)):
        _design(S, q, i, time, factor)
        wu, wv, square = _residual(i, z, S, p, q, W)
        s2 = var[i] + j2
        w = _member(ratio[i], square, s2)
        h0, h1, h2 = _hessian(i, W, wu, wv, s2, w, observed)
        _add_curvature(A, S, q, h0, h1, h2)
        for k in range(q):
            b[k] += w / s2 * (S[0, k] * wu + S[1, k] * wv)


@nb.njit(cache=True)
def _to_mode(z, W, var, j2, ratio, time, factor, centre, precision, p, S, A, b, seen):
    """Move p to the mode of one star; leaves the factor of the curvature there in A.

    Returns whether that is the mixture's curvature, or with EM weights as asked, or in need.
    """
    q, observed = len(p), False
    for _ in range(MOST_STEPS):
        _expanded(
            z, W, var, j2, ratio, time, factor, centre, precision, p, S, A, b, observed
        )  # fmt: skip
        if not _factor(A, q):
            if not observed:
                break  # nothing known: a star without members
            observed = False
            continue
        decrement = _solve(A, b, q)
        if decrement < CLOSE:
            break
        for k in range(q):
            p[k] += b[k]
        observed = decrement < 1.0
    for attempt in range(2):
        observed = seen and attempt == 0
        _expanded(
            z, W, var, j2, ratio, time, factor, centre, precision, p, S, A, b, observed
        )  # fmt: skip
        if _factor(A, q):
            return observed
    return False


@nb.njit(cache=True)
def _star_value(z, W, var, j2, ratio, log_out, least, time, factor, centre, precision, p, S, A):
    """Log density with a star's parameters integrated out, from the factor of its curvature.

    Without members a star may be anywhere; it is not, for its detections lie in one circle.
    """
    q, value = len(p), 0.0
    for k in range(q):
        value -= math.log(max(A[k, k], least) if k < 2 else A[k, k])
        for l in range(q):
            value -= 0.5 * (centre[k] - p[k]) * precision[k, l] * (centre[l] - p[l])
    for i in range(len(z)):
        _design(S, q, i, time, factor)
        _, _, square = _residual(i, z, S, p, q, W)
        value += _log_density(ratio[i], square, var[i] + j2, log_out)
    return value


@nb.njit(cache=True, nogil=True, parallel=True, fastmath=FAST)
def weighted_stars(
    starts, z, W, var, j2, log_core, log_out, time, factor, centre, precision, stars
):
    """Move stars (n, q) to their modes, given places z (N, 2); memberships (N,)."""
    n, q = stars.shape
    member, ratio = np.zeros(len(z)), np.empty(len(z))
    for s in nb.prange(n):
        S, A, b = np.zeros((2, MOST_STAR)), np.zeros((MOST_STAR, MOST_STAR)), np.zeros(MOST_STAR)
        a, e = starts[s], starts[s + 1]
        when = time[a:e] if q >= 4 else time
        where = factor[a:e] if q == 5 else factor
        _ratios(var[a:e], j2, log_core, log_out, ratio[a:e])
        _to_mode(
            z[a:e], W[a:e], var[a:e], j2, ratio[a:e], when, where, centre[s], precision[s],
            stars[s], S, A, b, False,
        )  # fmt: skip
        for i in range(a, e):
            _design(S, q, i - a, when, where)
            _, _, square = _residual(i - a, z[a:e], S, stars[s], q, W[a:e])
            member[i] = _member(ratio[i], square, var[i] + j2)
    return member


@nb.njit(cache=True, nogil=True, parallel=True, fastmath=FAST)
def log_marginals(
    first, last, starts, group, X, Y, offset, W, var, time, factor, centre, precision, stars,
    middles, coef, order, rows, least,
):  # fmt: skip
    """Log densities (PIECES, D) of stars first..last, their parameters integrated out (Laplace).

    middles (S, 2): mean place of a star's detections where `stars` are its modes.
    rows (D, 3): squared jitter, log of the core's share, log density of outliers.
    least: root of the least curvature that a star's place may have.
    """
    q, n_draws = stars.shape[1], len(rows)
    sums = np.zeros((PIECES, n_draws))
    step = -(-(last - first) // PIECES)
    for piece in nb.prange(PIECES):
        S, A, b = np.zeros((2, MOST_STAR)), np.zeros((MOST_STAR, MOST_STAR)), np.zeros(MOST_STAR)
        p = np.empty(q)
        room = 16
        z, ratio = np.empty((room, 2)), np.empty(room)
        for s in range(first + piece * step, min(first + (piece + 1) * step, last)):
            a, e = starts[s], starts[s + 1]
            if e - a > room:
                room = 2 * (e - a)
                z, ratio = np.empty((room, 2)), np.empty(room)
            at, own, wide = z[: e - a], W[a:e], var[a:e]
            when = time[a:e] if q >= 4 else time
            where = factor[a:e] if q == 5 else factor
            for d in range(n_draws):
                for i in range(a, e):
                    g = group[i]
                    at[i - a, 0] = _powers(coef[d, g, 0], order, X[i], Y[i]) + offset[i, 0]
                    at[i - a, 1] = _powers(coef[d, g, 1], order, X[i], Y[i]) + offset[i, 1]
                for k in range(q):
                    p[k] = stars[s, k]
                for axis in range(2):  # a star goes where its detections go
                    total = 0.0
                    for i in range(e - a):
                        total += at[i, axis]
                    p[axis] += total / (e - a) - middles[s, axis]
                j2, log_core, log_out = rows[d, 0], rows[d, 1], rows[d, 2]
                odds = ratio[: e - a]
                _ratios(wide, j2, log_core, log_out, odds)
                _to_mode(
                    at, own, wide, j2, odds, when, where, centre[s], precision[s], p, S, A, b, True
                )
                sums[piece, d] += _star_value(
                    at,
                    own,
                    wide,
                    j2,
                    odds,
                    log_out,
                    least,
                    when,
                    where,
                    centre[s],
                    precision[s],
                    p,
                    S,
                    A,
                )
    return sums


@nb.njit(cache=True, nogil=True, parallel=True, fastmath=FAST)
def eliminate_stars(
    first, last, starts, group, X, Y, offset, W, var, time, factor, centre, precision, stars,
    coef, chip, linear, extra, columns, n_params, order, j2, log_core, log_out, least, seen,
):  # fmt: skip
    """Sums of a second-order expansion over stars first..last, these moved to their modes.

    Besides what `log_marginals` takes: coef (G, 2, K) of the Legendre products, and of each group
    its chip (G,), the linear part (G, 2, 2) of its frame, the derivatives (G, 2, K, m) by its other
    parameters and which these are (G, m), -1 for none; `seen`: curvature of the mixture itself.

    Returns direct (P, chips, 3, K, K), edge (P, G, 2, K, m), own (P, G, m, m): curvature by
    coefficients (uu, uv, vv, lower halves), by these and the rest, by the rest; pull_direct (P,
    chips, 2, K), pull_own (P, G, m): gradients; scalars (P, 4): log density, sums of w, of
    w (1 - w), and of w times the squared normalised residual; rows (S q, D): L^-1 B of each star;
    factors (S, q, q): L.
    """
    q, K, m = stars.shape[1], coef.shape[2], extra.shape[3]
    n_chips, n_groups = chip.max() + 1, len(coef)
    direct = np.zeros((PIECES, n_chips, 3, K, K))
    edge = np.zeros((PIECES, n_groups, 2, K, m))
    own = np.zeros((PIECES, n_groups, m, m))
    pull_direct = np.zeros((PIECES, n_chips, 2, K))
    pull_own = np.zeros((PIECES, n_groups, m))
    scalars = np.zeros((PIECES, 4))
    rows = np.zeros(((last - first) * q, n_params))
    factors = np.zeros((last - first, q, q))
    step = -(-(last - first) // PIECES)
    for piece in nb.prange(PIECES):
        S, A, b = np.zeros((2, MOST_STAR)), np.zeros((MOST_STAR, MOST_STAR)), np.zeros(MOST_STAR)
        px, py, phi = np.empty(order + 1), np.empty(order + 1), np.empty(K)
        by = np.empty((2, max(m, 1)))
        room = 16
        z, ratio = np.empty((room, 2)), np.empty(room)
        for s in range(first + piece * step, min(first + (piece + 1) * step, last)):
            a, e = starts[s], starts[s + 1]
            if e - a > room:
                room = 2 * (e - a)
                z, ratio = np.empty((room, 2)), np.empty(room)
            at, mine, wide = z[: e - a], W[a:e], var[a:e]
            when = time[a:e] if q >= 4 else time
            where = factor[a:e] if q == 5 else factor
            for i in range(a, e):
                _legendre(X[i], Y[i], order, px, py, phi)
                for axis in range(2):
                    total = offset[i, axis]
                    for k in range(K):
                        total += coef[group[i], axis, k] * phi[k]
                    at[i - a, axis] = total
            p = stars[s]
            odds = ratio[: e - a]
            _ratios(wide, j2, log_core, log_out, odds)
            observed = _to_mode(
                at, mine, wide, j2, odds, when, where, centre[s], precision[s], p, S, A, b, seen
            )
            scalars[piece, 0] += _star_value(
                at,
                mine,
                wide,
                j2,
                odds,
                log_out,
                least,
                when,
                where,
                centre[s],
                precision[s],
                p,
                S,
                A,
            )
            row = (s - first) * q
            for k in range(q):
                for l in range(k + 1):
                    factors[s - first, k, l] = A[k, l]
            for i in range(a, e):
                g, c = group[i], chip[group[i]]
                _legendre(X[i], Y[i], order, px, py, phi)
                _design(S, q, i - a, when, where)
                wu, wv, square = _residual(i - a, at, S, p, q, mine)
                s2 = wide[i - a] + j2
                w = _member(odds[i - a], square, s2)
                h0, h1, h2 = _hessian(i - a, mine, wu, wv, s2, w, observed)
                scalars[piece, 1] += w
                scalars[piece, 2] += w * (1.0 - w)
                scalars[piece, 3] += w * square / s2
                gu, gv = -w * wu / s2, -w * wv / s2
                M = linear[g]
                # H M, M^T H M and the gradient by what stands before the frame
                a0, a1 = h0 * M[0, 0] + h1 * M[1, 0], h0 * M[0, 1] + h1 * M[1, 1]
                b0, b1 = h1 * M[0, 0] + h2 * M[1, 0], h1 * M[0, 1] + h2 * M[1, 1]
                t0 = M[0, 0] * a0 + M[1, 0] * b0
                t1 = M[0, 0] * a1 + M[1, 0] * b1
                t2 = M[0, 1] * a1 + M[1, 1] * b1
                f0, f1 = M[0, 0] * gu + M[1, 0] * gv, M[0, 1] * gu + M[1, 1] * gv
                for k in range(K):
                    pull_direct[piece, c, 0, k] += f0 * phi[k]
                    pull_direct[piece, c, 1, k] += f1 * phi[k]
                    u0, u1, u2 = t0 * phi[k], t1 * phi[k], t2 * phi[k]
                    for l in range(k + 1):
                        direct[piece, c, 0, k, l] += u0 * phi[l]
                        direct[piece, c, 1, k, l] += u1 * phi[l]
                        direct[piece, c, 2, k, l] += u2 * phi[l]
                for axis in range(2):
                    for n in range(m):
                        total = 0.0
                        for k in range(K):
                            total += extra[g, axis, k, n] * phi[k]
                        by[axis, n] = total
                for n in range(m):
                    hu, hv = h0 * by[0, n] + h1 * by[1, n], h1 * by[0, n] + h2 * by[1, n]
                    pull_own[piece, g, n] += gu * by[0, n] + gv * by[1, n]
                    for l in range(m):
                        own[piece, g, n, l] += hu * by[0, l] + hv * by[1, l]
                    e0, e1 = M[0, 0] * hu + M[1, 0] * hv, M[0, 1] * hu + M[1, 1] * hv
                    for k in range(K):
                        edge[piece, g, 0, k, n] += e0 * phi[k]
                        edge[piece, g, 1, k, n] += e1 * phi[k]
                    for k in range(q):
                        if columns[g, n] >= 0:
                            rows[row + k, columns[g, n]] += S[0, k] * hu + S[1, k] * hv
                for k in range(q):
                    c0, c1 = S[0, k] * a0 + S[1, k] * b0, S[0, k] * a1 + S[1, k] * b1
                    at_u = 2 * K * c
                    for l in range(K):
                        rows[row + k, at_u + l] += c0 * phi[l]
                        rows[row + k, at_u + K + l] += c1 * phi[l]
            # L^-1 of them: what elimination subtracts is their square
            for k in range(q):
                for l in range(k):
                    below = A[k, l]
                    for n in range(n_params):
                        rows[row + k, n] -= below * rows[row + l, n]
                for n in range(n_params):
                    rows[row + k, n] /= A[k, k]
    return direct, edge, own, pull_direct, pull_own, scalars, rows, factors
