"""R-hat, effective sample sizes and Pareto tails against ArviZ, which says the same."""

from __future__ import annotations

import arviz as az
import numpy as np
import pytest
from scipy.signal import lfilter

from bayesdist.infer.effective_draws import bulk_draws, mean_draws, rank_rhat, tail_draws
from bayesdist.infer.pareto import pareto_smoothed

SHAPES = [(2, 4), (2, 5), (3, 6), (4, 7), (1, 50), (2, 101), (4, 896), (8, 2500)]


def chains(shape, seed) -> np.ndarray:
    """Twelve parameters: slow, fast and alternating ones, of heavy tails, discrete, and frozen."""
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((*shape, 12))
    out = np.empty_like(noise)
    for k, rho in enumerate((0.0, 0.5, 0.9, 0.99, -0.5, -0.9)):
        out[..., k] = lfilter([1.0], [1.0, -rho], noise[..., k], axis=1)
    out[..., 6] = rng.standard_cauchy(shape)
    out[..., 7] = rng.integers(0, 3, shape)  # ties
    out[..., 8] = noise[..., 8] > 1.5
    out[..., 9] = np.arange(shape[0])[:, None]  # each chain stands elsewhere
    out[..., 10] = 3.0  # never moved
    out[..., 11] = 30 + noise[..., 11].cumsum(axis=1)  # a random walk
    return out


@pytest.mark.filterwarnings("ignore::RuntimeWarning", "ignore::UserWarning")
@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("seed", range(3))
def test_chains_as_arviz_judges_them(shape, seed):
    values = chains(shape, seed)
    data = az.convert_to_dataset({"x": values})
    for ours, theirs in (
        (rank_rhat, az.rhat(data)),
        (bulk_draws, az.ess(data)),
        (tail_draws, az.ess(data, method="tail")),
        (mean_draws, az.ess(data, method="mean")),
    ):
        found, expected = (
            # without variance R-hat is infinite, undefined or very large, as numbers are rounded
            np.where(one < 1e6, one, np.inf)
            for one in (ours(values), theirs["x"].values)
        )
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12, err_msg=ours.__name__)


def test_chains_that_say_nothing():
    values = chains((4, 100), 0)
    values[1, 50, 2] = np.nan
    for function in (rank_rhat, bulk_draws, tail_draws, mean_draws):
        found = function(values)
        assert np.isnan(found[2]) and np.isfinite(found[:2]).all()
        assert np.isnan(function(values[:, :3])).all()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("n", [25, 26, 60, 500, 4000])
@pytest.mark.parametrize("independent", [1.0, 0.2])
def test_weights_smoothed_as_by_arviz(n, independent):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        spread = (0.01, 0.5, 2.0, 8.0, 300.0)[seed % 5]
        log_weights = 50 + spread * (
            rng.standard_normal(n) if seed % 2 else -rng.standard_exponential(n)
        )
        if seed % 3 == 0 and spread > 0.1:
            log_weights = np.round(log_weights, 2)  # ties at the threshold
        theirs, k = az.psislw(log_weights.copy(), reff=independent)
        ours, own_k = pareto_smoothed(log_weights, independent)
        np.testing.assert_allclose(own_k, k, rtol=1e-10, atol=1e-10)
        # weights of equal size may be smoothed in another order
        np.testing.assert_allclose(np.sort(ours), np.sort(theirs), rtol=1e-10, atol=1e-10)


def test_a_tail_of_equal_weights_ends():
    """One of the shapes that are tried is exactly exponential then."""
    log_weights = np.repeat([-1.0, 0.0], [3900, 100])
    smoothed, k = pareto_smoothed(log_weights)
    assert np.isfinite(smoothed).all() and k < 0
