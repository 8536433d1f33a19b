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
from bayesdist.infer.kernel.lanes import FAST, WIDTH, load, put
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
from bayesdist.utils.arrays import Float, Int

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
            own, e - a, j2, log_core, log_out, when, where, centre[s], precision[s], stars[s], S,
            A, b, False, least,
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
    stars, middles, response, state, coef, order, rows, least, sums,
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
            u, v = np.empty((e - a, coef.shape[3])), np.empty((e - a, coef.shape[3]))
            several = False
            for i in range(a, e):
                several |= state[i] == DOUBTFUL
            mean[:] = 0.0
            for i in range(a, e):
                legendre(X[i], Y[i], order, px, py, phi)
                _place(coef[group[i]], phi, offset[i], u, v, i - a)
                for axis in range(2):
                    by_u, by_v = response[i, axis, 0], response[i, axis, 1]
                    for d in range(n_draws):
                        mean[axis, d] += by_u * u[i - a, d] + by_v * v[i - a, d]
            for d in range(n_draws):
                for i in range(e - a):
                    own[PLACE_U, i], own[PLACE_V, i] = u[i, d], v[i, d]
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
                    own, e - a, rows[d, 0], rows[d, 1], rows[d, 2], when, where, centre[s],
                    precision[s], p, S, A, b, True, least,
                )  # fmt: skip
                sums[piece, d] += value - log_root(A, q, least)


