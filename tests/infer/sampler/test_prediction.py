"""Cost of sampling: predicted or said to be unknown, reported on the way, and limited."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from bayesdist.infer import Limits, OutlierMixture
from bayesdist.infer.convergence import diagnose
from bayesdist.infer.density.grid import build_proposal
from bayesdist.infer.sampler.chains import ChainSettings, Heartbeat, ensemble_seeds, run_chains
from bayesdist.infer.sampler.sample import predict
from bayesdist.infer.sampler.schedule import is_too_slow

from ..fakes import FakeTarget, gaussian_proposal
from ..support import simulated, target_of

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize(
    ("n", "order", "fraction"),
    [(300, 1, 0.0), (1500, 3, 0.05), (12, 2, 0.0)],
)
def test_passes_are_predicted_within_a_factor_of_three_or_are_said_to_be_unknown(
    n, order, fraction
):
    model, matches, _ = simulated(60 + n % 7, n, order=order, fraction=fraction)
    target, fit = target_of(model, matches, OutlierMixture())
    proposal = build_proposal(target, fit)
    settings = ChainSettings(ensemble_seeds(1, 4), n, max_steps=200)
    predicted = predict(target, proposal, settings)
    chains = run_chains(target, proposal, settings)
    assert chains.passes <= 2 * predicted.most_passes  # the pilot is counted, too
    if n >= 300:  # many stars: the posterior is next to normal
        assert predicted.passes is not None
        assert chains.verdict.converged
    if predicted.passes is not None:
        assert 1 / 3 < chains.passes / predicted.passes < 3
        assert chains.plan.independent


def test_the_cost_of_a_posterior_that_is_far_from_its_proposal_is_unknown():
    target = FakeTarget(lambda psi: -0.5 * (psi**2).sum(axis=1) / 9, 3)
    proposal = gaussian_proposal(np.zeros(3), np.eye(3))
    predicted = predict(target, proposal, ChainSettings(ensemble_seeds(1, 4), 10, max_steps=500))
    assert predicted.passes is None
    assert predicted.most_passes == 4 * predicted.plan.walkers * 500


def test_a_line_appears_every_ten_seconds(caplog):
    seconds = iter([0.0, 4.0, 11.0, 12.0, 20.0, 22.0])
    density = Heartbeat(FakeTarget(lambda psi: psi[:, 0], 2), 20, clock=lambda: next(seconds))
    density.method = "DE"
    with caplog.at_level(logging.INFO, logger="bayesdist"):
        for _ in range(5):
            np.testing.assert_array_equal(density.log_density(np.ones((7, 2))), np.ones(7))
    said = [record.message for record in caplog.records]
    assert said == [
        "sample: DE, 14 passes over 20 stars in 11 s",
        "sample: DE, 35 passes over 20 stars in 22 s",
    ]


def verdict(rng, rho, n):
    """Verdict on 4 chains of n steps whose autocorrelation at lag 1 is known."""
    noise = rng.normal(size=(4, n, 1, 1)) * np.sqrt(1 - rho**2)
    draws = np.empty_like(noise)
    draws[:, 0] = rng.normal(size=(4, 1, 1))
    for t in range(1, n):
        draws[:, t] = rho * draws[:, t - 1] + noise[:, t]
    return diagnose(draws, ("a",), np.zeros(100), Limits(400, 1.01), coupled=False)


def test_only_sampling_that_cannot_reach_its_targets_is_given_up(rng):
    # effective draws are n (1 - rho) / (1 + rho) of each chain
    slow = verdict(rng, 0.999, 1000)
    assert is_too_slow(slow, 1000, 4000)
    assert not is_too_slow(slow, 999, 4000)  # too early
    assert not is_too_slow(slow, 1000, 10**6)  # but judged after a quarter
    # 4 x 1000 x 0.05 / 1.95 = 100 effective draws: 400 are reached in 4000 steps
    assert not is_too_slow(verdict(rng, 0.95, 1000), 1000, 4000)


def test_a_walk_that_is_too_slow_ends_with_its_reason(caplog):
    """A narrow ring, along which no move gets far: its proposal is a disk."""

    def ring(psi):
        radius = np.hypot(psi[:, 0], psi[:, 1])
        return -0.5 * ((radius - 1000) / 0.01) ** 2

    proposal = gaussian_proposal(np.zeros(2), 1e6 * np.eye(2))
    settings = ChainSettings(ensemble_seeds(1, 4), 10, limits=Limits(20_000, 1.01), max_steps=400)
    chains = run_chains(FakeTarget(ring, 2), proposal, settings)
    assert not chains.verdict.converged
    assert chains.steps < 400
    assert "given up" in chains.verdict.reasons[0]
    assert "sampler.max_steps = 400" in caplog.text
