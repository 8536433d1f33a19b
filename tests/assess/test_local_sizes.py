"""Local terms are drawn as large as they may be: their own error is in the statistics."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.model import error_model
from bayesdist.assess.terms.correlated import LocalErrors
from bayesdist.diagnose.tables import MeanSquare
from bayesdist.infer import fit_linear
from tests.infer.support import UNCLIPPED, simulated

SHAPE = (16, 16)
DRAWS = 4000


def drawn(squares: dict[int, MeanSquare], sigma: float = 1.0):
    """Errors of a chip whose only term of weight is a local one."""
    model, matches, _ = simulated(1, 400, order=1, sigma=1e-6)
    fit = fit_linear(matches, model, **UNCLIPPED)
    values = {1: np.full((*SHAPE, 2), sigma)}
    term = LocalErrors.on_grid("left out", values, model, squares=squares)
    errors = error_model(fit, terms=[term]).drawn(DRAWS, np.random.default_rng(1))
    domain = EvaluationDomain.of_chips(model, SHAPE)
    return lambda names: errors.statistics(domain, names)


@pytest.mark.parametrize("error", [None, 0.1, 0.2])
def test_a_field_scatters_as_its_size_is_known(error):
    """ln(rms) of n independent errors: variance 1 / (2 n), and that of the size in addition.

    Sizes of both axes are independent, so that the mean of both is known better.
    """
    squares = {} if error is None else {1: MeanSquare(np.ones(2), np.full(2, error))}
    found = drawn(squares)(["rms", "u_rms"])
    for name, axes in (("rms", 2), ("u_rms", 1)):
        n = axes * SHAPE[0] * SHAPE[1]
        # the rms of draws over places, given squares: moments of logarithms by quadrature
        cut = stats.norm(1.0, error or 1e-9)
        square = np.mean([cut.rvs(200_000, random_state=k) for k in range(axes)], axis=0)
        expected = 1 / (2 * n) + np.log(square).var() / 4
        low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], DRAWS - 1) / (DRAWS - 1)
        assert low < np.log(found[name]).var(ddof=1) / expected < high
        # the mean square stays what the budget says, 1 on an axis
        square = found[name] ** 2
        assert abs(square.mean() - axes) < 3.9 * np.sqrt(square.var() / DRAWS)


def test_ignorance_of_a_term_never_makes_a_requirement_easier():
    """What met its limit for certain is met less and less as less is known of the term's size."""
    met = []
    for error in (0.0, 0.3, 1.0, 3.0, 10.0):
        square = MeanSquare(np.ones(2), np.full(2, error))
        statistics = drawn({1: square}, float(np.sqrt(square.mean[0])))
        met.append(np.mean(statistics(["rms"])["rms"] <= 1.6))
    assert met[0] == 1.0
    assert (np.diff(met) < 0).all() and met[-1] < 0.2
