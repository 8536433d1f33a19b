"""Passes with results per star: residuals, outlier probabilities, and positions on the sky.

Polynomials are sums of powers of scaled pixel coordinates (by Horner's rule) or of Legendre
products.  Terms are sorted by total order, then by descending power of x.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from bayesdist.infer.kernel.blocks import (
    PASS,
    lay_out,
    modelled,
    share_out,
    star_room,
    threads_for,
)
from bayesdist.infer.kernel.lanes import FAST
from bayesdist.infer.kernel.mixture import Constants, packed
from bayesdist.infer.kernel.numeric import exp_negative, whole_vectors
from bayesdist.utils.arrays import Float, Int


@nb.njit(**PASS)
def _residuals(first, end, stars, model, blocks, columns, coef, order, out):
    whole_vectors()
    for b in range(first, end):
        g, a, e = blocks[b]
        lay_out(columns, a, e, stars)
        modelled(columns, coef[g], order, stars, e - a, model)
        for s in range(e - a):
            out[a + s, 0] = stars[2, s] - model[0, s]
            out[a + s, 1] = stars[3, s] - model[1, s]


def residuals(blocks: Int, columns: tuple[Float, ...], coef: Float, order: int) -> Float:
    """Residuals of the stars, data minus model, along the principal axes of their errors.

    Parameters
    ----------
    blocks : ndarray of int, shape (n, 3)
        Pieces of size `BLOCK` from `pieces_of`.
    columns : tuple of ndarray, shape (N,)
        `Stars.columns`.
    coef : ndarray, shape (G, 2, K)
        Effective coefficients of the scaled powers.
    order : int
        Polynomial order.

    Returns
    -------
    ndarray, shape (N, 2)
    """
    out = np.empty((len(columns[0]), 2))
    with threads_for(len(out)):
        share_out(
            _residuals,
            len(blocks),
            blocks,
            columns,
            np.ascontiguousarray(coef),
            order,
            out,
            room=star_room,
        )
    return out


@nb.njit(**PASS)
def _memberships(first, end, stars, model, blocks, columns, coef, order, rows, unit2, out):
    whole_vectors()
    each = len(rows) // len(out)
    share, constant = 1.0 / each, math.log(2 * math.pi * unit2)
    for b in range(first, end):
        g, a, e = blocks[b]
        n = e - a
        lay_out(columns, a, e, stars)
        for d in range(len(rows)):
            mean = out[d // each]
            modelled(columns, coef[d, g], order, stars, n, model)
            for s in range(n):
                ru, rv = stars[2, s] - model[0, s], stars[3, s] - model[1, s]
                iu, iv = 1.0 / (stars[4, s] + rows[d, 0]), 1.0 / (stars[5, s] + rows[d, 0])
                q_in = 0.5 * (ru * ru * iu + rv * rv * iv)
                q_out = (ru * ru + rv * rv) * rows[d, 3] + rows[d, 4]
                t = exp_negative(-abs(q_in - q_out))
                is_core = q_in <= q_out
                peak = rows[d, 1] * math.sqrt(iu * iv)
                d_in = peak if is_core else peak * t
                d_out = rows[d, 2] * t if is_core else rows[d, 2]
                loglik = math.log(d_in + d_out) - min(q_in, q_out) - constant
                mean[0, a + s] += share * d_out / (d_in + d_out)
                mean[1, a + s] += share * loglik
                mean[2, a + s] += share * loglik * loglik


def memberships(
    blocks: Int,
    columns: tuple[Float, ...],
    coef: Float,
    order: int,
    constants: Constants,
    each: int,
) -> Float:
    """Outlier probability, log-likelihood and its square for each star, averaged over draws.

    Parameters
    ----------
    blocks, columns, order
        See `residuals`.
    coef : ndarray, shape (D, G, 2, K)
        Effective coefficients of the scaled powers for D draws.
    constants : Constants
        Constants of the mixture for the D draws.
    each : int
        Number of consecutive draws over which the results are averaged.

    Returns
    -------
    ndarray, shape (D / each, 3, N)
    """
    out = np.zeros((len(coef) // each, 3, len(columns[0])))
    with threads_for(4 * out.shape[2] * len(coef)):
        share_out(
            _memberships,
            len(blocks),
            blocks,
            columns,
            np.ascontiguousarray(coef),
            order,
            packed(constants),
            constants.unit2,
            out,
            room=star_room,
        )
    return out


# -- sky positions of detections according to a model, and detector positions of stars -------------


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def legendre(x, y, order, px, py, phi):
    """Write all Legendre products at position (x, y) to `phi`; px and py are scratch arrays."""
    whole_vectors()
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
def powers(coef, order, x, y):
    """Sums u, v of c_ij x^i y^j by Horner's rule, with coefficients (2, K)."""
    whole_vectors()
    u = v = 0.0
    for i in range(order, -1, -1):
        at = order * (order + 1) // 2 + order - i
        of_u, of_v = coef[0, at], coef[1, at]
        for j in range(order - i - 1, -1, -1):
            at -= i + j + 2  # one power of y less
            of_u, of_v = of_u * y + coef[0, at], of_v * y + coef[1, at]
        u, v = u * x + of_u, v * x + of_v
    return u, v


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def powers_and_slopes(coef, order, x, y):
    """Sums u, v (see `powers`) and their derivatives u_x, u_y, v_x, v_y."""
    whole_vectors()
    u = ux = uy = v = vx = vy = 0.0
    for i in range(order, -1, -1):
        at = order * (order + 1) // 2 + order - i
        of_u, of_v, of_uy, of_vy = coef[0, at], coef[1, at], 0.0, 0.0
        for j in range(order - i - 1, -1, -1):
            at -= i + j + 2
            of_uy, of_vy = of_uy * y + of_u, of_vy * y + of_v
            of_u, of_v = of_u * y + coef[0, at], of_v * y + coef[1, at]
        ux, uy, u = ux * x + u, uy * x + of_uy, u * x + of_u
        vx, vy, v = vx * x + v, vy * x + of_vy, v * x + of_v
    return u, v, ux, uy, vx, vy


