"""Mean squares that were measured with errors: scipy's cut normal density."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.diagnose.tables import MeanSquare

MEASURED, ERROR = np.array([-2e-6, 3e-5]), np.array([1e-6, 2e-6])


def test_a_mean_square_below_zero_is_a_small_one():
    square = MeanSquare(MEASURED, ERROR)
    cut = stats.truncnorm(-MEASURED / ERROR, np.inf, MEASURED, ERROR)
    np.testing.assert_allclose(square.mean, cut.mean(), rtol=1e-6)
    of_radial = np.sqrt(cut.var().sum()) / (2 * cut.mean().sum())
    assert square.relative_error == pytest.approx(of_radial, rel=1e-5)
    assert square.mean[1] == pytest.approx(3e-5)


def test_draws_are_of_that_density():
    draws = MeanSquare(MEASURED, ERROR).relative_draws(20_000, np.random.default_rng(1))
    for axis, (measured, error) in enumerate(zip(MEASURED, ERROR, strict=True)):
        cut = stats.truncnorm(-measured / error, np.inf, measured, error)
        assert stats.kstest(draws[:, axis] * cut.mean(), cut.cdf).pvalue > 1e-3
    assert abs(np.corrcoef(draws.T)[0, 1]) < 4 / np.sqrt(20_000)


def test_what_is_known_exactly_is_not_drawn():
    square = MeanSquare(np.array([0.04, -0.01]), np.zeros(2))
    np.testing.assert_array_equal(square.mean, [0.04, 0.0])
    assert square.relative_error == 0.0
    assert (square.relative_draws(3, np.random.default_rng(1)) == 1.0).all()


def test_a_square_far_below_zero_stays_finite():
    square = MeanSquare(np.full(2, -60.0), np.ones(2))
    assert (square.mean > 0).all() and (square.mean < 0.02).all()  # an exponential of mean 1/60
    assert np.isfinite(square.relative_draws(100, np.random.default_rng(1))).all()
