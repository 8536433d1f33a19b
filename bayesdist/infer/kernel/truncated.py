"""Passes for stars that are matched only within a circle about a nominal position.

    p(r | matched) = (1 - f) N(r) / Z + f p_out(r) / Z_out

Z and Z_out are the probabilities that a true match and an outlier fall within the circle.  They
depend on the model's position, on the jitter and on the scale of the outliers.  f is the fraction
of false matches within the circle.  Uniform outliers fill the circle: Z_out is 1.

These passes are separate from those without a circle, because they need an integral per star and
are much slower.

Z is computed for a Gaussian with variances A, B that is centred on the origin, and a circle of
radius R about d.  Points on the circle are (x, y) = d + R (cos t, sin t), and
q = (x^2/A + y^2/B) / 2.  By the divergence theorem, applied to the radial field with the Gaussian
as its divergence, the integral over the disc becomes an integral over the circle,

    Z = R / (4 pi sqrt(A B))  integral of E(q) (R + d_u cos t + d_v sin t) dt,
    E(q) = (1 - e^-q) / q.

Derivatives with respect to d are integrals of the Gaussian and its derivatives over the circle.
Those with respect to the variances follow from dZ/dA = (1/2) d^2Z/dd_u^2.  The integrands are
periodic and entire, so that the trapezoidal rule converges faster than any power: about thirty
nodes are enough for a circle of four sigma.

If the origin is outside the circle, the two terms of E cancel up to an exponentially small
remainder.  In that case the term 1/q, which integrates to zero, is omitted, and the largest e^-q
is factored out of the sum.
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

from bayesdist.infer.kernel.blocks import (
    BLOCK,
    PASS,
    lay_out,
    modelled,
    off_axes,
    share_out,
    star_room,
    threads_for,
)
from bayesdist.infer.kernel.lanes import FAST
from bayesdist.infer.kernel.mixture import GAUSSIAN, Constants, packed
from bayesdist.infer.kernel.moments import (
    COLUMNS,
    N_MIXTURE,
    Moments,
    _by_group,
    add_columns,
    empty_sums,
    mixture_sums,
    room_for,
    write_columns,
)
from bayesdist.infer.kernel.numeric import exp_negative, legendre, whole_vectors
from bayesdist.utils.arrays import Float, Int

SCRATCH = 16_000_000  # bytes of partial sums in memory at a time
INTEGRAL = 30  # cost per star, relative to a likelihood evaluation without a circle
N_TERMS = COLUMNS + N_MIXTURE  # number of terms (columns and scalars) per star


# In the loops, `stars` are `Stars.columns` and `Stars.offsets`.  `circle` is a tuple
# of True for Gaussian outliers, the radius, and the `NODES` of the integral.
@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _residual(stars, i, model, s, j2):
    """Residual of a star, nominal minus model position, and its variances (all in u and v)."""
    whole_vectors()
    ru, rv = stars[2][i] - model[0, s], stars[3][i] - model[1, s]
    return ru, rv, ru + stars[8][i], rv + stars[9][i], stars[4][i] + j2, stars[5][i] + j2


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _parts(star, row, circle, q, work):
    """Densities of core and outliers, in the unit of `mixture`, without a common exponential.

    The third value is the exponent (half a chi-square) that was factored out.
    """
    whole_vectors()
    ru, rv, du, dv, au, av = star
    gaussian, radius, nodes = circle[0], circle[1], circle[2:]
    q_in = 0.5 * (ru * ru / au + rv * rv / av)
    q_in += log_circle(du, dv, au, av, radius, nodes, q, work)
    q_out = (ru * ru + rv * rv) * row[3] + row[4]
    if gaussian:
        out = 1.0 / row[6]
        q_out += log_circle(du, dv, out, out, radius, nodes, q, work)
    t = exp_negative(-abs(q_in - q_out))
    is_core = q_in <= q_out
    peak = row[1] / math.sqrt(au * av)
    return (
        peak if is_core else peak * t,
        row[2] * t if is_core else row[2],
        q_in if is_core else q_out,
    )


@nb.njit(**PASS)
def _evaluated(
    first, end, places, model, blocks, stars, coef, order, rows, unit2, circle, sums, out
):
    """Write the log-likelihood (n, D) of each block to `sums`.

    If `out` (D / each, 3, N) is not empty, averages per star are written to it; see `memberships`.
    """
    whole_vectors()
    n_draws, wanted = len(rows), len(out) > 0
    each = n_draws // len(out) if wanted else 1
    share, constant = 1.0 / each, math.log(2 * math.pi * unit2)
    for b in range(first, end):
        g, a, e = blocks[b]
        q, work = np.empty(MOST), np.empty(MOST)
        lay_out(stars, a, e, places)
        if wanted:
            out[:, :, a:e] = 0.0
        for d in range(n_draws):
            modelled(stars, coef[d, g], order, places, e - a, model)
            total = 0.0
            for i in range(a, e):
                star = _residual(stars, i, model, i - a, rows[d, 0])
                d_in, d_out, q_min = _parts(star, rows[d], circle, q, work)
                value = math.log(d_in + d_out) - q_min
                total += value
                if wanted:
                    mean = out[d // each]
                    mean[0, i] += share * d_out / (d_in + d_out)
                    mean[1, i] += share * (value - constant)
                    mean[2, i] += share * (value - constant) * (value - constant)
            sums[b, d] = total - (e - a) * constant


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _terms(star, row, circle, wavering, q, work, zc, zo, out):
    """Write the terms of one star to out (N_TERMS,): columns and scalars of `mixture_moments`.

    `wavering` is 1, or 0 for fixed memberships (EM).
    """
    whole_vectors()
    ru, rv, du, dv, au, av = star
    gaussian, radius, nodes = circle[0], circle[1], circle[2:]
    j2, f, w = row[0], row[5], row[6]
    slopes(du, dv, au, av, radius, nodes, q, work, zc)
    iu, iv = 1.0 / au, 1.0 / av
    eu, ev, r2 = ru * ru * iu, rv * rv * iv, ru * ru + rv * rv
    q_in, q_out = 0.5 * (eu + ev) + zc[0], r2 * row[3] + row[4]
    # first and second derivatives of the logarithms of both densities with respect to the residual,
    # log j and log s_out
    k = 2.0 * j2
    in_u, in_v = -ru * iu - zc[1], -rv * iv - zc[2]
    in_uu, in_uv, in_vv = -iu - zc[3], -zc[4], -iv - zc[5]
    in_j = j2 * ((eu - 1.0) * iu + (ev - 1.0) * iv) - k * zc[6]
    in_ju, in_jv = k * (ru * iu * iu - zc[7]), k * (rv * iv * iv - zc[8])
    in_jj = 2.0 * in_j + k * k * (
        0.5 * ((1.0 - 2.0 * eu) * iu * iu + (1.0 - 2.0 * ev) * iv * iv) - zc[9]
    )
    out_u = out_v = out_uu = out_uv = out_vv = out_s = out_su = out_sv = out_ss = 0.0
    if gaussian:
        s2 = 1.0 / w
        slopes(du, dv, s2, s2, radius, nodes, q, work, zo)
        q_out += zo[0]
        out_u, out_v = -ru * w - zo[1], -rv * w - zo[2]
        out_uu, out_uv, out_vv = -w - zo[3], -zo[4], -w - zo[5]
        k = 2.0 * s2
        out_s = r2 * w - 2.0 - k * zo[6]
        out_su, out_sv = 2.0 * ru * w - k * zo[7], 2.0 * rv * w - k * zo[8]
        out_ss = -2.0 * r2 * w - 2.0 * k * zo[6] - k * k * zo[9]
    t = exp_negative(-abs(q_in - q_out))
    is_core = q_in <= q_out
    peak = row[1] * math.sqrt(iu * iv)
    d_in = peak if is_core else peak * t
    d_out = row[2] * t if is_core else row[2]
    inverse_sum = 1.0 / (d_in + d_out)
    p, m = d_out * inverse_sum, d_in * inverse_sum
    D_u, D_v = in_u - out_u, in_v - out_v
    pq = p * m * wavering
    out[0] = -(m * in_uu + p * out_uu) - pq * D_u * D_u
    out[1] = -(m * in_uv + p * out_uv) - pq * D_u * D_v
    out[2] = -(m * in_vv + p * out_vv) - pq * D_v * D_v
    out[3] = -(m * in_u + p * out_u)
    out[4] = -(m * in_v + p * out_v)
    out[5] = m * in_ju + pq * in_j * D_u
    out[6] = m * in_jv + pq * in_j * D_v
    out[7] = -pq * D_u
    out[8] = -pq * D_v
    out[9] = p * out_su - pq * out_s * D_u
    out[10] = p * out_sv - pq * out_s * D_v
    pq = p * m
    out[11] = 0.0
    out[12] = math.log(d_in + d_out) - (q_in if is_core else q_out)
    out[13], out[14], out[15] = m * in_j, p, p * out_s
    out[16] = -m * in_jj - pq * in_j * in_j
    out[17], out[18] = pq * in_j, pq * in_j * out_s
    out[19], out[20] = f * (1.0 - f) - pq, -pq * out_s
    out[21] = -p * out_ss - pq * out_s * out_s


@nb.njit(**PASS)
def _moments(
    start, stop, places, model, _, weighted, P, Q, lanes,
    pieces, stars, coef, order, row, unit2, circle, em, sums, scalars,
):  # fmt: skip
    whole_vectors()
    q, work, zc, zo = np.empty(MOST), np.empty(MOST), np.empty(10), np.empty(10)
    terms = np.empty(N_TERMS)
    wavering, log_unit = 0.0 if em else 1.0, math.log(2 * math.pi * unit2)
    for b in range(start, stop):
        g, first, end = pieces[b]
        for a in range(first, end, BLOCK):
            e = min(a + BLOCK, end)
            n = e - a
            lay_out(stars, a, e, places)
            modelled(stars, coef[g], order, places, n, model)
            legendre(places, n, 2 * order, P, Q)
            weighted[:] = 0.0
            for s in range(n):
                star = _residual(stars, a + s, model, s, row[0])
                _terms(star, row, circle, wavering, q, work, zc, zo, terms)
                for k in range(len(weighted)):
                    weighted[k, s] = terms[k]
                for k in range(N_MIXTURE):
                    scalars[b, k] += terms[COLUMNS + k]
            scalars[b, 0] -= n * log_unit
            off_axes(stars, places, n, weighted, 1 if em else 4)
            add_columns(weighted, n, P, Q, lanes)
        write_columns(lanes, sums[b])


@nb.njit(**PASS)
def _scores(first, end, places, model, blocks, stars, coef, order, row, circle, out):
    whole_vectors()
    for b in range(first, end):
        g, a, e = blocks[b]
        q, work, zc, zo = np.empty(MOST), np.empty(MOST), np.empty(10), np.empty(10)
        terms = np.empty(N_TERMS)
        lay_out(stars, a, e, places)
        modelled(stars, coef[g], order, places, e - a, model)
        for i in range(a, e):
            star = _residual(stars, i, model, i - a, row[0])
            _terms(star, row, circle, 1.0, q, work, zc, zo, terms)
            out[0, i], out[1, i] = terms[3], terms[4]
            for k in range(3):
                out[2 + k, i] = terms[k]


def _circle(constants: Constants) -> tuple[Any, ...]:
    return constants.kind == GAUSSIAN, constants.radius, *NODES


def truncated_log_likelihood(
    blocks: Int,
    columns: tuple[Float, ...],
    offsets: tuple[Float, ...],
    coef: Float,
    order: int,
    constants: Constants,
) -> Float:
    """Log-likelihood of all stars for D parameter vectors, with match circles.

    Parameters
    ----------
    blocks, columns, coef, order
        See `log_likelihood`.
    offsets : tuple of ndarray, shape (N,)
        Nominal positions minus the data, in u and in v.
    constants : Constants
        Constants of the mixture, including the radius of the circle.

    Returns
    -------
    ndarray, shape (D,)
    """
    rows, coef = packed(constants), np.ascontiguousarray(coef)
    stars, circle, nothing = (*columns, *offsets), _circle(constants), np.empty((0, 3, 0))
    out = np.empty(len(coef))
    step = max(1, SCRATCH // (8 * max(len(blocks), 1)))
    with threads_for(INTEGRAL * len(columns[0]) * len(coef)):
        for a in range(0, len(coef), step):
            draws = slice(a, a + step)
            sums = np.empty((len(blocks), len(rows[draws])))
            share_out(
                _evaluated,
                len(blocks),
                blocks,
                stars,
                coef[draws],
                order,
                rows[draws],
                constants.unit2,
                circle,
                sums,
                nothing,
                room=star_room,
            )
            # order of summation as in `log_likelihood`
            out[draws] = np.ascontiguousarray(sums.T).sum(axis=1)
    return out


def truncated_memberships(
    blocks: Int,
    columns: tuple[Float, ...],
    offsets: tuple[Float, ...],
    coef: Float,
    order: int,
    constants: Constants,
    each: int,
) -> Float:
    """Outlier probability, log-likelihood and its square for each star, with match circles.

    Parameters
    ----------
    blocks, columns, coef, order, constants, each
        See `memberships`.
    offsets : tuple of ndarray, shape (N,)
        Nominal positions minus the data, in u and in v.

    Returns
    -------
    ndarray, shape (D / each, 3, N)
    """
    out = np.empty((len(coef) // each, 3, len(columns[0])))
    with threads_for(INTEGRAL * out.shape[2] * len(coef)):
        share_out(
            _evaluated,
            len(blocks),
            blocks,
            (*columns, *offsets),
            np.ascontiguousarray(coef),
            order,
            packed(constants),
            constants.unit2,
            _circle(constants),
            np.empty((len(blocks), len(coef))),
            out,
            room=star_room,
        )
    return out


def truncated_moments(
    pieces: Int,
    columns: tuple[Float, ...],
    offsets: tuple[Float, ...],
    coef: Float,
    order: int,
    constants: Constants,
    *,
    em: bool = False,
) -> Moments:
    """Sums for the gradient and Hessian of the mixture log-likelihood, with match circles.

    Parameters
    ----------
    pieces, columns, coef, order, constants
        See `mixture_moments`.
    offsets : tuple of ndarray, shape (N,)
        Nominal positions minus the data, in u and in v.
    em : bool
        True for the curvature for fixed memberships instead of the Hessian. It is the covariance of
        a truncated Gaussian times two inverse variances, and never negative; `cross` is zero.

    Returns
    -------
    Moments
        Its `scalars` are those of `mixture_moments`.
    """
    sums, scalars = empty_sums(len(pieces), order, COLUMNS, N_MIXTURE)
    with threads_for(INTEGRAL * len(columns[0])):
        share_out(
            _moments,
            len(pieces),
            pieces,
            (*columns, *offsets),
            np.ascontiguousarray(coef),
            order,
            packed(constants)[0],
            constants.unit2,
            _circle(constants),
            em,
            sums,
            scalars,
            room=lambda: room_for(order, 6 if em else COLUMNS),
        )
    return mixture_sums(_by_group(sums, pieces), scalars.sum(axis=0), order, em)


def truncated_scores(
    blocks: Int,
    columns: tuple[Float, ...],
    offsets: tuple[Float, ...],
    coef: Float,
    order: int,
    constants: Constants,
) -> Float:
    """Derivatives of each star's log-likelihood along the principal axes of its errors.

    Parameters
    ----------
    blocks, columns, order
        See `residuals`.
    offsets : tuple of ndarray, shape (N,)
        Nominal positions minus the data, in u and in v.
    coef : ndarray, shape (G, 2, K)
        Effective coefficients of the scaled powers.
    constants : Constants
        Constants of the mixture for one parameter vector.

    Returns
    -------
    ndarray, shape (5, N)
        First derivatives with respect to the model position along both axes, and minus the second
        derivatives 11, 12, 22.
    """
    out = np.empty((5, len(columns[0])))
    with threads_for(INTEGRAL * out.shape[1]):
        share_out(
            _scores,
            len(blocks),
            blocks,
            (*columns, *offsets),
            np.ascontiguousarray(coef),
            order,
            packed(constants)[0],
            _circle(constants),
            out,
            room=star_room,
        )
    return out


SURE = 8.6**2  # squared distance from the edge in sigma at which the probability is 1 in float64
# smallest resolved variance over R^2; smaller variances are replaced by it, which affects only
# stars within a few such errors of the edge
STEEP = 512.0**-2
CANCELLED = 1e3  # sum of absolute values over the sum, above which the term 1/q is omitted
EDGE = 0.02  # for smaller q, E is computed from its series

COUNTS = (
    *(12, 16, 20, 24, 28, 32, 36, 40, 44, 48, 56, 64, 72, 80, 96, 112, 128, 160, 192, 224),
    *(256, 320, 384, 448, 512, 640, 768, 1024, 1536, 2048, 3072, 4096, 6144, 8192),
)
MOST = COUNTS[-1]


def _table() -> tuple[Int, Int, Float, Float]:
    """Node counts, the index of the first node of each set, and cosines and sines of all nodes."""
    angles = np.concatenate([2 * np.pi * np.arange(n) / n for n in COUNTS])
    begin = np.concatenate([[0], np.cumsum(COUNTS)[:-1]]).astype(np.int64)
    return np.array(COUNTS, np.int64), begin, np.cos(angles), np.sin(angles)


NODES = _table()


# All functions are inlined, for the reason given at `numeric.exp_negative`.
@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def inside(du, dv, A, B, R):
    """True if the probability outside the circle is below the float64 precision.

    The module explains the arguments.
    """
    whole_vectors()
    d2 = du * du + dv * dv
    room = R - math.sqrt(d2)
    return room > 0.0 and room * room > SURE * max(A, B)


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def nodes_for(du, dv, A, B, R, counts):
    """Index of the smallest set of nodes, among `counts`, that resolves the integrand.

    The module explains the other arguments.
    """
    whole_vectors()
    bend = R * math.sqrt(du * du / (A * A) + dv * dv / (B * B)) + R * R * abs(1.0 / A - 1.0 / B)
    wanted = 9.0 + 7.2 * math.sqrt(bend)
    if du * du + dv * dv > R * R:
        wanted *= 1.8
    k = 0
    while k < len(counts) - 1 and counts[k] < wanted:
        k += 1
    return k


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _total(values, n):
    """Sum of the first n values, n a multiple of four."""
    whole_vectors()
    total = 0.0
    for s in range(0, n, 4):
        total += (values[s] + values[s + 1]) + (values[s + 2] + values[s + 3])
    return total


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _flux(e, away):
    """Contribution of a node to the sum: E(e) times the outward component `away`."""
    whole_vectors()
    series = 1.0 - e * (1.0 / 2 - e * (1.0 / 6 - e * (1.0 / 24 - e * (1.0 / 120 - e / 720))))
    safe = max(e, EDGE)
    return away * (series if e < EDGE else (1.0 - exp_negative(-safe)) / safe)


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _log_from_within(du, dv, A, B, R, n, first, cosine, sine, work):
    """Logarithm of the probability if the centre of the Gaussian is inside the circle.

    All terms are positive in this case.
    """
    whole_vectors()
    half_a, half_b = 0.5 / A, 0.5 / B
    for k in range(n):
        c, s = cosine[first + k], sine[first + k]
        x, y = du + R * c, dv + R * s
        work[k] = _flux(x * x * half_a + y * y * half_b, R + du * c + dv * s)
    return math.log(R / (2.0 * n * math.sqrt(A * B)) * _total(work, n))


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _exponents(du, dv, A, B, R, n, first, cosine, sine, q):
    """Write q at the nodes to `q` and return the smallest value."""
    whole_vectors()
    half_a, half_b = 0.5 / A, 0.5 / B
    q_min = math.inf
    for k in range(n):
        x, y = du + R * cosine[first + k], dv + R * sine[first + k]
        q[k] = x * x * half_a + y * y * half_b
    for k in range(n):
        q_min = min(q_min, q[k])
    return q_min


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def _log_from_outside(du, dv, A, B, R, n, first, cosine, sine, q, least, work):
    """Logarithm of the probability if the centre is outside the circle, from q at the nodes."""
    whole_vectors()
    scale = R / (2.0 * n * math.sqrt(A * B))
    for k in range(n):
        work[k] = _flux(q[k], R + du * cosine[first + k] + dv * sine[first + k])
    total = _total(work, n)
    for k in range(n):
        work[k] = abs(work[k])
    if _total(work, n) < CANCELLED * total:
        return math.log(scale * total)
    for k in range(n):
        away = R + du * cosine[first + k] + dv * sine[first + k]
        work[k] = -away * exp_negative(least - q[k]) / q[k]
    return math.log(scale * _total(work, n)) - least


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def log_circle(du, dv, A, B, R, nodes, q, work):
    """Logarithm of the probability mass within the circle about d = (du, dv).

    The module explains A, B and R.  `q` and `work` are scratch arrays of at least `MOST` numbers.
    """
    whole_vectors()
    if inside(du, dv, A, B, R):
        return 0.0
    A, B = max(A, STEEP * R * R), max(B, STEEP * R * R)
    counts, begin, cosine, sine = nodes
    k = nodes_for(du, dv, A, B, R, counts)
    n, first = counts[k], begin[k]
    if du * du + dv * dv <= R * R:
        return _log_from_within(du, dv, A, B, R, n, first, cosine, sine, work)
    q_min = _exponents(du, dv, A, B, R, n, first, cosine, sine, q)
    return _log_from_outside(du, dv, A, B, R, n, first, cosine, sine, q, q_min, work)


@nb.njit(cache=True, forceinline=True, fastmath=FAST)
def slopes(du, dv, A, B, R, nodes, q, work, out):
    """Write `log_circle` and its derivatives to out (10,).

    With t a variance added on both axes, the entries are the logarithm and its derivatives with
    respect to u, v, uu, uv, vv, t, tu, tv, tt.
    """
    whole_vectors()
    for m in range(10):
        out[m] = 0.0
    if inside(du, dv, A, B, R):
        return
    # 0 if the variance is replaced by its lower limit and does not depend on the jitter
    free_a, free_b = 1.0, 1.0
    if A < STEEP * R * R:
        A, free_a = STEEP * R * R, 0.0
    if B < STEEP * R * R:
        B, free_b = STEEP * R * R, 0.0
    counts, begin, cosine, sine = nodes
    k = nodes_for(du, dv, A, B, R, counts)
    n, first = counts[k], begin[k]
    q_min = _exponents(du, dv, A, B, R, n, first, cosine, sine, q)
    if du * du + dv * dv <= R * R:
        log_z = _log_from_within(du, dv, A, B, R, n, first, cosine, sine, work)
    else:
        log_z = _log_from_outside(du, dv, A, B, R, n, first, cosine, sine, q, q_min, work)
    for k in range(n):
        work[k] = exp_negative(q_min - q[k])
    ia, ib = 1.0 / A, 1.0 / B
    u = v = uu = uv = vv = t = tu = tv = tt = 0.0
    for k in range(n):
        c, s, g = cosine[first + k], sine[first + k], work[k]
        x, y = (du + R * c) * ia, (dv + R * s) * ib
        w = 0.5 * (free_a * (x * x - ia) + free_b * (y * y - ib))  # d log(g) / dt
        gc, gs = g * c, g * s
        across = free_a * gc * x + free_b * gs * y
        u += gc
        v += gs
        uu -= gc * x
        uv -= gc * y
        vv -= gs * y
        t -= across
        tu += w * gc
        tv += w * gs
        tt -= w * across - free_a * gc * x * ia - free_b * gs * y * ib
    # derivatives of Z, divided by Z; the factors 1/2 of t and tt were left out of the sums
    scale = R / (n * math.sqrt(A * B)) * math.exp(-q_min - log_z)
    u, v, uu, uv, vv = scale * u, scale * v, scale * uu, scale * uv, scale * vv
    t, tu, tv, tt = 0.5 * scale * t, scale * tu, scale * tv, 0.5 * scale * tt
    out[0], out[1], out[2] = log_z, u, v
    out[3], out[4], out[5] = uu - u * u, uv - u * v, vv - v * v
    out[6], out[7], out[8], out[9] = t, tu - t * u, tv - t * v, tt - t * t
