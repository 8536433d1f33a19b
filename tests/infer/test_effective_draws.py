"""R-hat and effective sample sizes against ArviZ, parameter by parameter."""

from __future__ import annotations

import numpy as np
import pytest
from arviz_stats.base import array_stats
from scipy.signal import lfilter

from bayesdist.infer.convergence import mean_draws, rhat_and_bulk_draws, tail_draws

AXES = {"chain_axis": 0, "draw_axis": 1}
TAILS = (0.05, 0.95)


def chains_of(C: int, N: int) -> np.ndarray:
    """Chains (C, N, 60) of all scales and correlations, with repeated draws."""
    rng = np.random.default_rng(N)
    rho = np.linspace(-0.6, 0.98, 60)
    noise = rng.normal(size=(C, N, 60))
    chains = np.stack([lfilter([1], [1, -r], noise[..., k], axis=1) for k, r in enumerate(rho)], 2)
    stays = rng.random((C, N)) < 0.3
    for n in range(1, N):
        chains[stays[:, n], n] = chains[stays[:, n], n - 1]
    return 7.0 + chains * 10.0 ** rng.uniform(-3, 3, 60)


@pytest.mark.parametrize(
    ("C", "N"), [(4, 400), (4, 401), (8, 12), (4, 7), (3, 9), (2, 70_000)], ids=str
)
def test_numbers_are_those_of_arviz(C, N):
    """Halves with and without a middle draw; short ones; more draws than are treated at once."""
    chains = chains_of(C, N)[..., :: 1 if N < 1000 else 20]
    rhat, bulk = rhat_and_bulk_draws(chains)
    for found, expected in (
        (rhat, array_stats.rhat(chains, **AXES)),
        (bulk, array_stats.ess(chains, method="bulk", **AXES)),
        (tail_draws(chains, TAILS), array_stats.ess(chains, method="tail", prob=TAILS, **AXES)),
        (mean_draws(chains), array_stats.ess(chains, method="mean", **AXES)),
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-10)


@pytest.mark.parametrize(("C", "T", "W"), [(4, 50, 8), (3, 25, 6), (3, 25, 7)], ids=str)
def test_bulk_goes_through_one_walker_after_the_other(C, T, W):
    """And R-hat through one step after the other; with a middle draw, and without one."""
    in_time = chains_of(C, T * W)
    by_walker = np.swapaxes(in_time.reshape(C, T, W, -1), 1, 2).reshape(C, T * W, -1)
    rhat, bulk = rhat_and_bulk_draws(in_time, W)
    np.testing.assert_array_equal(rhat, rhat_and_bulk_draws(in_time)[0])
    np.testing.assert_array_equal(bulk, rhat_and_bulk_draws(by_walker)[1])
    expected = array_stats.ess(by_walker, method="bulk", **AXES)
    np.testing.assert_allclose(bulk, expected, rtol=1e-10)


def test_a_parameter_that_never_moved_and_one_that_is_not_a_number():
    chains = chains_of(4, 100)[..., :3]
    chains[..., 1] = 3.0
    chains[2, 50, 2] = np.nan
    rhat, bulk = rhat_and_bulk_draws(chains)
    assert np.isnan(rhat).tolist() == [False, True, True]
    for found in (bulk, tail_draws(chains, TAILS), mean_draws(chains)):
        assert found[1] == 400 and np.isnan(found).tolist() == [False, False, True]


def test_scale_does_not_matter():
    """Unlike ArviZ, which takes draws within 1e-15 of each other for one."""
    chains = chains_of(4, 100) - 7.0
    np.testing.assert_allclose(mean_draws(chains * 1e-30), mean_draws(chains), rtol=1e-10)
