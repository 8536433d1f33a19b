"""Detections of stars of unknown position, which is solved for, and eliminated, in one pass.

Detections are sorted by star.  The model is evaluated at the star's position by a current solution,
the pixel x', and not where it was detected: z = z(x') + J (x - x').  J may then be constant, for
z(x') - S p is as small as the solution is good.  At the detection itself it would be as large as
the error is, and a model that made pixels smaller would make errors smaller.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba as nb
import numpy as np

from bayesdist.infer.kernel.blocks import PASS, share_out
from bayesdist.infer.kernel.lanes import WIDTH, load, put, total
from bayesdist.infer.kernel.sky_places import legendre
from bayesdist.infer.kernel.star_modes import (
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
    to_mode,
)
from bayesdist.infer.kernel.vectors import whole_vectors
from bayesdist.utils.arrays import Float, Int


@nb.njit(**PASS)
def _weighted_stars(
    first, end, starts, z, W, var, j2, log_core, log_out, time, factor, centre, precision, least,
    stars, member,
):  # fmt: skip
    whole_vectors()
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


@nb.njit(cache=True, forceinline=True)
def _dot(coef, at, phi, row, n):
    """Sum of the first n products of two rows; n fills whole vectors."""
    whole_vectors()
    lanes = load(coef, at, 0) * load(phi, row, 0)
    for k in range(WIDTH, n, WIDTH):
        lanes += load(coef, at, k) * load(phi, row, k)
    return total(lanes)


@nb.njit(cache=True, forceinline=True)
def _add(out, at, phi, row, n, factor):
    """Add so many times the first n numbers of a row to one of `out`; n fills whole vectors."""
    whole_vectors()
    for k in range(0, n, WIDTH):
        put(out, at, k, load(out, at, k) + load(phi, row, k) * factor)


@nb.njit(**PASS)
def _eliminate_stars(
    first, last, starts, group, X, Y, offset, W, var, time, factor, centre, precision, stars, coef,
    chip, n_chips, linear, extra, columns, order, j2, log_core, log_out, least, seen, weights,
    pulls, scalars, rows, factors,
):  # fmt: skip
    whole_vectors()
    q, m, odds = stars.shape[1], columns.shape[1], far_odds(log_core, log_out)
    K, low, top = (order + 1) * (order + 2) // 2, coef.shape[1], weights.shape[1]
    n_params = rows.shape[1]
    S, A, b = np.zeros((2, MOST_STAR)), np.zeros((MOST_STAR, MOST_STAR)), np.zeros(MOST_STAR)
    px, py, by = np.empty(2 * order + 1), np.empty(2 * order + 1), np.empty((2, m))
    basis, dense = np.zeros((16, top)), np.empty((q * n_chips * 2, low))
    for s in range(first, last):
        a, e = starts[s], starts[s + 1]
        if e - a > len(basis):
            basis = np.zeros((2 * (e - a), top))
        mine = own_rows(W, var, a, e)
        when = time[a:e] if q >= 4 else time
        where = factor[a:e] if q == 5 else factor
        for i in range(a, e):
            g = group[i]
            legendre(X[i], Y[i], 2 * order, px, py, basis[i - a])
            mine[PLACE_U, i - a] = offset[i, 0] + _dot(coef, 2 * g, basis, i - a, low)
            mine[PLACE_V, i - a] = offset[i, 1] + _dot(coef, 2 * g + 1, basis, i - a, low)
        p = stars[s]
        value, observed = to_mode(
            mine, e - a, j2, log_core, log_out, when, where, centre[s], precision[s], p, S, A, b,
            seen, least,
        )  # fmt: skip
        scalars[0] += value - log_root(A, q, least)
        row = (s - first) * q
        for k in range(q):
            for l in range(k + 1):
                factors[s - first, k, l] = A[k, l]
                A[k, l] = precision[s, k, l]
        dense[:] = 0.0
        for i in range(a, e):
            g, phi = group[i], i - a
            design(S, q, i - a, when, where)
            wu, wv, square = residual(i - a, mine, S, p, q)
            s2 = var[i] + j2
            w = membership(odds, square, s2)
            h0, h1, h2 = hessian(i - a, mine, wu, wv, s2, w, observed)
            add_curvature(A, S, q, h0, h1, h2)
            scalars[1] += w
            scalars[2] += w * square / s2
            _add(weights, 3 * g, basis, phi, top, h0)
            _add(weights, 3 * g + 1, basis, phi, top, h1)
            _add(weights, 3 * g + 2, basis, phi, top, h2)
            _add(pulls, 2 * g, basis, phi, low, -w * wu / s2)
            _add(pulls, 2 * g + 1, basis, phi, low, -w * wv / s2)
            for n in range(m):
                for axis in range(2):
                    by[axis, n] = _dot(extra, 2 * (g * m + n) + axis, basis, phi, low)
            for k in range(q):
                hu, hv = S[0, k] * h0 + S[1, k] * h1, S[0, k] * h1 + S[1, k] * h2
                # by coefficients before the frame, and by its parameters
                for axis in range(2):
                    along = hu * linear[g, 0, axis] + hv * linear[g, 1, axis]
                    at = 2 * (k * n_chips + chip[g]) + axis
                    _add(dense, at, basis, phi, low, along)
                for n in range(m):
                    if columns[g, n] >= 0:
                        rows[row + k, columns[g, n]] += hu * by[0, n] + hv * by[1, n]
        for k in range(q):
            for c in range(2 * n_chips):
                for l in range(K):
                    rows[row + k, c * K + l] += dense[2 * k * n_chips + c, l]
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


class EliminationSums(NamedTuple):
    """Sums of a second-order expansion by group, in whole vectors: what is beyond is no sum.

    With the Legendre functions up to twice the order, by which products of two are sums
    (`product_table`).
    """

    weights: Float  # (G, 3, M or more) of the curvature uu, uv, vv by position
    pulls: Float  # (G, 2, K or more) of its gradient
    scalars: Float  # (3,) log density, sums of w, and of w times the squared normalised residual

    @classmethod
    def zero(cls, n_groups: int, order: int) -> EliminationSums:
        """Sums over no star."""
        K, M = (order + 1) * (order + 2) // 2, (order + 1) * (2 * order + 1)
        shapes = (n_groups, 3, M + -M % WIDTH), (n_groups, 2, K + -K % WIDTH), (3,)
        return cls(*map(np.zeros, shapes))


def eliminate_stars(
    first: int, last: int, detections: tuple[Any, ...], stars: Float,
    coef: Float, chip: Int, linear: Float, extra: Float, columns: Int, n_params: int, order: int,
    j2: float, log_core: float, log_out: float, least: float, seen: bool, sums: EliminationSums,
) -> tuple[Float, Float]:  # fmt: skip
    """Move stars first..last to their modes and add to the sums of a second-order expansion.

    `detections` are starts, group, X, Y, offset, W, var, time, factor, centre and precision.
    coef (G, 2, K): of the Legendre products; of each group its chip (G,), the linear part (G, 2, 2)
    of its frame, the derivatives (G, m, 2, K) by its other parameters and the indices of these
    (G, m), -1 for none.
    least: root of the least curvature that a star's position may have.
    seen: curvature of the mixture itself.

    Returns rows (S q, D): L^-1 B of each star; factors (S, q, q): L.
    """
    q = stars.shape[1]
    rows, factors = np.zeros(((last - first) * q, n_params)), np.zeros((last - first, q, q))
    _eliminate_stars(
        first, last, *detections, stars, _in_vectors(coef), chip, int(chip.max()) + 1, linear,
        _in_vectors(extra), columns, order, j2, log_core, log_out, least, seen,
        *map(_rows, sums[:2]), sums.scalars, rows, factors,
    )  # fmt: skip
    return rows, factors


def _in_vectors(coefficients: Float) -> Float:
    """Rows of coefficients (..., K) with zeros behind them that fill whole vectors."""
    K = coefficients.shape[-1]
    out = np.zeros((*coefficients.shape[:-1], K + -K % WIDTH))
    out[..., :K] = coefficients
    return _rows(out)


def _rows(array: Float) -> Float:
    """Rows (..., n) below each other, as a view."""
    return array.reshape(-1, array.shape[-1])