@nb.njit(**PASS)
def _positions(first, end, group, X, Y, coef, order, out):
    whole_vectors()
    for i in range(first, end):
        out[i, 0], out[i, 1] = powers(coef[group[i]], order, X[i], Y[i])


def positions(group: Int, X: Float, Y: Float, coef: Float, order: int) -> Float:
    """Sky positions of detections.

    Parameters
    ----------
    group : ndarray of int, shape (N,)
        Group of each detection.
    X, Y : ndarray, shape (N,)
        Scaled pixel coordinates.
    coef : ndarray, shape (G, 2, K)
        Coefficients of the powers of X and Y.
    order : int
        Polynomial order.

    Returns
    -------
    ndarray, shape (N, 2)
        Positions u, v.
    """
    out = np.empty((len(X), 2))
    share_out(_positions, len(X), group, X, Y, coef, order, out)
    return out


@nb.njit(**PASS)
def _slopes(first, end, group, X, Y, coef, order, out):
    whole_vectors()
    for i in range(first, end):
        _, _, ux, uy, vx, vy = powers_and_slopes(coef[group[i]], order, X[i], Y[i])
        out[i, 0, 0], out[i, 0, 1], out[i, 1, 0], out[i, 1, 1] = ux, uy, vx, vy


def slopes(group: Int, X: Float, Y: Float, coef: Float, order: int) -> Float:
    """Derivatives of sky positions with respect to X and Y.

    Parameters
    ----------
    group, X, Y, coef, order
        See `positions`.

    Returns
    -------
    ndarray, shape (N, 2, 2)
        Rows u, v; columns X, Y.
    """
    out = np.empty((len(X), 2, 2))
    share_out(_slopes, len(X), group, X, Y, coef, order, out)
    return out


@nb.njit(**PASS)
def _linearised(first, end, group, seen_X, seen_Y, X, Y, places, coef, half, order, out):
    whole_vectors()
    new_X, new_Y, offset, W = out
    for i in range(first, end):
        g, x, y = group[i], X[i], Y[i]
        u, v, ux, uy, vx, vy = powers_and_slopes(coef[g], order, x, y)
        ru, rv = u - places[i, 0], v - places[i, 1]
        det = ux * vy - uy * vx
        x -= (vy * ru - uy * rv) / det
        y -= (ux * rv - vx * ru) / det
        _, _, ux, uy, vx, vy = powers_and_slopes(coef[g], order, x, y)
        dx, dy = seen_X[i] - x, seen_Y[i] - y
        offset[i, 0], offset[i, 1] = ux * dx + uy * dy, vx * dx + vy * dy
        ux, uy, vx, vy = ux / half[g, 0], uy / half[g, 1], vx / half[g, 0], vy / half[g, 1]
        uu, uv, vv = ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy
        det = uu * vv - uv * uv
        W[i, 0], W[i, 1], W[i, 2] = vv / det, -uv / det, uu / det
        new_X[i], new_Y[i] = x, y


def linearised(
    group: Int,
    seen: Float,
    X: Float,
    Y: Float,
    places: Float,
    coef: Float,
    half: Float,
    order: int,
) -> tuple[Float, Float, Float, Float]:
    """Detector positions of stars predicted by a solution, and the linearised model there.

    Parameters
    ----------
    group : ndarray, shape (N,)
        Group of each detection.
    seen : ndarray, shape (2, N)
        Scaled pixel coordinates of the detections.
    X, Y : ndarray, shape (N,)
        Current estimates of the scaled pixel coordinates of the detections' stars.
    places : ndarray, shape (N, 2)
        Sky positions of the detections' stars.
    coef : ndarray, shape (G, 2, K)
        Coefficients of the scaled powers.
    half : ndarray, shape (G, 2)
        Size in pixels of one unit of X and Y.
    order : int
        Total order of the polynomials.

    Returns
    -------
    X, Y : ndarray, shape (N,)
        Scaled pixel coordinates of the stars after one more Newton step.
    offset : ndarray, shape (N, 2)
        J times the displacement in pixels from the star to the detection, with J the Jacobian.
    W : ndarray, shape (N, 3)
        Elements uu, uv, vv of the inverse of J J^T.
    """
    n = len(X)
    out = np.empty(n), np.empty(n), np.empty((n, 2)), np.empty((n, 3))
    share_out(_linearised, n, group, *seen, X, Y, places, coef, half, order, out)
    return out
