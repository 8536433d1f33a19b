"""Errors by magnitude, iterated with the fit: do they come out as they went in?"""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.errors import InputError
from bayesdist.infer import fit_by_magnitude, fit_linear

from .support import simulated


def true_sigma(mag):
    """A floor at the bright end, photon noise at the faint one."""
    sigma = np.hypot(0.02, 0.2 * 10 ** (0.4 * (mag - 20)))
    return sigma, 1.2 * sigma


@pytest.fixture(scope="module")
def lists():
    mag = np.random.default_rng(1).uniform(14, 20, 4000)
    return simulated(91, 4000, order=3, mag=mag, sigma=true_sigma, fraction=0.02)


def test_errors_come_out_as_they_went_in(lists):
    model, matches, truth = lists
    bare = matches.with_sigma(1.0, 1.0)
    fit, table, errors = fit_by_magnitude(bare, model)
    for found, true in zip(errors.at(matches.mag), true_sigma(matches.mag), strict=True):
        ratio = found / true
        assert np.median(ratio) == pytest.approx(1, abs=0.05)
        assert (np.abs(ratio - 1) < 0.35).mean() > 0.99
    np.testing.assert_allclose(table.sigma_u, errors.at(matches.mag)[0])
    d = fit.mean - truth.theta
    assert np.mean(d @ np.linalg.solve(fit.cov, d)) < 2 * len(d)
    rejected = fit.n_rejected / fit.n_rows
    assert rejected == pytest.approx(truth.false.mean(), abs=0.01)
    assert (~fit.uses(table)).sum() == fit.n_rejected


def test_the_fit_is_that_of_the_table_it_returns(lists):
    model, matches, _ = lists
    fit, table, _ = fit_by_magnitude(matches.with_sigma(1.0, 1.0), model)
    np.testing.assert_array_equal(fit_linear(table, model).mean, fit.mean)


def test_options_are_passed_on(lists):
    model, matches, _ = lists
    strict, *_ = fit_by_magnitude(matches, model, clip_chi2=9.0)
    loose, *_ = fit_by_magnitude(matches, model, clip_chi2=100.0)
    assert strict.n_used < loose.n_used


def test_magnitudes_are_needed():
    model, matches, _ = simulated(92, 100)
    with pytest.raises(InputError, match="need magnitudes"):
        fit_by_magnitude(matches, model)


def test_errors_that_do_not_settle_are_refused(lists):
    model, matches, _ = lists
    with pytest.raises(InputError, match="did not settle in 1 iterations"):
        fit_by_magnitude(matches, model, max_iterations=1)
