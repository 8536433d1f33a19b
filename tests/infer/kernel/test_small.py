"""Passes over small covariances against LAPACK and scipy, one by one."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from scipy import stats

from bayesdist.infer.kernel import densities, draw_deviations, gaussians, precisions
from bayesdist.infer.kernel.small import _rescale, _share, _stretch

N_CHAINS, N_EXPOSURES = 3, 6


def covariances(k: int, n: int, rng: np.random.Generator) -> np.ndarray:
    raw = rng.standard_normal((n, k, k + 2))
    return raw @ np.swapaxes(raw, 1, 2)


def batch_last(matrices: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(matrices, 0, -1))


@pytest.mark.parametrize("k", [1, 2, 4, 7])
def test_precisions_are_inverses(k, rng):
    formal, sigma = covariances(k, N_EXPOSURES, rng), covariances(k, N_CHAINS, rng)
    got = np.moveaxis(precisions(batch_last(formal), sigma), -1, 1)
    np.testing.assert_allclose(got, np.linalg.inv(sigma[:, None] + formal), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("fraction", [0.0, 0.2])
def test_density_is_a_mixture_of_two_gaussians(k, fraction, rng):
    formal, sigma = covariances(k, N_EXPOSURES, rng), covariances(k, N_CHAINS, rng)
    residual = 4 * rng.standard_normal((N_CHAINS, k, N_EXPOSURES))
    f, kappa2 = np.full(N_CHAINS, fraction), rng.uniform(9, 50, N_CHAINS)
    density, distance, probability = densities(batch_last(formal), sigma, residual, f, kappa2)
    for c in range(N_CHAINS):
        for e in range(N_EXPOSURES):
            cov, at = formal[e] + sigma[c], residual[c, :, e]
            parts = [stats.multivariate_normal(None, w * cov).pdf(at) for w in (1.0, kappa2[c])]
            expected = np.log((1 - fraction) * parts[0] + fraction * parts[1])
            assert density[c, e] == pytest.approx(expected, rel=1e-10)
            assert probability[c, e] == pytest.approx(fraction * parts[1] / np.exp(expected))
            assert distance[c, e] == pytest.approx(at @ np.linalg.solve(cov, at), rel=1e-9)


def test_far_exposures_have_a_density():
    """The wide part alone, where exp of the narrow one's exponent is zero."""
    one = np.ones(1)
    got, _, probability = densities(
        np.ones((1, 1, 1)), np.ones((1, 1, 1)), one[:, None, None] * 400, 0.1 * one, 25 * one
    )
    assert got[0, 0] == pytest.approx(np.log(0.1) + stats.norm(scale=np.sqrt(50)).logpdf(400))
    assert probability[0, 0] == 1


def test_deviations_are_those_of_two_gaussians(rng):
    """Mean and covariance of one exposure's deviation given its residual, by the book."""
    n, k = 40_000, 2
    formal, sigma = covariances(k, 1, rng)[0], covariances(k, 1, rng)[0]
    residual = np.array([1.5, -2.0])
    many = np.tile(sigma, (n, 1, 1))
    root = np.linalg.cholesky(formal)[..., None]
    precision = precisions(formal[..., None], many)
    draws = draw_deviations(many, root, precision, np.tile(residual[:, None], (n, 1, 1)), rng)
    gain = sigma @ np.linalg.inv(sigma + formal)
    white = np.linalg.solve(
        np.linalg.cholesky(sigma - gain @ sigma), (draws[..., 0] - gain @ residual).T
    )
    assert np.abs(white.mean(axis=1)).max() < 4.5 / np.sqrt(n)
    np.testing.assert_allclose(np.cov(white), np.eye(k), atol=4.5 * np.sqrt(2 / n))


def test_gaussians_are_drawn_and_integrated(rng):
    """Mean and covariance of the draws, and the integral by completing the square."""
    n, q = 40_000, 3
    matrix, right = covariances(q, 1, rng)[0], rng.standard_normal(q)
    many = np.tile(matrix, (n, 1, 1))
    draws, value = gaussians(many, np.tile(right, (n, 1)), rng.standard_normal((n, q)))
    mean = np.linalg.solve(matrix, right)
    white = np.linalg.cholesky(matrix).T @ (draws - mean).T
    assert np.abs(white.mean(axis=1)).max() < 4.5 / np.sqrt(n)
    np.testing.assert_allclose(np.cov(white), np.eye(q), atol=4.5 * np.sqrt(2 / n))
    expected = 0.5 * right @ mean - 0.5 * np.linalg.slogdet(matrix)[1]
    np.testing.assert_allclose(value, expected, rtol=1e-9)


@pytest.mark.parametrize("n", [5, 12, 40])
def test_moves_of_the_deviations_do_not_depend_on_where_the_arrays_are(n, rng):
    """Vector code is left where arrays are near each other in memory, and adds in another order."""
    k, results = 4, set()
    values = [rng.standard_normal(shape) for shape in ((k, n), (k, n), (n,), (n,))]
    formal, noise = batch_last(covariances(k, n, rng)), rng.standard_normal((k + 1, k))
    luck, seen = -rng.standard_exponential(k), np.ones(n)
    precision, scale = covariances(k, 1, rng)[0], rng.uniform(1, 2, k)
    for order in permutations(range(4)):
        for gap in range(0, 20, 3):
            pool, at, placed = np.zeros(sum(v.size for v in values) + 4 * gap), 0, {}
            for j in order:
                placed[j] = pool[at : at + values[j].size].reshape(values[j].shape)
                placed[j][...] = values[j]
                at += values[j].size + gap
            u, r, pull, part = (placed[j] for j in range(4))
            P, D, matrix = precision.copy(), scale.copy(), np.empty((k, k))
            for i in range(k):
                _share(i, u, r, formal, P, D, seen, noise[i], matrix, pull, part)
                _stretch(i, u, r, formal, P, D, seen, 5.0, noise[i, i], luck[i], pull, part)
            _rescale(u, r, formal, D, seen, 2.0, noise[k], matrix, pull, part)
            results.add((u.tobytes(), P.tobytes(), D.tobytes()))
    assert len(results) == 1
