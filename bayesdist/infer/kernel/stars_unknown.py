"""Detections of stars of unknown position, which is solved for, and eliminated, in one pass.

Detections are sorted by star.  The model is evaluated at the star's position by a current solution,
the pixel x', and not where it was detected: z = z(x') + J (x - x').  J may then be constant, for
z(x') - S p is as small as the solution is good.  At the detection itself it would be as large as
the error is, and a model that made pixels smaller would make errors smaller.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.kernel.blocks import PASS, share_out
from bayesdist.infer.kernel.lanes import FAST
from bayesdist.infer.kernel.sky_places import legendre
from bayesdist.infer.kernel.star_modes import (
    DOUBTFUL,
    MOST_STAR,
    PLACE_U,
    PLACE_V,
    add_curvature,
    cholesky,
    design,
    far_odds,
    hessian,
    log_root,
    membership,
    own_rows,
    residual,
    summed_over_members,
    to_mode,
)

__all__ = ["MOST_DOUBTFUL", "eliminate_stars", "log_marginals", "weighted_stars"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Flags = NDArray[np.int8]

MOST_DOUBTFUL = 6  # most detections of a star over whose membership is summed
PIECES = 8  # number of separate sums, whatever the number of threads


@nb.njit(**PASS)
def _weighted_stars(
    first, end, starts, z, W, var, j2, log_core, log_out, time, factor, centre, precision, least,
    stars, member,
):  # fmt: skip
    q, odds = stars.shape[1], far_odds(log_core, log_out)
    S, A, b = np.zeros((2, MOST_STAR)), np.zeros((MOST_STAR, MOST_STAR)), np.zeros(MOST_STAR)
    for s in range(first, end):
        a, e = starts[s], starts[s + 1]
        own = own_rows(W, var, a, e)
        for i in range(a, e):
            own[PLACE_U, i - a], own[PLACE_V, i - a] = z[i, 0], z[i, 1]
        when = time[a:e] if q >= 4 else time
        where = factor[a:e] if q == 5 else factor
        to_mode(
            own, j2, log_core, log_out, when, where, centre[s], precision[s], stars[s], S, A, b,
            False, least,
        )  # fmt: skip
        for i in range(a, e):
            design(S, q, i - a, when, where)
            _, _, square = residual(i - a, own, S, stars[s], q)
            member[i] = membership(odds, square, var[i] + j2)


def weighted_stars(
    starts: Int, z: Float, W: Float, var: Float, j2: float, log_core: float, log_out: float,
    time: Float, factor: Float, centre: Float, precision: Float, least: float, stars: Float,
) -> Float:  # fmt: skip
    """Move stars (n, q) to their modes for sky positions z (N, 2); memberships (N,)."""
    member = np.zeros(len(z))
    share_out(
        _weighted_stars, len(stars), starts, z, W, var, j2, log_core, log_out, time, factor,
        centre, precision, least, stars, member,
    )  # fmt: skip
    return member


@nb.njit(**PASS)
def _log_marginals(
    start, stop, first, last, starts, group, X, Y, offset, W, var, time, factor, centre, precision,
    stars, middles, share, state, coef, order, rows, least, sums,
):  # fmt: skip
    q, K, n_draws = stars.shape[1], coef.shape[2], len(rows)
    step = -(-(last - first) // PIECES)
    for piece in range(start, stop):
        S, A, b = np.zeros((2, MOST_STAR)), np.zeros((MOST_STAR, MOST_STAR)), np.zeros(MOST_STAR)
        px, py, phi = np.empty(order + 1), np.empty(order + 1), np.empty(K)
        p, mean, doubtful = np.empty(q), np.empty((2, n_draws)), np.empty((MOST_DOUBTFUL, 7))
        for s in range(first + piece * step, min(first + (piece + 1) * step, last)):
            a, e = starts[s], starts[s + 1]
            own = own_rows(W, var, a, e)
            when = time[a:e] if q >= 4 else time
            where = factor[a:e] if q == 5 else factor
            at = np.empty((2, e - a, n_draws))
            several = False
            for i in range(a, e):
                several |= state[i] == DOUBTFUL
            mean[:] = 0.0
            for i in range(a, e):
                legendre(X[i], Y[i], order, px, py, phi)
                for axis in range(2):
                    _add_products(coef[group[i], axis], phi, offset[i, axis], at[axis, i - a])
                    for d in range(n_draws):
                        mean[axis, d] += share[i] * at[axis, i - a, d]
            for d in range(n_draws):
                for i in range(e - a):
                    own[PLACE_U, i], own[PLACE_V, i] = at[0, i, d], at[1, i, d]
                for k in range(q):
                    p[k] = stars[s, k]
                p[0] += mean[0, d] - middles[s, 0]
                p[1] += mean[1, d] - middles[s, 1]
                if several:
                    sums[piece, d] += summed_over_members(
                        own, state[a:e], rows[d, 0], rows[d, 1], rows[d, 2], centre[s],
                        precision[s], p, doubtful, least,
                    )  # fmt: skip
                    continue
                value, _ = to_mode(
                    own, rows[d, 0], rows[d, 1], rows[d, 2], when, where, centre[s], precision[s],
                    p, S, A, b, True, least,
                )  # fmt: skip
                sums[piece, d] += value - log_root(A, q, least)


def log_marginals(
    first: int, last: int, detections: tuple[Any, ...], stars: Float,
    middles: Float, share: Float, state: Flags, coef: Float, order: int, rows: Float, least: float,
) -> Float:  # fmt: skip
    """Log densities (PIECES, D) of stars first..last, their parameters integrated out (Laplace).

    `detections` are starts, group, X, Y, offset, W, var, time, factor, centre and precision.
    Summed over all choices of members where some are doubtful: state (N,), as of
    `summed_over_members`.

    middles (S, 2), share (N,): a star moves with the weighted mean of its detections, and lies at
    `stars` where that mean is `middles`.
    coef (G, 2, K, D): of the Legendre products, draws last: one detection takes them together.
    rows (D, 3): squared jitter, log of the core's fraction, log density of outliers.
    least: root of the least curvature that a star's position may have.
    """
    sums = np.zeros((PIECES, len(rows)))
    share_out(
        _log_marginals, PIECES, first, last, *detections, stars, middles, share, state, coef,
        order, rows, least, sums,
    )  # fmt: skip
    return sums


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _add_products(coef, phi, start, out):
    """start + sum of phi_k coef_k, for all draws (D,) at a time."""
    for d in range(len(out)):
        out[d] = start + phi[0] * coef[0, d]
    for k in range(1, len(phi) - 1, 2):  # two at a time: half as often to memory and back
        for d in range(len(out)):
            out[d] += phi[k] * coef[k, d] + phi[k + 1] * coef[k + 1, d]
    if len(phi) % 2 == 0:
        for d in range(len(out)):
            out[d] += phi[-1] * coef[-1, d]


@nb.njit(**PASS)
def _eliminate_stars(
    start, stop, first, last, starts, group, X, Y, offset, W, var, time, factor, centre, precision,
    stars, coef, chip, linear, extra, columns, n_params, order, j2, log_core, log_out, least, seen,
    sums,
):  # fmt: skip
    q, K, m, odds = stars.shape[1], coef.shape[2], extra.shape[1], far_odds(log_core, log_out)
    direct, edge, own, pull_direct, pull_own, scalars, rows, factors = sums
    step = -(-(last - first) // PIECES)
    for piece in range(start, stop):
        S, A, b = np.zeros((2, MOST_STAR)), np.zeros((MOST_STAR, MOST_STAR)), np.zeros(MOST_STAR)
        px, py = np.empty(order + 1), np.empty(order + 1)
        by = np.empty((2, max(m, 1)))
        basis = np.empty((16, K))
        for s in range(first + piece * step, min(first + (piece + 1) * step, last)):
            a, e = starts[s], starts[s + 1]
            if e - a > len(basis):
                basis = np.empty((2 * (e - a), K))
            mine = own_rows(W, var, a, e)
            when = time[a:e] if q >= 4 else time
            where = factor[a:e] if q == 5 else factor
            for i in range(a, e):
                phi = basis[i - a]
                legendre(X[i], Y[i], order, px, py, phi)
                for axis in range(2):
                    total = offset[i, axis]
                    for k in range(K):
                        total += coef[group[i], axis, k] * phi[k]
                    mine[PLACE_U if axis == 0 else PLACE_V, i - a] = total
            p = stars[s]
            value, observed = to_mode(
                mine, j2, log_core, log_out, when, where, centre[s], precision[s], p, S, A, b,
                seen, least,
            )  # fmt: skip
            scalars[piece, 0] += value - log_root(A, q, least)
            row = (s - first) * q
            for k in range(q):
                for l in range(k + 1):
                    factors[s - first, k, l] = A[k, l]
                    A[k, l] = precision[s, k, l]
            for i in range(a, e):
                g, c = group[i], chip[group[i]]
                phi = basis[i - a]
                design(S, q, i - a, when, where)
                wu, wv, square = residual(i - a, mine, S, p, q)
                s2 = var[i] + j2
                w = membership(odds, square, s2)
                h0, h1, h2 = hessian(i - a, mine, wu, wv, s2, w, observed)
                add_curvature(A, S, q, h0, h1, h2)
                scalars[piece, 1] += w
                scalars[piece, 2] += w * (1.0 - w)
                scalars[piece, 3] += w * square / s2
                gu, gv = -w * wu / s2, -w * wv / s2
                M = linear[g]
                # H M, M^T H M and the gradient by coefficients before the frame
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
                for n in range(m):
                    for axis in range(2):
                        total = 0.0
                        for k in range(K):
                            total += extra[g, n, axis, k] * phi[k]
                        by[axis, n] = total
                for n in range(m):
                    hu, hv = h0 * by[0, n] + h1 * by[1, n], h1 * by[0, n] + h2 * by[1, n]
                    pull_own[piece, g, n] += gu * by[0, n] + gv * by[1, n]
                    for l in range(m):
                        own[piece, g, n, l] += hu * by[0, l] + hv * by[1, l]
                    e0, e1 = M[0, 0] * hu + M[1, 0] * hv, M[0, 1] * hu + M[1, 1] * hv
                    for k in range(K):
                        edge[piece, g, n, 0, k] += e0 * phi[k]
                        edge[piece, g, n, 1, k] += e1 * phi[k]
                    for k in range(q):
                        if columns[g, n] >= 0:
                            rows[row + k, columns[g, n]] += S[0, k] * hu + S[1, k] * hv
                for k in range(q):
                    c0, c1 = S[0, k] * a0 + S[1, k] * b0, S[0, k] * a1 + S[1, k] * b1
                    at_u = 2 * K * c
                    for l in range(K):
                        rows[row + k, at_u + l] += c0 * phi[l]
                        rows[row + k, at_u + K + l] += c1 * phi[l]
            # of these terms exactly, else directions that detections leave free would not be free:
            # those of the last step but one are slightly different
            same = cholesky(A, q)
            for k in range(q):
                for l in range(k + 1):
                    if same:
                        factors[s - first, k, l] = A[k, l]
                    else:
                        A[k, l] = factors[s - first, k, l]
            # L^-1 of them: elimination subtracts their square
            for k in range(q):
                for l in range(k):
                    below = A[k, l]
                    for n in range(n_params):
                        rows[row + k, n] -= below * rows[row + l, n]
                for n in range(n_params):
                    rows[row + k, n] /= A[k, k]


def eliminate_stars(
    first: int, last: int, detections: tuple[Any, ...], stars: Float,
    coef: Float, chip: Int, linear: Float, extra: Float, columns: Int, n_params: int, order: int,
    j2: float, log_core: float, log_out: float, least: float, seen: bool,
) -> tuple[Float, ...]:  # fmt: skip
    """Sums of a second-order expansion over stars first..last, these moved to their modes.

    In addition to the arguments of `log_marginals`: coef (G, 2, K) of the Legendre products, and of
    each group its chip (G,), the linear part (G, 2, 2) of its frame, the derivatives (G, m, 2, K)
    by its other parameters and the indices of these (G, m), -1 for none; `seen`: curvature of the
    mixture itself.

    Returns direct (P, chips, 3, K, K), edge (P, G, m, 2, K), own (P, G, m, m): curvature by
    coefficients (uu, uv, vv, lower halves), by these and the rest, by the rest; pull_direct (P,
    chips, 2, K), pull_own (P, G, m): gradients; scalars (P, 4): log density, sums of w, of w (1 -
    w), and of w times the squared normalised residual; rows (S q, D): L^-1 B of each star; factors
    (S, q, q): L.
    """
    q, K, m = stars.shape[1], coef.shape[2], extra.shape[1]
    n_chips, n_groups = chip.max() + 1, len(coef)
    sums = (
        np.zeros((PIECES, n_chips, 3, K, K)),
        np.zeros((PIECES, n_groups, m, 2, K)),
        np.zeros((PIECES, n_groups, m, m)),
        np.zeros((PIECES, n_chips, 2, K)),
        np.zeros((PIECES, n_groups, m)),
        np.zeros((PIECES, 4)),
        np.zeros(((last - first) * q, n_params)),
        np.zeros((last - first, q, q)),
    )
    share_out(
        _eliminate_stars, PIECES, first, last, *detections, stars, coef, chip, linear, extra,
        columns, n_params, order, j2, log_core, log_out, least, seen, sums,
    )  # fmt: skip
    return sums
