"""Many walkers do not make up for walkers that never move."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.infer.convergence import Limits, diagnose


@pytest.mark.parametrize("coupled", [False, True])
def test_frozen_walkers_are_not_converged(coupled):
    rng = np.random.default_rng(4)
    still = np.broadcast_to(rng.normal(size=(4, 1, 300, 3)), (4, 50, 300, 3))
    found = diagnose(still, ("a", "b", "c"), rng.normal(size=200) / 9, Limits(), coupled=coupled)
    assert not found.converged
    assert any("walker" in reason or "ESS" in reason for reason in found.reasons)


def test_walkers_that_mix_are_converged():
    draws = np.random.default_rng(5).normal(size=(4, 50, 16, 3))
    found = diagnose(draws, ("a", "b", "c"), np.zeros(200), Limits(), coupled=False)
    assert found.converged, found.reasons
