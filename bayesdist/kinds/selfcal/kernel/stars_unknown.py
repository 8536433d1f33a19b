"""Solve for the unknown positions of stars and eliminate them, in one pass over the detections.

Detections are sorted by star.  The model is evaluated at the pixel x' where the current solution
predicts the star, not at the detection x: z = z(x') + J (x - x').  J can then be kept constant,
because z(x') - S p vanishes as the solution converges.  With the model evaluated at the detection,
this difference would be as large as the measurement error, and a model with a smaller pixel scale
would appear to have smaller errors.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba as nb
import numpy as np

from bayesdist.infer.kernel.blocks import PASS, share_out
from bayesdist.infer.kernel.lanes import WIDTH, load, put, total
from bayesdist.infer.kernel.numeric import whole_vectors
from bayesdist.infer.kernel.small import cholesky
from bayesdist.infer.kernel.stars import legendre
from bayesdist.kinds.selfcal.kernel.star_modes import (
    MOST_STAR,
    PLACE_U,
    PLACE_V,
    add_curvature,
    design,
    far_odds,
    hessian,
    log_root,
    membership,
    own_rows,
    residual,
    to_mode,
)
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
        obs = own_rows(W, var, a, e)
        for i in range(a, e):
            obs[PLACE_U, i - a], obs[PLACE_V, i - a] = z[i, 0], z[i, 1]
        when = time[a:e] if q >= 4 else time
        parallax = factor[a:e] if q == 5 else factor
        to_mode(
            obs, e - a, j2, log_core, log_out, when, parallax, centre[s], precision[s], stars[s], S,
            A, b, False, least,
        )  # fmt: skip
        for i in range(a, e):
            design(S, q, i - a, when, parallax)
            _, _, square = residual(i - a, obs, S, stars[s], q)
            member[i] = membership(odds, square, var[i] + j2)


def weighted_stars(
    starts: Int, z: Float, W: Float, var: Float, j2: float, log_core: float, log_out: float,
    time: Float, factor: Float, centre: Float, precision: Float, least: float, stars: Float,
) -> Float:  # fmt: skip
    """Move stars to their modes for given sky positions of their N detections.

    Parameters
    ----------
    starts : ndarray of int, shape (n + 1,)
        Index of the first detection of each star, and the number N.
    z : ndarray, shape (N, 2)
        Sky positions of the detections.
    W : ndarray, shape (N, 3)
        Elements uu, uv, vv of the matrix that converts sky residuals to squared pixels.
    var : ndarray, shape (N,)
        Squared quoted errors in square pixels.
    j2, log_core, log_out : float
        Squared jitter, log of the core fraction, log density of outliers.
    time : ndarray, shape (N,)
        Years since the reference epoch; empty if stars have no proper motion.
    factor : ndarray, shape (N, 2)
        Parallax factors; empty without parallax.
    centre, precision : ndarray, shape (n, q) and (n, q, q)
        Gaussian priors of the stars.
    least : float
        Square root of the smallest curvature allowed for the position of a star.
    stars : ndarray, shape (n, q)
        Parameters of the stars, which are changed.

    Returns
    -------
    ndarray, shape (N,)
        Probability that each detection belongs to its star.
    """
    member = np.zeros(len(z))
    share_out(
        _weighted_stars, len(stars), starts, z, W, var, j2, log_core, log_out, time, factor,
        centre, precision, least, stars, member,
    )  # fmt: skip
    return member


@nb.njit(cache=True, forceinline=True)
def _dot(coef, at, phi, row, n):
    """Dot product of the first n entries of two rows, rounded up to whole vectors."""
    whole_vectors()
    lanes = load(coef, at, 0) * load(phi, row, 0)
    for k in range(WIDTH, n, WIDTH):
        lanes += load(coef, at, k) * load(phi, row, k)
    return total(lanes)


@nb.njit(cache=True, forceinline=True)
def _add(out, at, phi, row, n, factor):
    """Add `factor` times a row of `phi` to a row of `out`: n entries, rounded up to vectors."""
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
        parallax = factor[a:e] if q == 5 else factor
        for i in range(a, e):
            g = group[i]
            legendre(X[i], Y[i], 2 * order, px, py, basis[i - a])
            mine[PLACE_U, i - a] = offset[i, 0] + _dot(coef, 2 * g, basis, i - a, low)
            mine[PLACE_V, i - a] = offset[i, 1] + _dot(coef, 2 * g + 1, basis, i - a, low)
        p = stars[s]
        value, observed = to_mode(
            mine, e - a, j2, log_core, log_out, when, parallax, centre[s], precision[s], p, S, A, b,
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
            design(S, q, i - a, when, parallax)
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
                # derivatives with respect to the coefficients before the frame, then its parameters
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
        # factor exactly the sum of these terms: the curvature at the last Newton step is slightly
        # different, and directions that the detections leave free would not be free
        positive = cholesky(A, q)
        for k in range(q):
            for l in range(k + 1):
                if positive:
                    factors[s - first, k, l] = A[k, l]
                else:
                    A[k, l] = factors[s - first, k, l]
        # multiply by L^-1: the elimination subtracts the square of the result
        for k in range(q):
            for l in range(k):
                below = A[k, l]
                for n in range(n_params):
                    rows[row + k, n] -= below * rows[row + l, n]
            for n in range(n_params):
                rows[row + k, n] /= A[k, k]


class EliminationSums(NamedTuple):
    """Sums of a second-order expansion by group; rows are padded to whole SIMD vectors.

    The curvature is summed with Legendre functions up to twice the order; `product_table` converts
    these to sums with products of two basis functions.  Padding entries are meaningless.

    Parameters
    ----------
    weights : ndarray, shape (G, 3, M or more)
        Curvature uu, uv, vv in position times Legendre functions.
    pulls : ndarray, shape (G, 2, K or more)
        Gradient in position times Legendre functions.
    scalars : ndarray, shape (3,)
        Log density, sum of w, sum of w times squared normalised residual.
    """

    weights: Float
    pulls: Float
    scalars: Float

    @classmethod
    def zero(cls, n_groups: int, order: int) -> EliminationSums:
        """Sums of zeros for `n_groups` groups and polynomials of total order `order`."""
        K, M = (order + 1) * (order + 2) // 2, (order + 1) * (2 * order + 1)
        shapes = (n_groups, 3, M + -M % WIDTH), (n_groups, 2, K + -K % WIDTH), (3,)
        return cls(*map(np.zeros, shapes))


def eliminate_stars(
    first: int, last: int, detections: tuple[Any, ...], stars: Float,
    coef: Float, chip: Int, linear: Float, extra: Float, columns: Int, n_params: int, order: int,
    j2: float, log_core: float, log_out: float, least: float, seen: bool, sums: EliminationSums,
) -> tuple[Float, Float]:  # fmt: skip
    """Move stars first..last to their modes, and add their terms of a second-order expansion.

    Parameters
    ----------
    first, last : int
        Range of S stars.
    detections : tuple
        Arrays starts, group, X, Y, offset, W, var, time, factor, centre and precision.
    stars : ndarray, shape (n, q)
        Parameters of all stars; those in the range are changed.
    coef : ndarray, shape (G, 2, K)
        Coefficients of the Legendre products.
    chip : ndarray, shape (G,)
        Chip of each group.
    linear : ndarray, shape (G, 2, 2)
        Linear part of the frame of each group.
    extra : ndarray, shape (G, m, 2, K)
        Derivatives of `coef` with respect to the other parameters of a group.
    columns : ndarray, shape (G, m)
        Indices of these parameters; -1 for none.
    n_params : int
        Number D of model parameters.
    order : int
        Total order of the polynomials.
    j2, log_core, log_out : float
        Squared jitter, log of the core fraction, log density of outliers.
    least : float
        Square root of the smallest curvature allowed for the position of a star.
    seen : bool
        True for the curvature of the mixture, False for EM weights.
    sums : EliminationSums
        Sums to which the terms are added.

    Returns
    -------
    rows : ndarray, shape (S q, D)
        L^-1 B of each star, with B the mixed second derivatives.
    factors : ndarray, shape (S, q, q)
        Cholesky factors L of the curvature of each star.
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
    """Coefficients (..., K) as rows, padded with zeros to whole SIMD vectors."""
    K = coefficients.shape[-1]
    out = np.zeros((*coefficients.shape[:-1], K + -K % WIDTH))
    out[..., :K] = coefficients
    return _rows(out)


def _rows(array: Float) -> Float:
    """View of an array (..., n) as a two-dimensional array of rows."""
    return array.reshape(-1, array.shape[-1])
