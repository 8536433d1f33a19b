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
from numpy.typing import NDArray

from bayesdist.infer.kernel.blocks import BLOCK, PASS, share_out, threads_for
from bayesdist.infer.kernel.mixture import Constants, log_of_product, packed
from bayesdist.infer.kernel.numeric import exp_negative
from bayesdist.infer.kernel.polynomial import FAST, horner, legendre

__all__ = ["PIECE", "Moments", "least_squares_moments", "mixture_moments"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

PIECE = 4096  # stars whose sums are separate, to be shared among threads
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


# Only here may the compiler choose the order of a sum.  Where it could reorder more, it makes other
# last bits when it compiles the same code again, as it does for numba's cache.
@nb.njit(cache=True, forceinline=True, fastmath=FAST | {"reassoc"})
def _dot(a, b):
    """Sum of the products of two blocks."""
    total = 0.0
    for s in range(BLOCK):
        total += a[s] * b[s]
    return total


@nb.njit(cache=True, forceinline=True, fastmath=FAST | {"reassoc"})
def _nine_dots(a, b, c, p, q, r):
    """Sums of the products of three blocks with three others, each loaded once for three sums."""
    ap = aq = ar = bp = bq = br = cp = cq = cr = 0.0
    for s in range(BLOCK):
        ap += a[s] * p[s]
        aq += a[s] * q[s]
        ar += a[s] * r[s]
        bp += b[s] * p[s]
        bq += b[s] * q[s]
        br += b[s] * r[s]
        cp += c[s] * p[s]
        cq += c[s] * q[s]
        cr += c[s] * r[s]
    return (ap, bp, cp), (aq, bq, cq), (ar, br, cr)


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _add(columns, last, P, Q, order, work, out):
    """Add the moments of columns (n, BLOCK) with P_i Q_j to out (n, M).

    i + j is up to twice the order for the first three, the weights, and up to the order for others.
    Columns are taken by three, and so are the j.
    """
    a, b, c = work[0], work[1], work[2]
    for k in range(0, last, 3):
        top = 2 * order if k == 0 else order
        for i in range(top + 1):
            for s in range(BLOCK):
                a[s] = columns[k, s] * P[i, s]
                b[s] = columns[k + 1, s] * P[i, s]
                c[s] = columns[k + 2, s] * P[i, s]
            n = top + 1 - i
            for j in range(0, n - 2, 3):
                three = _nine_dots(a, b, c, Q[j], Q[j + 1], Q[j + 2])
                for m in range(3):
                    t = i + j + m
                    for column in range(3):
                        out[k + column, t * (t + 1) // 2 + j + m] += three[m][column]
            for j in range(n // 3 * 3, n):
                t = i + j
                for column in range(3):
                    out[k + column, t * (t + 1) // 2 + j] += _dot(work[column], Q[j])


@nb.njit(**PASS)
def _least_squares(
    start, stop, pieces, X, Y, u, v, var_u, var_v, coef, order, rules, sums, scalars
):
    top = 2 * order
    chi2_limit, r2_limit, corner, power = rules[0], rules[1], rules[2], int(rules[3])
    for b in range(start, stop):
        g, first, end = pieces[b]
        P, Q = np.empty((top + 1, BLOCK)), np.empty((top + 1, BLOCK))
        model, work = np.empty((4, BLOCK)), np.empty((3, BLOCK))
        pu, pv, tu, tv = model[0], model[1], model[2], model[3]
        # the third and sixth are zeros, since they are taken by three
        columns, parts = np.zeros((6, BLOCK)), np.empty((N_LEAST, BLOCK))
        for a in range(first, end, BLOCK):
            e = min(a + BLOCK, end)
            n = e - a
            Xb, Yb, ub, vb, su, sv = X[a:e], Y[a:e], u[a:e], v[a:e], var_u[a:e], var_v[a:e]
            for axis in range(2):  # in loops, so that they are compiled once
                legendre(Xb if axis == 0 else Yb, n, top, P if axis == 0 else Q)
            for m in range(4):
                horner(coef[g, m], order, Xb, Yb, n, model[m], work[0])
            columns[:] = 0.0
            parts[:] = 0.0
            for s in range(n):
                iu, iv = 1.0 / su[s], 1.0 / sv[s]
                du, dv = ub[s] - tu[s], vb[s] - tv[s]
                far = du * du + dv * dv > r2_limit
                unlikely = du * du * iu + dv * dv * iv > chi2_limit
                used = 0.0 if far or unlikely else 1.0
                extra = 1.0 + (corner - 1.0) * 0.5 * (Xb[s] * Xb[s] + Yb[s] * Yb[s])
                factor = used * (extra * extra if power == 2 else extra)
                ru, rv = ub[s] - pu[s], vb[s] - pv[s]
                wu, wv = factor * iu, factor * iv
                columns[0, s], columns[1, s] = wu, wv
                columns[3, s], columns[4, s] = wu * ru, wv * rv
                parts[0, s], parts[1, s] = used, 1.0 if far else 0.0
                parts[2, s] = used * (ru * ru * iu + rv * rv * iv)
                parts[3, s], parts[4, s] = used * ru * ru, used * rv * rv
                parts[5, s] = (1.0 - used) * (ru * ru + rv * rv)
                parts[6, s] = wu * ru * ru + wv * rv * rv
                parts[7, s], parts[8, s] = used * ru, used * rv
            for k in range(N_LEAST):
                scalars[b, k] += _dot(parts[k], P[0])
            _add(columns, len(columns), P, Q, order, work, sums[b])


@nb.njit(**PASS)
def _mixture(
    start, stop, pieces, X, Y, u, v, var_u, var_v, coef, order, row, unit2, em, sums, scalars
):
    top = 2 * order
    wavering, log_unit = 0.0 if em else 1.0, math.log(2 * math.pi * unit2)
    j2, core, outlier, half, never, f, w = (
        row[0],
        row[1],
        row[2],
        row[3],
        row[4],
        row[5],
        row[6],
    )
    for b in range(start, stop):
        g, first, end = pieces[b]
        P, Q = np.empty((top + 1, BLOCK)), np.empty((top + 1, BLOCK))
        pu, pv, work = np.empty(BLOCK), np.empty(BLOCK), np.empty((3, BLOCK))
        density = np.empty(BLOCK)
        columns, parts = np.empty((COLUMNS, BLOCK)), np.empty((N_MIXTURE, BLOCK))
        for a in range(first, end, BLOCK):
            e = min(a + BLOCK, end)
            n = e - a
            Xb, Yb, ub, vb, su, sv = X[a:e], Y[a:e], u[a:e], v[a:e], var_u[a:e], var_v[a:e]
            for axis in range(2):  # in a loop, so that they are compiled once
                horner(coef[g, axis], order, Xb, Yb, n, pu if axis == 0 else pv, work[0])
                legendre(Xb if axis == 0 else Yb, n, top, P if axis == 0 else Q)
            columns[:] = 0.0
            parts[:] = 0.0
            for s in range(n):
                ru, rv = ub[s] - pu[s], vb[s] - pv[s]
                iu, iv = 1.0 / (su[s] + j2), 1.0 / (sv[s] + j2)
                eu, ev = ru * ru * iu, rv * rv * iv
                r2 = ru * ru + rv * rv
                q_in, q_out = 0.5 * (eu + ev), r2 * half + never
                t = exp_negative(-abs(q_in - q_out))
                is_core = q_in <= q_out
                peak = core * math.sqrt(iu * iv)
                d_in = peak if is_core else peak * t
                d_out = outlier * t if is_core else outlier
                density[s] = d_in + d_out
                parts[0, s] = -q_in if is_core else -q_out
                whole = 1.0 / (d_in + d_out)
                p, q = d_out * whole, d_in * whole
                pq = p * q
                # derivatives of log core minus log outlier, by u, v, log j, logit f, log s_out
                D_u, D_v = -ru * iu + ru * w, -rv * iv + rv * w
                D_j = j2 * ((eu - 1.0) * iu + (ev - 1.0) * iv)
                D_s = 2.0 - r2 * w
                pq *= wavering
                columns[0, s] = q * iu + p * w - pq * D_u * D_u
                columns[1, s] = -pq * D_u * D_v
                columns[2, s] = q * iv + p * w - pq * D_v * D_v
                columns[3, s] = (q * iu + p * w) * ru
                columns[4, s] = (q * iv + p * w) * rv
                columns[5, s] = q * 2.0 * j2 * ru * iu * iu + pq * D_j * D_u
                columns[6, s] = q * 2.0 * j2 * rv * iv * iv + pq * D_j * D_v
                columns[7, s] = -pq * D_u
                columns[8, s] = -pq * D_v
                columns[9, s] = p * 2.0 * ru * w + pq * D_s * D_u
                columns[10, s] = p * 2.0 * rv * w + pq * D_s * D_v
                pq = p * q
                second = 2.0 * D_j + 2.0 * j2 * j2 * (
                    (1.0 - 2.0 * eu) * iu * iu + (1.0 - 2.0 * ev) * iv * iv
                )
                parts[1, s], parts[2, s], parts[3, s] = q * D_j, p, -p * D_s
                parts[4, s] = -q * second - pq * D_j * D_j
                parts[5, s], parts[6, s] = pq * D_j, -pq * D_j * D_s
                parts[7, s], parts[8, s] = f * (1.0 - f) - pq, pq * D_s
                parts[9, s] = 2.0 * p * r2 * w - pq * D_s * D_s
            for k in range(N_MIXTURE):
                scalars[b, k] += _dot(parts[k], P[0])
            scalars[b, 0] += log_of_product(density, n, work[0]) - n * log_unit
            _add(columns, 6 if em else COLUMNS, P, Q, order, work, sums[b])


def empty_sums(n_pieces: int, order: int, columns: int, scalars: int) -> tuple[Float, Float]:
    """Zeros (n_pieces, columns, M) and (n_pieces, scalars) for the sums of the pieces."""
    return np.zeros((n_pieces, columns, (order + 1) * (2 * order + 1))), np.zeros(
        (n_pieces, scalars)
    )


def _by_group(sums: Float, pieces: Int) -> Float:
    """Moments (G, columns, M) of each group from those of its consecutive pieces."""
    first = np.flatnonzero(np.diff(pieces[:, 0], prepend=-1))
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
            *columns,
            np.concatenate([about, test], axis=1),
            order,
            rules,
            sums,
            scalars,
        )
    total = _by_group(sums, pieces)
    weight = np.zeros((len(about), 3, K, K))
    weight[:, 0::2] = np.einsum("gcm,klm->gckl", total[:, :2], product_table(order), optimize=True)
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
            *columns,
            np.ascontiguousarray(coef),
            order,
            packed(constants)[0],
            constants.unit2,
            em,
            sums,
            scalars,
        )
    return mixture_sums(_by_group(sums, pieces), scalars.sum(axis=0), order, em)


def mixture_sums(total: Float, scalars: Float, order: int, em: bool) -> Moments:
    """Moments of a mixture from sums (G, COLUMNS, M) over the stars of each group."""
    K = (order + 1) * (order + 2) // 2
    weight = np.einsum("gcm,klm->gckl", total[:, :3], product_table(order), optimize=True)
    cross = total[:, 5:11, :K].reshape(len(total), N_HYPER, 2, K).copy()
    if em:
        cross[:] = 0.0
    return Moments(weight, total[:, 3:5, :K].copy(), cross, scalars)
