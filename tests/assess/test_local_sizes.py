"""Local terms are drawn as large as they may be: their own error is in the statistics."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.assess.position_errors import Judged, position_errors
from bayesdist.assess.regions import WHOLE
from bayesdist.assess.terms import LocalTerm
from bayesdist.infer import fit_linear
from tests.infer.support import UNCLIPPED, simulated

SHAPE = (16, 16)
DRAWS = 4000


@pytest.mark.parametrize("relative", [None, 0.05, 0.1])
def test_a_field_scatters_as_its_size_is_known(relative):
    """ln(rms) of n independent errors: variance 1 / (2 n), and that of the size in addition.

    Sizes of both axes are independent, so that the mean of both is known better.
    """
    model, matches, _ = simulated(1, 400, order=1, sigma=1e-6)
    fit = fit_linear(matches, model, **UNCLIPPED)
    term = LocalTerm("left out", {1: np.ones((*SHAPE, 2))}, relative)
    errors = position_errors(
        fit, local=[term], grid=SHAPE, n_draws=DRAWS, rng=np.random.default_rng(1)
    )
    found = errors.statistics(Judged(model.chips, None, WHOLE), ["rms", "u_rms"])
    for name, axes in (("rms", 2), ("u_rms", 1)):
        n = axes * SHAPE[0] * SHAPE[1]
        expected = 1 / (2 * n) + (relative or 0.0) ** 2 / axes
        low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], DRAWS - 1) / (DRAWS - 1)
        assert low < np.log(found[name]).var(ddof=1) / expected < high
        # the mean square stays what the budget says, 1 on an axis
        square = found[name] ** 2
        assert abs(square.mean() - axes) < 3.9 * np.sqrt(square.var() / DRAWS)
