"""Sums over the stars that second-order steps need: normal equations, gradient and Hessian.

A normal matrix is a sum of w phi_k phi_l.  The product of two Legendre functions is a sum of
others, of twice the order: so only the moments of w with those are summed over the stars, 66 for
order 5 instead of 231 products, and the matrix follows by a fixed linear map (`product_table`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numba as nb
import numpy as np
from numpy.polynomial import legendre as series

from bayesdist.infer.kernel.blocks import (
    BLOCK,
    PASS,
    aligned,
    lay_out,
    put_ones,
    scratch,
    share_out,
    threads_for,
)
from bayesdist.infer.kernel.lanes import (
    AT_MOST,
    INNER,
    ROWS,
    WIDTH,
    choose,
    first_lanes,
    larger,
    load,
    put,
    smaller,
    spread,
    tile,
    total,
)
from bayesdist.infer.kernel.mixture import Constants, log_of_product, packed
from bayesdist.infer.kernel.numeric import exp_negative, inverse_root
from bayesdist.infer.kernel.polynomial import evaluate, legendre
from bayesdist.infer.kernel.vectors import whole_vectors
from bayesdist.utils.arrays import Float, Int

PIECE = 4096
EVALUATIONS = 10  # cost of the sums of one star, in likelihood evaluations

N_LEAST, N_MIXTURE = 9, 10  # scalar sums of the two passes
COLUMNS = 12  # of the mixture: 11, and one of zeros, since they are taken by three
N_HYPER = 3  # log j, logit f, log s_out


@dataclass(frozen=True, eq=False)
class Moments:
    """Sums over the stars of each group."""

    weight: Float  # sum (G, 3, K, K) of w phi phi^T for the axis pairs uu, uv, vv
    right: Float  # sum (G, 2, K) of phi times minus the gradient by the model
    # mixed second derivatives (G, 3, 2, K) with log j, logit f, log s_out; zero in least squares
    cross: Float
    scalars: Float  # sums over all groups: see the functions


def _powers(order: int) -> tuple[Int, Int]:
    """Exponents i, j of all terms to a total order, by total order, then descending i."""
    i, j = np.array([(t - j, j) for t in range(order + 1) for j in range(t + 1)]).T
    return i, j


@cache
def product_table(order: int) -> Float:
    """Legendre coefficients (K, K, M) of the products of two basis functions.

    phi_k phi_l = sum_m T[k, l, m] P_i(X) P_j(Y), with (i, j) in the order of the moments: by total
    order up to 2 `order`, then descending i.
    """
    top = 2 * order
    one = np.zeros((order + 1, order + 1, top + 1))
    for a in range(order + 1):
        for b in range(order + 1):
            coefficients = series.legmul([0] * a + [1], [0] * b + [1])
            one[a, b, : len(coefficients)] = coefficients
    i, j = _powers(order)
    mi, mj = _powers(top)
    return one[np.ix_(i, i, mi)] * one[np.ix_(j, j, mj)]


def _matrices(moments: Float, order: int) -> Float:
    """Sums of w phi phi^T (G, c, K, K) from the moments (G, c, M) of the weights."""
    table = product_table(order)
    matrices = moments @ table.reshape(-1, table.shape[-1]).T
    return np.asarray(matrices.reshape(*moments.shape[:2], *table.shape[:2]))


# Sums of three rows with as many Legendre functions as the registers hold: one function a number.
_ONE, _TWO, _THREE, _FOUR, _FIVE, _SIX = (tile(n, BLOCK) for n in range(1, 7))


def room_for(order: int, columns: int) -> tuple[Float, ...]:
    """Room for the stars of a block, two models, columns to be summed, P, Q, lanes of the sums.

    The lanes are those of the moments of three columns at a time, (columns / 3, T, T, 3, WIDTH)
    with i + j < T; only the first three, the weights, are taken to twice the order.
    """
    T = 2 * order + 1
    return (
        *(scratch(n) for n in (6, 2, 2, columns, T, T)),
        aligned(columns // ROWS, T, T, ROWS, WIDTH),
    )


@nb.njit(**INNER)
def add_columns(columns, n, P, Q, lanes):
    """Add the moments of some stars to lanes."""
    whole_vectors()
    for g in range(len(lanes)):
        top = len(P) if g == 0 else (len(P) + 1) >> 1
        for i in range(top):
            j = 0
            while j < top - i:
                left = top - i - j
                some = left if left <= AT_MOST else min((left + 1) >> 1, AT_MOST)  # alike, rather
                if some == 1:
                    _ONE(n, columns, g, P, i, Q, j, lanes)
                elif some == 2:
                    _TWO(n, columns, g, P, i, Q, j, lanes)
                elif some == 3:
                    _THREE(n, columns, g, P, i, Q, j, lanes)
                elif some == 4:
                    _FOUR(n, columns, g, P, i, Q, j, lanes)
                elif some == 5:
                    _FIVE(n, columns, g, P, i, Q, j, lanes)
                else:
                    _SIX(n, columns, g, P, i, Q, j, lanes)
                j += some


@nb.njit(**INNER)
def write_columns(lanes, out):
    """Write moments to out (columns, M), by total order, and zeros to the lanes."""
    whole_vectors()
    T = lanes.shape[1]
    for g in range(len(lanes)):
        top = T if g == 0 else (T + 1) >> 1
        for i in range(top):
            for j in range(top - i):
                at, one = (i + j) * (i + j + 1) // 2 + j, lanes[g, i, j]
                for r in range(ROWS):
                    sums = load(one, r, 0)
                    out[ROWS * g + r, at] = total(sums)
                    put(one, r, 0, spread(0.0, sums))


@nb.njit(**PASS)
def _least_squares(
    start, stop, stars, about, test, weighted, P, Q, lanes,
    pieces, columns, coef_about, coef_test, order, rules, sums, scalars,
):  # fmt: skip
    whole_vectors()
    chi2_limit, r2_limit, corner, power = rules[0], rules[1], rules[2], int(rules[3])
    zero = spread(0.0, load(about, 0, 0))
    for b in range(start, stop):
        g, first, end = pieces[b]
        used_sum = far_sum = chi2 = uu = vv = left_out = weighted_chi2 = u_sum = v_sum = zero
        for a in range(first, end, BLOCK):
            e = min(a + BLOCK, end)
            n = e - a
            lay_out(columns, a, e, stars)
            evaluate(coef_about[g], order, stars, n, about)
            evaluate(coef_test[g], order, stars, n, test)
            for s in range(0, n, WIDTH):
                x, y = load(stars, 0, s), load(stars, 1, s)
                u, v = load(stars, 2, s), load(stars, 3, s)
                iu, iv = 1.0 / load(stars, 4, s), 1.0 / load(stars, 5, s)
                du, dv = u - load(test, 0, s), v - load(test, 1, s)
                there = first_lanes(n - s, spread(1.0, x), 0.0)
                near = choose(du * du + dv * dv, r2_limit, there, 0.0)
                used = choose(du * du * iu + dv * dv * iv, chi2_limit, near, 0.0)
                extra = 1.0 + (corner - 1.0) * 0.5 * (x * x + y * y)
                factor = used * extra * extra if power == 2 else used * extra
                ru, rv = u - load(about, 0, s), v - load(about, 1, s)
                wu, wv = factor * iu, factor * iv
                put(weighted, 0, s, wu)
                put(weighted, 1, s, wv)
                put(weighted, 3, s, wu * ru)
                put(weighted, 4, s, wv * rv)
                used_sum, far_sum = used_sum + used, far_sum + (there - near)
                chi2 += used * (ru * ru * iu + rv * rv * iv)
                uu, vv = uu + used * ru * ru, vv + used * rv * rv
                left_out += (there - used) * (ru * ru + rv * rv)
                weighted_chi2 += wu * ru * ru + wv * rv * rv
                u_sum, v_sum = u_sum + used * ru, v_sum + used * rv
            legendre(stars, n, 2 * order, P, Q)
            add_columns(weighted, n, P, Q, lanes)
        write_columns(lanes, sums[b])
        scalars[b, 0] = total(used_sum)
        scalars[b, 1] = total(far_sum)
        scalars[b, 2] = total(chi2)
        scalars[b, 3] = total(uu)
        scalars[b, 4] = total(vv)
        scalars[b, 5] = total(left_out)
        scalars[b, 6] = total(weighted_chi2)
        scalars[b, 7] = total(u_sum)
        scalars[b, 8] = total(v_sum)


@nb.njit(**PASS)
def _mixture(
    start, stop, stars, model, density, weighted, P, Q, lanes,
    pieces, columns, coef, order, row, unit2, em, sums, scalars,
):  # fmt: skip
    whole_vectors()
    wavering, log_unit = 0.0 if em else 1.0, math.log(2 * math.pi * unit2)
    j2, core, outlier, half, never = row[0], row[1], row[2], row[3], row[4]
    f, w = row[5], row[6]
    zero = spread(0.0, load(density, 0, 0))
    for b in range(start, stop):
        g, first, end = pieces[b]
        low = by_j = outliers = by_s = jj = jf = js = pp = fs = ss = zero
        logs = 0.0
        for a in range(first, end, BLOCK):
            e = min(a + BLOCK, end)
            n = e - a
            lay_out(columns, a, e, stars)
            evaluate(coef[g], order, stars, n, model)
            put_ones(density, n)
            for s in range(0, n, WIDTH):
                ru = load(stars, 2, s) - load(model, 0, s)
                rv = load(stars, 3, s) - load(model, 1, s)
                au, av = load(stars, 4, s) + j2, load(stars, 5, s) + j2
                root = inverse_root(au * av)
                inverse = root * root
                iu, iv = av * inverse, au * inverse
                eu, ev = ru * ru * iu, rv * rv * iv
                r2 = ru * ru + rv * rv
                q_in, q_out = 0.5 * (eu + ev), r2 * half + never
                least = smaller(q_in, q_out)
                t = exp_negative(least - larger(q_in, q_out))
                peak = core * root
                # factors first: the product that is not needed may be denormal, which takes long
                d_in = peak * choose(q_in, q_out, 1.0, t)
                d_out = outlier * choose(q_in, q_out, t, 1.0)
                both = d_in + d_out
                put(density, 0, s, first_lanes(n - s, both, 1.0))
                low += first_lanes(n - s, least, 0.0)
                whole = first_lanes(n - s, 1.0 / both, 0.0)
                p, q = d_out * whole, d_in * whole
                pq = p * q
                # derivatives of log core minus log outlier, by u, v, log j, logit f, log s_out
                D_u, D_v = ru * (w - iu), rv * (w - iv)
                D_j = j2 * ((eu - 1.0) * iu + (ev - 1.0) * iv)
                D_s = 2.0 - r2 * w
                turn = pq * wavering
                wu, wv = q * iu + p * w, q * iv + p * w
                put(weighted, 0, s, wu - turn * D_u * D_u)
                put(weighted, 1, s, 0.0 - turn * D_u * D_v)
                put(weighted, 2, s, wv - turn * D_v * D_v)
                put(weighted, 3, s, wu * ru)
                put(weighted, 4, s, wv * rv)
                put(weighted, 5, s, q * 2.0 * j2 * ru * iu * iu + turn * D_j * D_u)
                if not em:
                    put(weighted, 6, s, q * 2.0 * j2 * rv * iv * iv + turn * D_j * D_v)
                    put(weighted, 7, s, 0.0 - turn * D_u)
                    put(weighted, 8, s, 0.0 - turn * D_v)
                    put(weighted, 9, s, p * 2.0 * ru * w + turn * D_s * D_u)
                    put(weighted, 10, s, p * 2.0 * rv * w + turn * D_s * D_v)
                second = 2.0 * D_j + 2.0 * j2 * j2 * (
                    (1.0 - 2.0 * eu) * iu * iu + (1.0 - 2.0 * ev) * iv * iv
                )
                by_j, outliers, by_s = by_j + q * D_j, outliers + p, by_s - p * D_s
                jj, jf = jj - (q * second + pq * D_j * D_j), jf + pq * D_j
                js, pp, fs = js - pq * D_j * D_s, pp + pq, fs + pq * D_s
                ss += 2.0 * p * r2 * w - pq * D_s * D_s
            logs += log_of_product(density) - n * log_unit
            legendre(stars, n, 2 * order, P, Q)
            add_columns(weighted, n, P, Q, lanes)
        write_columns(lanes, sums[b])
        scalars[b, 0] = logs - total(low)
        scalars[b, 1] = total(by_j)
        scalars[b, 2] = total(outliers)
        scalars[b, 3] = total(by_s)
        scalars[b, 4] = total(jj)
        scalars[b, 5] = total(jf)
        scalars[b, 6] = total(js)
        scalars[b, 7] = (end - first) * f * (1.0 - f) - total(pp)
        scalars[b, 8] = total(fs)
        scalars[b, 9] = total(ss)


def empty_sums(n_pieces: int, order: int, columns: int, scalars: int) -> tuple[Float, Float]:
    """Zeros (n_pieces, columns, M) and (n_pieces, scalars) for the sums of the pieces."""
    return np.zeros((n_pieces, columns, (order + 1) * (2 * order + 1))), np.zeros(
        (n_pieces, scalars)
    )


def _by_group(sums: Float, pieces: Int) -> Float:
    """Moments (G, columns, M) of each group from those of its consecutive pieces."""
    _, first = np.unique(pieces[:, 0], return_index=True)
    return np.asarray(np.add.reduceat(sums, first, axis=0))


def least_squares_moments(
    pieces: Int,
    columns: tuple[Float, ...],
    about: Float,
    test: Float,
    order: int,
    *,
    chi2_limit: float,
    abs_limit: float,
    corner: float = 1.0,
    power: int = 1,
) -> Moments:
    """Normal equations of weighted least squares with rejection.

    `pieces` (n, 3) are `pieces_of` size `PIECE`; `columns` (N,) are X, Y, u, v, var_u, var_v.
    Residuals are taken at the effective coefficients `about` (G, 2, K) of the scaled powers, and
    those at `test` decide on rejection: stars beyond either limit are left out.  `corner` is a
    factor on the inverse variance in the corners, rising as the square of the radius; `power` is 1,
    or 2 for the squared weights of a sandwich covariance.

    Scalars: stars used; stars beyond `abs_limit`; chi-square of those used; their squared residuals
    in u and in v; squared residuals of those left out; the weighted chi-square; residuals in u and
    v of those used.
    """
    K = (order + 1) * (order + 2) // 2
    sums, scalars = empty_sums(len(pieces), order, 6, N_LEAST)
    rules = np.array([chi2_limit, min(abs_limit, 1e150) ** 2, corner, float(power)])
    with threads_for(EVALUATIONS * len(columns[0])):
        share_out(
            _least_squares,
            len(pieces),
            pieces,
            columns,
            np.ascontiguousarray(about),
            np.ascontiguousarray(test),
            order,
            rules,
            sums,
            scalars,
            room=lambda: room_for(order, 6),
        )
    total = _by_group(sums, pieces)
    weight = np.zeros((len(about), 3, K, K))
    weight[:, 0::2] = _matrices(total[:, :2], order)
    right = total[:, 3:5, :K].copy()
    return Moments(weight, right, np.zeros((len(about), N_HYPER, 2, K)), scalars.sum(axis=0))


def mixture_moments(
    pieces: Int,
    columns: tuple[Float, ...],
    coef: Float,
    order: int,
    constants: Constants,
    *,
    em: bool = False,
) -> Moments:
    """Gradient and Hessian of the mixture's log-likelihood at one parameter vector.

    `coef` (G, 2, K) are effective coefficients of the scaled powers; `pieces`, `columns` and
    `order` as in `least_squares_moments`.  With `em` the weights are those of the
    expectation-maximisation step, which are never negative, in place of the Hessian, and `cross` is
    zero.

    Scalars: the log-likelihood; its derivatives by log j and, for logit f, the expected number of
    outliers, then by log s_out; minus the Hessian by log j, logit f, log s_out: jj, jf, js, ff, fs,
    ss.
    """
    sums, scalars = empty_sums(len(pieces), order, COLUMNS, N_MIXTURE)
    with threads_for(EVALUATIONS * len(columns[0])):
        share_out(
            _mixture,
            len(pieces),
            pieces,
            columns,
            np.ascontiguousarray(coef),
            order,
            packed(constants)[0],
            constants.unit2,
            em,
            sums,
            scalars,
            room=lambda: room_for(order, 6 if em else COLUMNS),
        )
    return mixture_sums(_by_group(sums, pieces), scalars.sum(axis=0), order, em)


def mixture_sums(total: Float, scalars: Float, order: int, em: bool) -> Moments:
    """Moments of a mixture from sums (G, COLUMNS, M) over the stars of each group."""
    K = (order + 1) * (order + 2) // 2
    weight = _matrices(total[:, :3], order)
    cross = total[:, 5:11, :K].reshape(len(total), N_HYPER, 2, K).copy()
    if em:
        cross[:] = 0.0
    return Moments(weight, total[:, 3:5, :K].copy(), cross, scalars)
