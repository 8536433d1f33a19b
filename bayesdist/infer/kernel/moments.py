"""Sums over the stars for second-order methods: normal equations, gradient and Hessian.

A normal matrix is a sum of w phi_k phi_l.  Products of two Legendre functions are sums of Legendre
functions up to twice the order.  It is therefore enough to accumulate the moments of w with those,
66 for order 5 instead of 231 products.  A fixed linear map (`product_table`) gives the matrix.
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
    modelled,
    off_axes,
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
from bayesdist.infer.kernel.numeric import (
    exp_negative,
    inverse_root,
    legendre,
    whole_vectors,
)
from bayesdist.utils.arrays import Float, Int

PIECE = 4096  # maximum number of stars per piece
EVALUATIONS = 10  # cost of the sums per star, relative to one likelihood evaluation

N_LEAST, N_MIXTURE = 9, 10  # number of scalar sums for least squares and for the mixture
COLUMNS = 12  # weights of the mixture: 11 and one of zeros, since they are processed in threes
N_HYPER = 3  # hyperparameters: log j, logit f, log s_out


@dataclass(frozen=True, eq=False)
class Moments:
    """Sums over the stars of each of G groups, for K polynomial terms.

    Parameters
    ----------
    weight : ndarray, shape (G, 3, K, K)
        Sum of w phi phi^T for the axis pairs uu, uv, vv.
    right : ndarray, shape (G, 2, K)
        Sum of phi times d log L / d(model position).
    cross : ndarray, shape (G, 3, 2, K)
        Mixed second derivatives with log j, logit f, log s_out; zero for least squares.
    scalars : ndarray
        Sums over all groups; see the functions that compute them.
    """

    weight: Float
    right: Float
    cross: Float
    scalars: Float


def _powers(order: int) -> tuple[Int, Int]:
    """Exponents i, j of all terms up to a total order, sorted by i + j, then by descending i."""
    i, j = np.array([(t - j, j) for t in range(order + 1) for j in range(t + 1)]).T
    return i, j


@cache
def product_table(order: int) -> Float:
    """Legendre coefficients (K, K, M) of the products of two basis functions.

    phi_k phi_l = sum_m T[k, l, m] P_i(X) P_j(Y), where m enumerates the moments (i, j) with
    i + j <= 2 `order`, sorted by i + j, then by descending i.
    """
    top = 2 * order
    products = np.zeros((order + 1, order + 1, top + 1))
    for a in range(order + 1):
        for b in range(order + 1):
            coefficients = series.legmul([0] * a + [1], [0] * b + [1])
            products[a, b, : len(coefficients)] = coefficients
    i, j = _powers(order)
    mi, mj = _powers(top)
    return products[np.ix_(i, i, mi)] * products[np.ix_(j, j, mj)]


def _matrices(moments: Float, order: int) -> Float:
    """Matrices sum w phi phi^T (G, c, K, K) from the moments (G, c, M) of the weights w."""
    table = product_table(order)
    matrices = moments @ table.reshape(-1, table.shape[-1]).T
    return np.asarray(matrices.reshape(*moments.shape[:2], *table.shape[:2]))


# Functions that sum three rows of weights with one to six Legendre functions in registers.
_ONE, _TWO, _THREE, _FOUR, _FIVE, _SIX = (tile(n, BLOCK) for n in range(1, 7))


def room_for(order: int, columns: int) -> tuple[Float, ...]:
    """Scratch arrays for the stars of a block, two models, the weights, P, Q, and the sums.

    The sums are lanes of the moments of three columns at a time, (columns / 3, T, T, 3, WIDTH),
    with i + j < T.  Only the first three columns, those of the Hessian, are needed up to twice the
    order.
    """
    T = 2 * order + 1
    return (
        *(scratch(n) for n in (8, 2, 2, columns, T, T)),
        aligned(columns // ROWS, T, T, ROWS, WIDTH),
    )


@nb.njit(**INNER)
def add_columns(columns, n, P, Q, lanes):
    """Add the moments of the n stars of a block to the sums in `lanes`."""
    whole_vectors()
    for g in range(len(lanes)):
        top = len(P) if g == 0 else (len(P) + 1) >> 1
        for i in range(top):
            j = 0
            while j < top - i:
                n_left = top - i - j
                # two tiles of similar width rather than a wide and a narrow one
                n_columns = n_left if n_left <= AT_MOST else min((n_left + 1) >> 1, AT_MOST)
                if n_columns == 1:
                    _ONE(n, columns, g, P, i, Q, j, lanes)
                elif n_columns == 2:
                    _TWO(n, columns, g, P, i, Q, j, lanes)
                elif n_columns == 3:
                    _THREE(n, columns, g, P, i, Q, j, lanes)
                elif n_columns == 4:
                    _FOUR(n, columns, g, P, i, Q, j, lanes)
                elif n_columns == 5:
                    _FIVE(n, columns, g, P, i, Q, j, lanes)
                else:
                    _SIX(n, columns, g, P, i, Q, j, lanes)
                j += n_columns


@nb.njit(**INNER)
def write_columns(lanes, out):
    """Write the moments to out (columns, M), sorted by total order, and reset the lanes to zero."""
    whole_vectors()
    T = lanes.shape[1]
    for g in range(len(lanes)):
        top = T if g == 0 else (T + 1) >> 1
        for i in range(top):
            for j in range(top - i):
                at, tile_sums = (i + j) * (i + j + 1) // 2 + j, lanes[g, i, j]
                for r in range(ROWS):
                    sums = load(tile_sums, r, 0)
                    out[ROWS * g + r, at] = total(sums)
                    put(tile_sums, r, 0, spread(0.0, sums))


@nb.njit(**PASS)
def _least_squares(
    start, stop, stars, about, test, weighted, P, Q, lanes,
    pieces, columns, coef_about, coef_test, order, rules, sums, scalars,
):  # fmt: skip
    whole_vectors()
    chi2_limit, r2_limit, spared = rules[0], rules[1], rules[2]
    corner, power = rules[3], int(rules[4])
    zero, turned = spread(0.0, load(about, 0, 0)), len(columns[6]) > 0
    for b in range(start, stop):
        g, first, end = pieces[b]
        used_sum = far_sum = chi2 = uu = vv = left_out = weighted_chi2 = u_sum = v_sum = zero
        for a in range(first, end, BLOCK):
            e = min(a + BLOCK, end)
            n = e - a
            lay_out(columns, a, e, stars)
            modelled(columns, coef_about[g], order, stars, n, about)
            modelled(columns, coef_test[g], order, stars, n, test)
            for s in range(0, n, WIDTH):
                x, y = load(stars, 0, s), load(stars, 1, s)
                u, v = load(stars, 2, s), load(stars, 3, s)
                iu, iv = 1.0 / load(stars, 4, s), 1.0 / load(stars, 5, s)
                du, dv = u - load(test, 0, s), v - load(test, 1, s)
                present = first_lanes(n - s, spread(1.0, x), 0.0)
                square = du * du * iu + dv * dv * iv
                near = choose(du * du + dv * dv, r2_limit, present, 0.0)
                near = choose(square, spared, present, near)
                used = choose(square, chi2_limit, near, 0.0)
                extra = 1.0 + (corner - 1.0) * 0.5 * (x * x + y * y)
                factor = used * extra * extra if power == 2 else used * extra
                ru, rv = u - load(about, 0, s), v - load(about, 1, s)
                wu, wv = factor * iu, factor * iv
                put(weighted, 0, s, wu)
                put(weighted, 1, s, zero)
                put(weighted, 2, s, wv)
                put(weighted, 3, s, wu * ru)
                put(weighted, 4, s, wv * rv)
                used_sum, far_sum = used_sum + used, far_sum + (present - near)
                chi2 += used * (ru * ru * iu + rv * rv * iv)
                left_out += (present - used) * (ru * ru + rv * rv)
                weighted_chi2 += wu * ru * ru + wv * rv * rv
                if turned:
                    c, d = load(stars, 6, s), load(stars, 7, s)
                    ru, rv = c * ru - d * rv, d * ru + c * rv
                uu, vv = uu + used * ru * ru, vv + used * rv * rv
                u_sum, v_sum = u_sum + used * ru, v_sum + used * rv
            off_axes(columns, stars, n, weighted, 1)
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
    j2, core, outlier, half = row[0], row[1], row[2], row[3]
    never, f, w = row[4], row[5], row[6]
    zero = spread(0.0, load(density, 0, 0))
    for b in range(start, stop):
        g, first, end = pieces[b]
        low = by_j = outliers = by_s = jj = jf = js = pp = fs = ss = zero
        logs = 0.0
        for a in range(first, end, BLOCK):
            e = min(a + BLOCK, end)
            n = e - a
            lay_out(columns, a, e, stars)
            modelled(columns, coef[g], order, stars, n, model)
            put_ones(density, n)
            for s in range(0, n, WIDTH):
                ru = load(stars, 2, s) - load(model, 0, s)
                rv = load(stars, 3, s) - load(model, 1, s)
                au, av = load(stars, 4, s) + j2, load(stars, 5, s) + j2
                root = inverse_root(au * av)
                iu, iv = av * root * root, au * root * root
                eu, ev = ru * ru * iu, rv * rv * iv
                r2 = ru * ru + rv * rv
                q_in, q_out = 0.5 * (eu + ev), r2 * half + never
                q_min = smaller(q_in, q_out)
                t = exp_negative(q_min - larger(q_in, q_out))
                peak = core * root
                # select the factors first: the unused product may be a denormal number (slow)
                d_in = peak * choose(q_in, q_out, 1.0, t)
                d_out = outlier * choose(q_in, q_out, t, 1.0)
                density_sum = d_in + d_out
                put(density, 0, s, first_lanes(n - s, density_sum, 1.0))
                low += first_lanes(n - s, q_min, 0.0)
                inverse_sum = first_lanes(n - s, 1.0 / density_sum, 0.0)
                p, q = d_out * inverse_sum, d_in * inverse_sum
                pq = p * q
                # derivatives of log(core / outlier) with respect to u, v, log j, log s_out
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
            off_axes(columns, stars, n, weighted, 1 if em else 4)
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
    """Zero arrays (n_pieces, columns, M) and (n_pieces, scalars) for the sums of each piece."""
    return np.zeros((n_pieces, columns, (order + 1) * (2 * order + 1))), np.zeros(
        (n_pieces, scalars)
    )


def _by_group(sums: Float, pieces: Int) -> Float:
    """Moments (G, columns, M) per group: sums over its consecutive pieces."""
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
    spared_chi2: float = 0.0,
    corner: float = 1.0,
    power: int = 1,
) -> Moments:
    """Sums for weighted least squares with rejection.

    Parameters
    ----------
    pieces : ndarray, shape (n, 3)
        Pieces of size `PIECE` from `pieces_of`.
    columns : tuple of ndarray, shape (N,)
        `Stars.columns`.
    about : ndarray, shape (G, 2, K)
        Effective coefficients of the scaled powers at which residuals are computed.
    test : ndarray, shape (G, 2, K)
        Effective coefficients for the residuals that decide on rejection.
    order : int
        Polynomial order.
    chi2_limit, abs_limit : float
        Stars with a larger chi-square, or a larger radial residual, are rejected.
    spared_chi2 : float
        Chi-square up to which a star is kept whatever its residual is.
    corner : float
        Factor on the inverse variance in the corners, increasing with the square of the radius.
    power : int
        1, or 2 for the squared weights of a sandwich covariance.

    Returns
    -------
    Moments
        Its `scalars` are: number of stars used; number beyond `abs_limit`; chi-square of the stars
        used; sums of their squared residuals in u and in v; sum of the squared residuals of the
        rejected stars; weighted chi-square; sums of the residuals in u and in v of the stars used.
    """
    K = (order + 1) * (order + 2) // 2
    sums, scalars = empty_sums(len(pieces), order, 6, N_LEAST)
    rules = np.array([chi2_limit, min(abs_limit, 1e150) ** 2, spared_chi2, corner, float(power)])
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
    weight = _matrices(total[:, :3], order)
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
    """Sums for the gradient and Hessian of the mixture log-likelihood at one parameter vector.

    Parameters
    ----------
    pieces, columns, order
        See `least_squares_moments`.
    coef : ndarray, shape (G, 2, K)
        Effective coefficients of the scaled powers.
    constants : Constants
        Constants of the mixture for this parameter vector.
    em : bool
        True for the weights of the expectation-maximisation step instead of the Hessian. They are
        never negative, and `cross` is zero.

    Returns
    -------
    Moments
        Its `scalars` are: the log-likelihood; its derivative with respect to log j; the expected
        number of outliers, which enters the derivative with respect to logit f; the derivative with
        respect to log s_out; minus the Hessian in (log j, logit f, log s_out): jj, jf, js, ff, fs,
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
    """`Moments` of a mixture from sums `total` (G, COLUMNS, M) over the stars of each group."""
    K = (order + 1) * (order + 2) // 2
    weight = _matrices(total[:, :3], order)
    cross = total[:, 5:11, :K].reshape(len(total), N_HYPER, 2, K).copy()
    if em:
        cross[:] = 0.0
    return Moments(weight, total[:, 3:5, :K].copy(), cross, scalars)
