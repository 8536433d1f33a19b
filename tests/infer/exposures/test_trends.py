"""Lines in time among deviations: as often found by chance as is said, and found where they are."""

import numpy as np
import pytest
from scipy import stats

from bayesdist.infer.exposures.hierarchy import trend_p_values

EPOCH = np.linspace(2002.0, 2012.0, 20)


@pytest.mark.parametrize("breaks", [(), (2008.0,)])
def test_without_a_trend_probabilities_are_even(rng, breaks):
    step = 3.0 * (EPOCH > 2008.0)[:, None] if breaks else 0.0
    p = trend_p_values(rng.standard_normal((EPOCH.size, 3000)) + step, EPOCH, breaks)
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_a_trend_is_found(rng):
    values = rng.standard_normal((EPOCH.size, 2)) + [[0.0, 0.5]] * (EPOCH - 2007.0)[:, None]
    p = trend_p_values(values, EPOCH)
    assert p[0] > 1e-3 > 1e-5 > p[1]


def test_few_exposures_have_no_trend(rng):
    assert (trend_p_values(rng.standard_normal((4, 2)), EPOCH[:4]) == 1).all()
