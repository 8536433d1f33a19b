"""Diagnostics on chains whose effective sample size is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from bayesdist.infer import Limits
from bayesdist.infer.convergence import diagnose, pareto_k

E, T, W = 4, 1500, 8
NAMES = ("a", "b", "c")
GOOD_WEIGHTS = np.random.default_rng(0).standard_normal(500) * 0.1


def ar1(shape, rho, seed) -> np.ndarray:
    """Stationary AR(1) of unit variance along axis 1."""
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal(shape) * np.sqrt(1 - rho**2)
    noise[:, 0] /= np.sqrt(1 - rho**2)
    return lfilter([1.0], [1.0, -rho], noise, axis=1)


def judged(chains, *, coupled=False, limits=None):
    names = NAMES[: chains.shape[-1]]
    return diagnose(chains, names, GOOD_WEIGHTS, limits or Limits(), coupled=coupled)


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_effective_sample_size_of_ar1(rho):
    """(1 - rho) / (1 + rho) per draw for the mean, rho^2 in its place for the variance."""
    found = judged(3.0 + 2.0 * ar1((E, T, W, 3), rho, seed=1))
    n = E * T * W
    ess = n * (1 - rho) / (1 + rho)
    np.testing.assert_allclose(found.ess_bulk, ess, rtol=0.12)
    np.testing.assert_allclose(found.mcse_mean, 2.0 / np.sqrt(ess), rtol=0.1)
    ess_sd = n * (1 - rho**2) / (1 + rho**2)
    np.testing.assert_allclose(found.mcse_sd, 2.0 / np.sqrt(2 * ess_sd), rtol=0.1)
    assert (found.ess_tail < 1.2 * n).all() and (found.ess_tail > 0.8 * ess).all()
    assert found.converged and found.reasons == ()
    assert 0.999 < found.rhat_max < 1.01
    assert found.ess_bulk_min == found.ess_bulk.min()


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize(("steps", "walkers"), [(1, 8), (2, 8), (3, 8), (1, 1), (3, 1)])
def test_so_few_draws_say_nothing(steps, walkers, coupled):
    found = judged(ar1((E, steps, walkers, 3), 0.0, seed=6), coupled=coupled)
    assert not found.converged
    assert any(r.startswith("bulk ESS") for r in found.reasons)
    assert (found.ess_bulk <= E * steps * walkers * 2).all() and (found.ess_bulk >= 0).all()


def test_a_drift_that_all_walkers_share_counts():
    """x = (common + own) / sqrt 2: averaging over walkers does not help against the common part."""
    rho, shared, T = 0.9, 0.5, 8000  # long, as the estimate itself scatters
    common = ar1((E, T, 1, 3), rho, seed=2)
    own = ar1((E, T, W, 3), 0.0, seed=3)
    chains = np.sqrt(shared) * common + np.sqrt(1 - shared) * own
    variance_of_mean = shared * (1 + rho) / (1 - rho) / (E * T) + (1 - shared) / (E * T * W)
    found = judged(chains, coupled=True)
    np.testing.assert_allclose(found.ess_bulk, 1 / variance_of_mean, rtol=0.2)
    # walkers taken for independent would claim far more
    assert judged(chains, coupled=False).ess_bulk_min > 3 / variance_of_mean


def test_an_ensemble_that_stands_elsewhere():
    chains = ar1((E, T, W, 3), 0.3, seed=4)
    chains[2, ..., 1] += 0.5
    found = judged(chains)
    assert not found.converged
    assert found.rhat[1] > 1.01 > found.rhat[0]
    (reason,) = [r for r in found.reasons if r.startswith("R-hat")]
    assert "R-hat of b is" in reason and "at most 1.01 (1 of 3 parameters)" in reason


def test_an_ensemble_that_is_wider():
    """Rank-normalised R-hat sees scale as well as place."""
    chains = ar1((E, T, W, 3), 0.3, seed=5)
    chains[0, ..., 2] *= 2.0
    found = judged(chains)
    assert not found.converged and "R-hat of c" in found.reasons[0]


def test_a_drift_within_every_ensemble():
    """All ensembles move together: only split chains show it."""
    chains = ar1((E, T, W, 3), 0.3, seed=6)
    chains[..., 0] += np.linspace(0, 1.5, T)[None, :, None]
    found = judged(chains)
    assert not found.converged and "R-hat of a" in found.reasons[0]


@pytest.mark.parametrize("kind", ["one value", "one value for each ensemble"])
def test_a_frozen_parameter(kind):
    chains = ar1((E, T, W, 3), 0.3, seed=7)
    chains[..., 1] = 1.0 if kind == "one value" else np.arange(E)[:, None, None]
    found = judged(chains)
    assert not found.converged
    assert any("of b is" in reason for reason in found.reasons)
    for values in (found.ess_bulk, found.ess_tail, found.mcse_mean, found.mcse_sd):
        assert np.isfinite(values).all()


def test_a_frozen_parameter_has_no_effective_draws():
    chains = ar1((E, T, W, 3), 0.3, seed=8)
    chains[..., 1] = 1.0
    found = judged(chains)
    assert found.ess_bulk[1] < 10 and found.ess_tail[1] < 10


@pytest.mark.parametrize("coupled", [False, True])
def test_many_walkers_do_not_make_up_for_walkers_that_never_move(coupled):
    still = np.random.default_rng(4).normal(size=(4, 1, 300, 3))
    found = judged(np.broadcast_to(still, (4, 50, 300, 3)), coupled=coupled)
    assert not found.converged and found.ess_bulk_min > 400
    (reason,) = found.reasons
    assert reason.startswith("a walker has made 0.") and "must have made at least 5" in reason


def test_few_walkers_that_mix_are_converged():
    found = judged(np.random.default_rng(5).normal(size=(4, 50, 16, 3)))
    assert found.converged, found.reasons


def test_too_few_draws():
    found = judged(ar1((E, 60, 4, 3), 0.8, seed=9))  # 960 draws worth about 107
    assert not found.converged
    assert {r.split(" of ")[0] for r in found.reasons} >= {"bulk ESS", "tail ESS"}
    assert all("at least 400" in r for r in found.reasons if "ESS" in r)
    # a number is the same in a sentence and in the table of the status: whole draws
    (bulk,) = [r for r in found.reasons if r.startswith("bulk ESS")]
    assert f" is {int(found.ess_bulk_min)} and" in bulk
    relaxed = judged(ar1((E, 60, 4, 3), 0.8, seed=9), limits=Limits(ess=20, rhat=1.3))
    assert relaxed.converged


def test_tail_index_of_weights_with_a_known_tail():
    """Weights exp(k x), x exponential, have a Pareto tail of shape k."""
    x = np.random.default_rng(10).exponential(size=20_000)
    for k in (0.2, 0.5, 0.9):
        assert pareto_k(k * x) == pytest.approx(k, abs=0.12)


def test_importance_efficiency():
    """For log-normal weights of log-sd s it is exp(-s^2)."""
    w = 0.5 * np.random.default_rng(11).standard_normal(200_000)
    found = diagnose(ar1((E, 50, W, 3), 0.0, 1), NAMES, w, Limits(), coupled=False)
    assert found.importance_efficiency == pytest.approx(np.exp(-0.25), rel=0.02)
    assert found.pareto_k == pareto_k(w)


def test_equal_weights_are_perfect_and_too_few_say_nothing():
    assert pareto_k(np.zeros(100)) < 0
    assert pareto_k(np.zeros(10)) > 0.7
