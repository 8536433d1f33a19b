"""R-hat and effective sample sizes of many parameters against ArviZ's of one after another."""

from __future__ import annotations

import numpy as np
import pytest
from arviz_stats.base import array_stats

from bayesdist.infer import chain_statistics
from bayesdist.infer.chain_statistics import ess_bulk, ess_mean, ess_tail, rank_rhat

TAIL = (0.05, 0.95)
AXES = {"chain_axis": 0, "draw_axis": 1}


def autoregressive(coefficient, shape, seed=1):
    """Chains (C, N, D) of variance one, in which neighbours have this correlation."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal(shape)
    for t in range(1, shape[1]):
        x[:, t] = coefficient * x[:, t - 1] + np.sqrt(1 - coefficient**2) * x[:, t]
    return x


def of_each_kind():
    """Chains that are independent, alternate, hardly move, drift, have ties, or stand still."""
    for coefficient in (-0.7, 0.0, 0.5, 0.95):
        for C, N in ((4, 200), (3, 101), (2, 10), *((4, n) for n in range(4, 10))):
            yield autoregressive(coefficient, (C, N, 7))
    yield autoregressive(0.3, (4, 100, 5)) + np.linspace(0, 3, 100)[:, None]
    yield np.round(autoregressive(0.6, (4, 100, 5)))
    frozen = autoregressive(0.2, (4, 100, 3))
    frozen[..., 0] = 0.0
    frozen[..., 1] = frozen[:, :1, 1]
    yield frozen


@pytest.mark.parametrize("numbers", [1, 3000, 10**6])
def test_they_are_those_of_arviz(numbers, monkeypatch):
    """However many parameters are looked at at a time."""
    monkeypatch.setattr(chain_statistics, "NUMBERS", numbers)
    for chains in of_each_kind():
        with np.errstate(invalid="ignore", divide="ignore"):
            for ours, theirs in (
                (rank_rhat(chains), array_stats.rhat(chains, **AXES)),
                (ess_bulk(chains), array_stats.ess(chains, method="bulk", **AXES)),
                (ess_tail(chains, TAIL), array_stats.ess(chains, method="tail", prob=TAIL, **AXES)),
                (ess_mean(chains), array_stats.ess(chains, method="mean", **AXES)),
            ):
                np.testing.assert_allclose(ours, np.asarray(theirs, float), rtol=1e-12)


def test_independent_draws_count_as_what_they_are():
    chains = autoregressive(0.0, (4, 2000, 50))
    for found in (ess_bulk(chains), ess_mean(chains)):
        assert np.abs(found / 8000 - 1).mean() < 0.1
    assert (np.abs(rank_rhat(chains) - 1) < 0.01).all()
    # of neighbours with correlation a the fraction (1 - a) / (1 + a) is effective
    slow = ess_mean(autoregressive(0.8, (4, 2000, 50)))
    assert abs(np.median(slow) / 8000 - 0.2 / 1.8) < 0.02
