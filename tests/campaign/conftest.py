"""Campaigns that all tests of this package look at, each simulated and calibrated once."""

from __future__ import annotations

import pytest

from tests.campaign.measures import Outcome, outcome
from tests.campaign.support import ISR, LOOSE, MATERN, PUBLISHED_SIZE, SHORT, Setting
from tests.seeds import over

# how many seeds; what takes longest begins
FULL = {PUBLISHED_SIZE: 1, ISR: 4, MATERN: 20, LOOSE: 12}


@pytest.fixture(scope="package")
def campaigns(full: bool) -> dict[Setting, list[Outcome]]:
    """Outcomes by setting; reduced, one smaller campaign of one."""
    if not full:
        jobs = [(short, 1) for short in SHORT.values()]
        return {s: [found] for s, found in zip(SHORT, over(outcome, jobs), strict=True)}
    jobs = [(s, seed + 1) for s, n in FULL.items() for seed in range(n)]
    out: dict[Setting, list[Outcome]] = {}
    for (setting, _), found in zip(jobs, over(outcome, jobs), strict=True):
        out.setdefault(setting, []).append(found)
    return out


@pytest.fixture(params=[MATERN, ISR], ids=lambda setting: setting.pattern)
def runs(request: pytest.FixtureRequest, campaigns) -> list[Outcome]:
    """Outcomes for one kind of pattern."""
    if request.param not in campaigns:
        pytest.skip("tables at 64 pixels take a minute for a seed: set BAYESDIST_FULL=1")
    return campaigns[request.param]
