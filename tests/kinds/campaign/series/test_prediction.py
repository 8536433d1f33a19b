"""Predictions and changes: what they are made of, and what they refuse."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.errors import DegenerateError, InputError
from bayesdist.kinds.campaign.series import Series, TrendModel, fit_series

from .campaign import ALPHA, BETA, BREAK, LINES, REFERENCE, SCATTER, campaign


@pytest.fixture(scope="module")
def truth():
    return campaign(1)


@pytest.fixture(scope="module")
def posterior(truth):
    return fit_series(truth.series, LINES)


def test_a_prediction_is_alpha_plus_beta_times_time(posterior):
    t = np.array([2003.0, 2006.9, 2010.0, 2014.0])
    segment = (t >= BREAK).astype(int)
    since = t - np.array(REFERENCE)[segment]
    draws = posterior.alpha[:, segment] + posterior.beta[:, segment] * since[:, None]
    prediction = posterior.predict(t)
    np.testing.assert_allclose(prediction.mean, draws.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(prediction.sigma, draws.std(axis=0, ddof=1), rtol=1e-6)
    new = prediction.cov_new - prediction.cov
    np.testing.assert_allclose(new, np.tile(posterior.scatter.mean(axis=0), (4, 1, 1)), rtol=1e-6)
    assert (prediction.sigma_new > SCATTER / 2).all()


def test_epochs_outside_are_refused(posterior):
    for t in (1999.0, 2030.0, np.inf, np.nan):
        with pytest.raises(InputError, match="outside the range of the exposures"):
            posterior.predict([2010.0, t])
    with pytest.raises(InputError, match="no group 'F814W'"):
        posterior.predict([2010.0], group="F814W")


def test_change_at_the_break(posterior, truth):
    """Against the truth, and against the levels on both sides of the date."""
    level, slope = posterior.change()
    step = ALPHA[1] + BETA[1] * (BREAK - 2012.5) - ALPHA[0] - BETA[0] * (BREAK - 2004.5)
    assert (np.abs(level.value - step) < 4 * level.sigma).all()
    assert (np.abs(slope.value - (BETA[1] - BETA[0])) < 4 * slope.sigma).all()
    edges = posterior.predict([BREAK - 1e-6, BREAK])
    np.testing.assert_allclose(level.value, edges.mean[1] - edges.mean[0], atol=1e-9)
    assert level.p_value < 1e-20  # section 4.4: both A_2 and B_2 have changed
    assert abs(level.significance[1]) > 10
    with pytest.raises(InputError, match="no break 2"):
        posterior.change(1)


def test_what_lies_off_is_named(posterior, truth):
    far = truth.off & (
        np.abs(truth.series.values - posterior.predict(truth.series.epoch).mean).max(axis=1)
        > 6 * SCATTER.max()
    )
    assert far.any() and (posterior.outlier_probability[far] > 0.9).all()
    assert (posterior.outlier_probability[~truth.off] < 0.5).mean() > 0.97
    assert posterior.raw.fraction.mean() == pytest.approx(truth.off.mean(), abs=0.05)


def test_same_seed_same_draws(truth):
    some = truth.series.take(np.arange(0, 110, 3))
    a, b, c = (fit_series(some, TrendModel("line"), seed=s) for s in (5, 5, 6))
    np.testing.assert_array_equal(a.alpha, b.alpha)
    assert not np.array_equal(a.alpha, c.alpha)


def test_units_do_not_matter(rng):
    """The same coefficient in pixels and in microarcseconds."""
    epoch = rng.uniform(2002, 2014, 40)
    values = 0.98 + 1e-5 * rng.standard_normal(40)
    one = Series.of(epoch, values, 1e-6, coefficients=("A_2",))
    other = Series.of(epoch, values * 5e4, 5e-2, coefficients=("A_2",))
    a, b = (fit_series(s, TrendModel("line")) for s in (one, other))
    np.testing.assert_allclose(a.beta * 5e4, b.beta, rtol=1e-3, atol=1e-6)


def test_known_scatter_must_fit(truth):
    with pytest.raises(InputError, match="scatter has shape"):
        fit_series(truth.series, TrendModel("line"), scatter=[[1.0]])
    exact = Series.of(truth.series.epoch, truth.series.values, coefficients=("a", "b", "c"))
    with pytest.raises(DegenerateError, match="no error at all"):
        fit_series(exact, TrendModel("line"), scatter=np.zeros((3, 3)))
