"""The prior of the scatter against its definition, and moves that must leave it as it is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.infer.kernel import shear
from bayesdist.kinds.campaign.series.sampler import (
    NU,
    PRIOR_SCALE,
    draw_scales,
    draw_scatter,
    scale_prior,
)


def prior_draws(k: int, n: int, rng: np.random.Generator) -> np.ndarray:
    """Covariances (n, k, k) from the hierarchy of Huang and Wand, by scipy."""
    a = 1 / rng.gamma(0.5, PRIOR_SCALE**2, size=(n, k))
    standard = stats.invwishart.rvs(NU + k - 1, np.eye(k), size=n, random_state=rng)
    root = np.sqrt(2 * NU / a)  # B X B' is inverse Wishart, too, with B before and after its matrix
    return root[:, :, None] * standard.reshape(n, k, k) * root[:, None]


def test_hierarchy_is_half_student_t_and_uniform(rng):
    """Marginals of draws of the hierarchy: half-Student-t scatter, uniform correlation."""
    sigma = prior_draws(3, 1500, rng)
    for j in range(3):
        sd = np.sqrt(sigma[:, j, j])
        assert stats.kstest(sd, lambda s: 2 * stats.t(NU, scale=PRIOR_SCALE).cdf(s) - 1)[1] > 1e-3
    correlation = sigma[:, 0, 2] / np.sqrt(sigma[:, 0, 0] * sigma[:, 2, 2])
    assert stats.kstest(correlation, stats.uniform(-1, 2).cdf)[1] > 1e-3


def test_draws_without_exposures_keep_the_prior(rng):
    """The exact draw leaves the prior as it is when there is nothing to learn from."""
    sigma = prior_draws(2, 4000, rng)
    for _ in range(5):
        sigma = draw_scatter(draw_scales(sigma, rng), np.zeros((4000, 2, 2)), np.zeros(4000), rng)
    for j in range(2):
        sd = np.sqrt(sigma[:, j, j])
        assert stats.kstest(sd, lambda s: 2 * stats.t(NU, scale=PRIOR_SCALE).cdf(s) - 1)[1] > 1e-3


@pytest.mark.parametrize("k", [1, 2, 3])
@pytest.mark.parametrize("size", [0.1, 10.0])
def test_shears_keep_the_joint_density(k, size, rng):
    """Truths from the prior, and data from them: sheared with the data in sight, they are the same.

    Covariance, scales and deviations of each truth are a draw of its own posterior, and remain one.
    """
    n, n_exposures = 4000, 6
    sigma = prior_draws(k, n, rng)
    scale = draw_scales(sigma, rng)
    deviation = np.linalg.cholesky(sigma) @ rng.standard_normal((n, k, n_exposures))
    formal = size**2 * (0.7 + np.diag(0.5 + np.arange(k)))
    noise = np.linalg.cholesky(formal) @ rng.standard_normal((n, k, n_exposures))
    inverse = np.repeat(np.linalg.inv(formal)[..., None], n_exposures, axis=2)
    included = np.ones((n, n_exposures))
    data = deviation + noise
    for _ in range(5):
        deviation, scale = shear(
            deviation, data, inverse, sigma, scale, scale_prior(k), included, rng
        )
        scatter = deviation @ np.swapaxes(deviation, 1, 2)
        sigma = draw_scatter(scale, scatter, included.sum(axis=1), rng)
        scale = draw_scales(sigma, rng)
    for j in range(k):
        sd = np.sqrt(sigma[:, j, j])
        assert stats.kstest(sd, lambda s: 2 * stats.t(NU, scale=PRIOR_SCALE).cdf(s) - 1)[1] > 1e-3
    for i, j in zip(*np.tril_indices(k, -1), strict=True):
        correlation = sigma[:, i, j] / np.sqrt(sigma[:, i, i] * sigma[:, j, j])
        assert stats.kstest(correlation, stats.uniform(-1, 2).cdf)[1] > 1e-3
    left = (data - deviation) / np.sqrt(np.diag(formal))[:, None]  # formal errors, as they were
    assert stats.kstest(left[:, 0, 0], stats.norm.cdf)[1] > 1e-3
