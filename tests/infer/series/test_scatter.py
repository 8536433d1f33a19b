"""The prior of the scatter against its definition, and its coordinates against differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.infer.series.scatter import (
    NU,
    PRIOR_SCALE,
    draw_scatter,
    from_coordinates,
    log_prior,
    to_coordinates,
)


def prior_draws(k: int, n: int, rng: np.random.Generator) -> np.ndarray:
    """Covariances (k, k, n) from the hierarchy of Huang and Wand, by scipy."""
    out = np.empty((k, k, n))
    for i in range(n):
        a = 1 / rng.gamma(0.5, PRIOR_SCALE**2, size=k)
        out[..., i] = stats.invwishart(NU + k - 1, 2 * NU * np.diag(1 / a)).rvs(random_state=rng)
    return out


def test_one_scatter_is_half_student_t():
    sd = np.geomspace(0.01, 50, 40)
    value = log_prior((sd**2)[None, None]) + np.log(2 * sd)  # density of sd
    expected = stats.t(NU, scale=PRIOR_SCALE).logpdf(sd)
    np.testing.assert_allclose(value - value[0], expected - expected[0], atol=1e-9)


def test_closed_form_is_the_hierarchy(rng):
    """Marginals of draws of the hierarchy: half-Student-t scatter, uniform correlation."""
    sigma = prior_draws(3, 1500, rng)
    for j in range(3):
        sd = np.sqrt(sigma[j, j])
        assert stats.kstest(sd, lambda s: 2 * stats.t(NU, scale=PRIOR_SCALE).cdf(s) - 1)[1] > 1e-3
    correlation = sigma[0, 2] / np.sqrt(sigma[0, 0] * sigma[2, 2])
    assert stats.kstest(correlation, stats.uniform(-1, 2).cdf)[1] > 1e-3


def test_draws_without_exposures_keep_the_prior(rng):
    """The exact draw leaves the prior as it is when there is nothing to learn from."""
    sigma = prior_draws(2, 4000, rng)
    for _ in range(5):
        sigma = draw_scatter(sigma, np.zeros((4000, 2, 2)), np.zeros(4000), rng)
    for j in range(2):
        sd = np.sqrt(sigma[j, j])
        assert stats.kstest(sd, lambda s: 2 * stats.t(NU, scale=PRIOR_SCALE).cdf(s) - 1)[1] > 1e-3


@pytest.mark.parametrize("k", [1, 2, 3])
def test_coordinates_and_their_jacobian(k, rng):
    d = k * (k + 1) // 2
    x = rng.standard_normal((1, d))
    sigma, log_jacobian = from_coordinates(x)
    np.testing.assert_allclose(to_coordinates(sigma), x, atol=1e-9)
    rows, columns = np.tril_indices(k)
    step = 1e-6
    slopes = [
        (from_coordinates(x + step * e)[0] - from_coordinates(x - step * e)[0])[rows, columns, 0]
        / (2 * step)
        for e in np.eye(d)
    ]
    log_det = np.linalg.slogdet(np.array(slopes))[1]
    # the map's constant factor 2^k is left out
    assert log_jacobian[0] == pytest.approx(log_det - k * np.log(2), abs=1e-5)