def log_marginals(
    first: int, last: int, detections: tuple[Any, ...], stars: Float,
    middles: Float, response: Float, state: Flags, coef: Float, order: int, rows: Float,
    least: float,
) -> Float:  # fmt: skip
    """Log densities (PIECES, D) of stars first..last, their parameters integrated out (Laplace).

    `detections` are starts, group, X, Y, offset, W, var, time, factor, centre and precision.
    Summed over all choices of members where some are doubtful: state (N,), as of
    `summed_over_members`.

    middles (S, 2), response (N, 2, 2): a star moves as its detections do, each times its response,
    and lies at `stars` where the sum of these is `middles`.
    coef (G, 2, K, D): of the Legendre products, draws last: one detection takes them together.
    rows (D, 3): squared jitter, log of the core's fraction, log density of outliers.
    least: root of the least curvature that a star's position may have.
    """
    sums = np.zeros((PIECES, len(rows)))
    in_vectors = np.zeros((*coef.shape[:-1], -(-len(rows) // WIDTH) * WIDTH))
    in_vectors[..., : len(rows)] = coef
    share_out(
        _log_marginals, PIECES, first, last, *detections, stars, middles, response, state,
        in_vectors, order, rows, least, sums,
    )  # fmt: skip
    return sums


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _place(coef, phi, offset, u, v, i):
    """Write offset + sum of phi_k coef_k to rows i of u and v, for all draws of coef (2, K, D)."""
    of_u, of_v = coef[0], coef[1]
    for d in range(0, u.shape[1], WIDTH):
        at_u = load(of_u, 0, d) * phi[0] + offset[0]
        at_v = load(of_v, 0, d) * phi[0] + offset[1]
        for k in range(1, len(phi)):
            at_u = at_u + load(of_u, k, d) * phi[k]
            at_v = at_v + load(of_v, k, d) * phi[k]
        put(u, i, d, at_u)
        put(v, i, d, at_v)


@nb.njit(cache=True, forceinline=True, fastmath=FAST | {"reassoc"})
def _dot(coef, phi):
    """Sum of coef_k phi_k over the coefficients."""
    total = 0.0
    for k in range(len(coef)):
        total += coef[k] * phi[k]
    return total


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _add_weights(h0, h1, h2, phi, out):
    """Add h0 phi, h1 phi, h2 phi to out (3, M)."""
    for k in range(len(phi)):
        out[0, k] += h0 * phi[k]
        out[1, k] += h1 * phi[k]
        out[2, k] += h2 * phi[k]


@nb.njit(**PASS)
def _eliminate_stars(
    start, stop, first, last, starts, group, X, Y, offset, W, var, time, factor, centre, precision,
    stars, coef, chip, linear, extra, columns, n_params, order, j2, log_core, log_out, least, seen,
    sums,
):  # fmt: skip
    q, K, m, odds = stars.shape[1], coef.shape[2], extra.shape[1], far_odds(log_core, log_out)
    weights, pulls, scalars, rows, factors = sums
    top = 2 * order
    step = -(-(last - first) // PIECES)
    for piece in range(start, stop):
        S, A, b = np.zeros((2, MOST_STAR)), np.zeros((MOST_STAR, MOST_STAR)), np.zeros(MOST_STAR)
        px, py, by = np.empty(top + 1), np.empty(top + 1), np.empty((2, m))
        basis = np.empty((16, weights.shape[3]))
        for s in range(first + piece * step, min(first + (piece + 1) * step, last)):
            a, e = starts[s], starts[s + 1]
            if e - a > len(basis):
                basis = np.empty((2 * (e - a), weights.shape[3]))
            mine = own_rows(W, var, a, e)
            when = time[a:e] if q >= 4 else time
            where = factor[a:e] if q == 5 else factor
            for i in range(a, e):
                phi, g = basis[i - a], group[i]
                legendre(X[i], Y[i], top, px, py, phi)
                mine[PLACE_U, i - a] = offset[i, 0] + _dot(coef[g, 0], phi)
                mine[PLACE_V, i - a] = offset[i, 1] + _dot(coef[g, 1], phi)
            p = stars[s]
            value, observed = to_mode(
                mine, e - a, j2, log_core, log_out, when, where, centre[s], precision[s], p, S,
                A, b, seen, least,
            )  # fmt: skip
            scalars[piece, 0] += value - log_root(A, q, least)
            row = (s - first) * q
            for k in range(q):
                for l in range(k + 1):
                    factors[s - first, k, l] = A[k, l]
                    A[k, l] = precision[s, k, l]
            for i in range(a, e):
                g = group[i]
                phi = basis[i - a]
                design(S, q, i - a, when, where)
                wu, wv, square = residual(i - a, mine, S, p, q)
                s2 = var[i] + j2
                w = membership(odds, square, s2)
                h0, h1, h2 = hessian(i - a, mine, wu, wv, s2, w, observed)
                add_curvature(A, S, q, h0, h1, h2)
                scalars[piece, 1] += w
                scalars[piece, 2] += w * square / s2
                _add_weights(h0, h1, h2, phi, weights[piece, g])
                gu, gv = -w * wu / s2, -w * wv / s2
                for k in range(K):
                    pulls[piece, g, 0, k] += gu * phi[k]
                    pulls[piece, g, 1, k] += gv * phi[k]
                for axis in range(2):
                    for n in range(m):
                        by[axis, n] = _dot(extra[g, n, axis], phi)
                at_u = 2 * K * chip[g]
                for k in range(q):
                    hu, hv = S[0, k] * h0 + S[1, k] * h1, S[0, k] * h1 + S[1, k] * h2
                    mine_row = rows[row + k]
                    # by coefficients before the frame, and by its parameters
                    for axis in range(2):
                        along = hu * linear[g, 0, axis] + hv * linear[g, 1, axis]
                        for l in range(K):
                            mine_row[at_u + axis * K + l] += along * phi[l]
                    for n in range(m):
                        if columns[g, n] >= 0:
                            mine_row[columns[g, n]] += hu * by[0, n] + hv * by[1, n]
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

    Returns sums by group, with the Legendre functions up to twice the order, by which products of
    two are sums (`product_table`): weights (P, G, 3, M), of the curvature uu, uv, vv by position;
    pulls (P, G, 2, K), of its gradient; then scalars (P, 3): log density, sums of w, and of w times
    the squared normalised residual; rows (S q, D): L^-1 B of each star; factors (S, q, q): L.
    """
    q, K = stars.shape[1], coef.shape[2]
    sums = (
        np.zeros((PIECES, len(coef), 3, (order + 1) * (2 * order + 1))),
        np.zeros((PIECES, len(coef), 2, K)),
        np.zeros((PIECES, 3)),
        np.zeros(((last - first) * q, n_params)),
        np.zeros((last - first, q, q)),
    )
    share_out(
        _eliminate_stars, PIECES, first, last, *detections, stars, coef, chip, linear, extra,
        columns, n_params, order, j2, log_core, log_out, least, seen, sums,
    )  # fmt: skip
    return sums
