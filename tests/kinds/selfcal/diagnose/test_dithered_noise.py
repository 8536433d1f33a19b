"""Self-calibrations of noise alone: p-values of what the residuals are asked are those of chance.

In full each kind of field is judged by itself; reduced, few of each are judged together.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from bayesdist.kinds.selfcal.diagnose.tests import dithered_misfit, selfcal_score_tests
from bayesdist.kinds.selfcal.infer import self_calibrate
from tests.kinds.selfcal.infer.fields import field
from tests.reduced import only_in_full

pytestmark = [pytest.mark.slow, only_in_full("test_selfcal_cover has p-values of noise")]

FIELDS = {"rolls": {}, "one roll": {"rolls": (0, 0, 0)}, "two chips": {"n_chips": 2}}


def p_values_of(seed: int, more: dict[str, object]) -> tuple[float, float]:
    """Of structure over the detector, and of residuals that go with where exposures point."""
    simulated = field(1000 + seed, 8, 900, disturbed=0.025, spurious=0.025, **more)
    given = {"match_radius": 1.0, "start_radius": 2.0}
    mode = self_calibrate(simulated.model, simulated.unlabelled, simulated.theta, **given).mode
    pointing = next(test for test in selfcal_score_tests(mode) if test.name == "pointing")
    return dithered_misfit(mode).p_value, pointing.p_value


@pytest.fixture(scope="module")
def found(full) -> list[np.ndarray]:
    """Groups (n, 2) of such p-values."""
    seeds = range(100 if full else 5)
    groups = [np.array([p_values_of(k, more) for k in seeds]) for more in FIELDS.values()]
    return groups if full else [np.concatenate(groups)]


def test_noise_is_no_structure(found):
    """Three tests share the p-value: Bonferroni is a little too careful."""
    for p in (group[:, 0] for group in found):
        for level in (0.01, 0.1, 0.3):
            assert (p < level).sum() <= binom.ppf(0.999, len(p), level)
        assert (p < 0.5).sum() >= max(binom.ppf(0.001, len(p), 0.3), 1)


def test_noise_does_not_go_with_where_exposures_point(found):
    """On a sky that is flat."""
    for p in (group[:, 1] for group in found):
        for level in (0.01, 0.1, 0.5):
            low, high = binom.ppf([0.001, 0.999], len(p), level)
            assert low <= (p < level).sum() <= high
