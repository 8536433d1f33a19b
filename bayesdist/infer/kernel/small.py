"""Operations on many small covariances, those of the exposures of a series, for several chains.

C is the number of chains, k the number of coefficients, E the number of exposures.  The innermost
loops run over the exposures and are thus vectorised for any k; the data of a chain fit the cache.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from bayesdist.infer.kernel.blocks import PASS
from bayesdist.infer.kernel.lanes import FAST
from bayesdist.infer.kernel.numeric import exp_negative, whole_vectors
from bayesdist.utils.arrays import Float

# options of functions with vectorised sums.  Their loops either add or write arrays: before a loop
# that does both, compiled code compares the places of the arrays in memory, and adds in another
# order where these are near each other
SUMS = PASS | {"fastmath": FAST | {"reassoc"}}


@nb.njit(cache=True, forceinline=True)
def cholesky(A, q):
    """Replace A (q, q) by its lower Cholesky factor; return False if it is not positive."""
    whole_vectors()
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


@nb.njit(cache=True)
def _factor(formal, sigma, L):
    """Write to L the lower Cholesky factors (k, k, E) of formal + sigma, with inverse diagonals."""
    whole_vectors()
    k, _, n = formal.shape
    for j in range(k):
        for i in range(j, k):
            row, formal_row, added = L[i, j], formal[i, j], sigma[i, j]
            for e in range(n):
                row[e] = formal_row[e] + added
            for m in range(j):
                a, b = L[i, m], L[j, m]
                for e in range(n):
                    row[e] -= a[e] * b[e]
            if i == j:
                for e in range(n):
                    row[e] = 1.0 / math.sqrt(row[e])
            else:
                d = L[j, j]
                for e in range(n):
                    row[e] *= d[e]


@nb.njit(**PASS)
def _precisions(formal, sigma, precision):
    whole_vectors()
    k, _, n = formal.shape
    L, W = np.empty((k, k, n)), np.empty((k, k, n))
    for c in range(len(sigma)):
        _factor(formal, sigma[c], L)
        for j in range(k):
            for i in range(j, k):
                row, d = W[i, j], L[i, i]
                for e in range(n):
                    row[e] = 1.0 if i == j else 0.0
                for m in range(j, i):
                    a, b = L[i, m], W[m, j]
                    for e in range(n):
                        row[e] -= a[e] * b[e]
                for e in range(n):
                    row[e] *= d[e]
        for i in range(k):
            for j in range(i + 1):
                out, mirrored = precision[c, i, j], precision[c, j, i]
                for e in range(n):
                    out[e] = 0.0
                for m in range(i, k):
                    a, b = W[m, i], W[m, j]
                    for e in range(n):
                        out[e] += a[e] * b[e]
                for e in range(n):
                    mirrored[e] = out[e]


def precisions(formal: Float, sigma: Float) -> Float:
    """Inverses of the total covariances of the exposures, formal + sigma.

    Parameters
    ----------
    formal : ndarray, shape (k, k, E)
        Formal covariances.
    sigma : ndarray, shape (C, k, k)
        Intrinsic covariances. The sums must be positive definite.

    Returns
    -------
    ndarray, shape (C, k, k, E)
    """
    out = np.empty((*sigma.shape, formal.shape[-1]))
    _precisions(formal, np.ascontiguousarray(sigma), out)
    return out


@nb.njit(**PASS)
def _densities(formal, sigma, residual, fraction, kappa2, density, distance, odd):
    whole_vectors()
    k, _, n = formal.shape
    L, white, root = np.empty((k, k, n)), np.empty((k, n)), np.empty(n)
    for c in range(len(sigma)):
        _factor(formal, sigma[c], L)
        squares = distance[c]
        for e in range(n):
            squares[e], root[e] = 0.0, 1.0
        for i in range(k):
            row, r, d = white[i], residual[c, i], L[i, i]
            for e in range(n):
                row[e] = r[e]
            for m in range(i):
                a, b = L[i, m], white[m]
                for e in range(n):
                    row[e] -= a[e] * b[e]
            for e in range(n):
                row[e] *= d[e]
                squares[e] += row[e] * row[e]
                root[e] *= d[e]
        f, narrow = fraction[c], 1.0 / kappa2[c]
        bad = f * narrow ** (0.5 * k)
        constant = -0.5 * k * math.log(2.0 * math.pi)
        for e in range(n):
            s = squares[e]
            if bad > 0.0:
                total = bad + (1.0 - f) * exp_negative(-0.5 * s * (1.0 - narrow))
                density[c, e] = constant + math.log(total * root[e]) - 0.5 * s * narrow
                odd[c, e] = bad / total
            else:
                density[c, e] = constant + math.log(root[e]) - 0.5 * s
                odd[c, e] = 0.0


def densities(
    formal: Float, sigma: Float, residual: Float, fraction: Float, kappa2: Float
) -> tuple[Float, Float, Float]:
    """Log densities and outlier probabilities of the exposures.

    Parameters
    ----------
    formal : ndarray, shape (k, k, E)
        Formal covariances.
    sigma : ndarray, shape (C, k, k)
        Intrinsic covariances. The covariance of a normal exposure is `formal` + `sigma`.
    residual : ndarray, shape (C, k, E)
        Coefficients of the exposures minus the trend.
    fraction : ndarray, shape (C,)
        Fraction of outlying exposures.
    kappa2 : ndarray, shape (C,)
        Factor on the covariance of outlying exposures.

    Returns
    -------
    density : ndarray, shape (C, E)
        Log densities.
    distance : ndarray, shape (C, E)
        Squared Mahalanobis distances.
    probability : ndarray, shape (C, E)
        Outlier probabilities.
    """
    out = np.empty((3, len(sigma), formal.shape[-1]))
    density, distance, probability = out
    sigma, residual = np.ascontiguousarray(sigma), np.ascontiguousarray(residual)
    _densities(formal, sigma, residual, fraction, kappa2, density, distance, probability)
    return density, distance, probability


@nb.njit(**PASS)
def _deviations(sigma, root, precision, residual, noise, deviation):
    whole_vectors()
    n_chains, k, n = residual.shape
    missed = np.empty((k, n))
    for c in range(n_chains):
        for i in range(k):
            row, r, free = missed[i], residual[c, i], deviation[c, i]
            for e in range(n):
                row[e] = r[e] - free[e]
            for j in range(k):
                a, b = root[i, j], noise[c, j]
                for e in range(n):
                    row[e] -= a[e] * b[e]
        for j in range(k):
            pull = noise[c, j]
            for e in range(n):
                pull[e] = 0.0
            for m in range(k):
                a, b = precision[c, j, m], missed[m]
                for e in range(n):
                    pull[e] += a[e] * b[e]
        for i in range(k):
            row = deviation[c, i]
            for j in range(k):
                s, pull = sigma[c, i, j], noise[c, j]
                for e in range(n):
                    row[e] += s * pull[e]


def draw_deviations(
    sigma: Float, root: Float, precision: Float, residual: Float, rng: np.random.Generator
) -> Float:
    """Draw the intrinsic part of residuals.

    Uses Matheron's rule: a draw from the prior, corrected with the difference between the residual
    and a simulated residual.

    Parameters
    ----------
    sigma : ndarray, shape (C, k, k)
        Intrinsic covariances.
    root : ndarray, shape (k, k, E)
        Cholesky factors of the formal covariances.
    precision : ndarray, shape (C, k, k, E)
        Result of `precisions`.
    residual : ndarray, shape (C, k, E)
        Coefficients of the exposures minus the trend.
    rng : numpy.random.Generator

    Returns
    -------
    ndarray, shape (C, k, E)
    """
    sigma = np.ascontiguousarray(sigma)
    out = np.linalg.cholesky(sigma) @ rng.standard_normal(residual.shape)
    _deviations(sigma, root, precision, residual, rng.standard_normal(residual.shape), out)
    return out


@nb.njit(**SUMS)
def _gaussian(matrix, x, noise):
    """Replace x by a draw y from exp(x'y - y' matrix y / 2); return the log of its integral.

    The integral over y is up to a constant, and NaN if the matrix is not positive definite.
    """
    whole_vectors()
    k, value = len(x), 0.0
    if not cholesky(matrix, k):
        return math.nan
    for i in range(k):
        total = x[i]
        for j in range(i):
            total -= matrix[i, j] * x[j]
        x[i] = total / matrix[i, i]
        value += 0.5 * x[i] ** 2 - math.log(matrix[i, i])
    for i in range(k - 1, -1, -1):
        total = x[i] + noise[i]
        for j in range(i + 1, k):
            total -= matrix[j, i] * x[j]
        x[i] = total / matrix[i, i]
    return value


@nb.njit(**PASS)
def _gaussians(matrix, x, noise, value):
    whole_vectors()
    for c in range(len(x)):
        value[c] = _gaussian(matrix[c], x[c], noise[c])


def gaussians(matrix: Float, right: Float, noise: Float) -> tuple[Float, Float]:
    """Draws y from densities exp(right'y - y' matrix y / 2), and logs of their integrals.

    Parameters
    ----------
    matrix : ndarray, shape (C, q, q)
        Precision matrices.
    right : ndarray, shape (C, q)
        Precision times mean.
    noise : ndarray, shape (C, q)
        Standard normal random numbers.

    Returns
    -------
    draws : ndarray, shape (C, q)
    value : ndarray, shape (C,)
        Log integrals, up to a constant; NaN if a matrix is not positive definite.
    """
    draws, value = right.copy(), np.empty(len(right))
    _gaussians(matrix.copy(), draws, noise, value)
    return draws, value


@nb.njit(**SUMS)
def _pull(weight, r, u, out):
    """Multiply a row of the formal precision, `weight` (k, E), by residuals minus deviations."""
    whole_vectors()
    k, n = r.shape
    for e in range(n):
        out[e] = 0.0
    for j in range(k):
        a, z, v = weight[j], r[j], u[j]
        for e in range(n):
            out[e] += a[e] * (z[e] - v[e])


@nb.njit(**SUMS)
def _share(i, u, r, inverse, P, D, seen, noise, matrix, pull, part):
    """Add multiples of the other coefficients' deviations to those of coefficient i.

    For fixed D the log density is quadratic in these multiples: u becomes Lambda u, and the
    precision P of the covariance becomes Lambda^-T P Lambda^-1.  The prior weights the diagonal of
    P with D^2.
    """
    whole_vectors()
    k, n = u.shape
    x, row, target, a = np.empty(k), P[i].copy(), u[i], inverse[i, i]
    _pull(inverse[i], r, u, pull)
    for j in range(k):
        v, total = u[j], 0.0
        for e in range(n):
            part[e] = seen[e] * v[e]
        for e in range(n):
            total += part[e] * pull[e]
        x[j] = total + D[j] ** 2 * row[j]
        for m in range(j + 1):
            v, total = u[m], 0.0
            for e in range(n):
                total += part[e] * a[e] * v[e]
            matrix[j, m] = total
        matrix[j, j] += D[j] ** 2 * row[i]
    for j in range(k):  # no multiple of coefficient i itself
        matrix[max(i, j), min(i, j)] = 1.0 if i == j else 0.0
    if math.isnan(_gaussian(matrix, x, noise)):
        return
    x[i] = 0.0
    for j in range(k):
        v = u[j]
        for e in range(n):
            target[e] += x[j] * v[e]
        for m in range(k):
            P[j, m] += row[i] * x[j] * x[m] - x[j] * row[m] - row[j] * x[m]


@nb.njit(**SUMS)
def _stretch(i, u, r, inverse, P, D, seen, dof, normal, luck, pull, part):
    """Scale by s the part of the deviations of coefficient i that is independent of the others.

    s is proposed from its likelihood given the residuals.  Its prior density, including that of the
    covariance and the measure of the group of scalings, is s^-(dof + k) exp(-tail / s^2).
    """
    whole_vectors()
    k, n = u.shape
    row, target, a = P[i].copy(), u[i], inverse[i, i]
    _pull(inverse[i], r, u, pull)
    for e in range(n):
        part[e] = 0.0
    tail = 0.0
    for j in range(k):
        v, share = u[j], row[j] / row[i]
        tail += 0.5 * (D[j] * row[j]) ** 2 / row[i]
        for e in range(n):
            part[e] += share * v[e]
    size = total = 0.0
    for e in range(n):
        size += seen[e] * a[e] * part[e] ** 2
        total += seen[e] * pull[e] * part[e]
    if not size > 0.0:
        return
    s = 1.0 + total / size + normal / math.sqrt(size)
    if luck < tail * (1.0 - 1.0 / s**2) - (dof + k) * math.log(abs(s)):
        for e in range(n):
            target[e] += (s - 1.0) * part[e]
        for j in range(k):
            for m in range(k):
                P[j, m] += (1.0 / s**2 - 1.0) * row[j] * row[m] / row[i]


@nb.njit(**SUMS)
def _rescale(u, r, inverse, D, seen, variance, noise, matrix, pull, part):
    """Draw the scales D from their Gaussian density, with the deviations proportional to them."""
    whole_vectors()
    k, n = u.shape
    x = np.empty(k)
    for j in range(k):
        v = u[j]
        for e in range(n):
            v[e] /= D[j]
    for j in range(k):
        v, total = u[j], 0.0
        for e in range(n):
            part[e] = seen[e] * v[e]
            pull[e] = 0.0
        for m in range(k):
            a, z, w = inverse[j, m], r[m], u[m]
            product = 0.0
            for e in range(n):
                pull[e] += a[e] * z[e]
            for e in range(n):
                product += part[e] * a[e] * w[e]
            matrix[j, m] = product
        for e in range(n):
            total += part[e] * pull[e]
        x[j] = total
        matrix[j, j] += 1.0 / variance
    moved = not math.isnan(_gaussian(matrix, x, noise))
    for j in range(k):
        v = u[j]
        if moved:
            D[j] = x[j]
        for e in range(n):
            v[e] *= D[j]


@nb.njit(**PASS)
def _shear(deviation, residual, inverse, precision, scale, prior, included, noise, luck):
    whole_vectors()
    n_chains, k, n = deviation.shape
    variance, dof = prior
    matrix, pull, part = np.empty((k, k)), np.empty(n), np.empty(n)
    for c in range(n_chains):
        u, r, P, D, seen = deviation[c], residual[c], precision[c], scale[c], included[c]
        for i in range(k):
            normal, chance = noise[c, i], luck[c, i]
            _share(i, u, r, inverse, P, D, seen, normal, matrix, pull, part)
            _stretch(i, u, r, inverse, P, D, seen, dof, normal[i], chance, pull, part)
        _rescale(u, r, inverse, D, seen, variance, noise[c, k], matrix, pull, part)


def shear(
    deviation: Float,
    residual: Float,
    inverse: Float,
    sigma: Float,
    scale: Float,
    prior: tuple[float, float],
    included: Float,
    rng: np.random.Generator,
) -> tuple[Float, Float]:
    """Move the deviations jointly with their covariance; return new deviations and scales.

    Parameters
    ----------
    deviation : ndarray, shape (C, k, E)
        Intrinsic deviations of the exposures.
    residual : ndarray, shape (C, k, E)
        Coefficients of the exposures minus the trend.
    inverse : ndarray, shape (k, k, E)
        Formal precision of the residuals.
    sigma : ndarray, shape (C, k, k)
        Intrinsic covariance. Its prior is inverse Wishart with scale matrix diag(scale^2).
    scale : ndarray, shape (C, k)
        Scales, with a normal prior.
    prior : tuple of float
        Prior variance of the scales, and degrees of freedom of the inverse Wishart.
    included : ndarray, shape (C, E)
        1 for exposures that are used, otherwise 0.
    rng : numpy.random.Generator

    Returns
    -------
    deviation : ndarray, shape (C, k, E)
    scale : ndarray, shape (C, k)

    Notes
    -----
    For each coefficient in turn, a multiple of the other coefficients' deviations is added, and the
    part that is independent of them is scaled.  Then all scales are drawn.  Each move is drawn, or
    accepted, according to the residuals.  The covariance can therefore move as far as the residuals
    allow.  Updates that keep the deviations fixed move little if formal errors are large.
    """
    n_chains, k, _ = deviation.shape
    out, scale = deviation.copy(), scale.copy()
    precision = np.linalg.inv(sigma)
    noise = rng.standard_normal((n_chains, k + 1, k))
    luck = -rng.standard_exponential((n_chains, k))
    _shear(out, residual, inverse, precision, scale, prior, included, noise, luck)
    return out, scale
