"""Errors by magnitude, estimated with the fit: do they come out as they went in?"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import legendre

from bayesdist.data import Matches, read_matches
from bayesdist.errors import InputError
from bayesdist.infer import Rejection, build_model, fit_by_magnitude, fit_linear, residuals
from tests.reduced import case_in_full

from ..support import simulated


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
    bare = matches.with_errors(1.0)
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
    fit, table, _ = fit_by_magnitude(matches.with_errors(1.0), model)
    np.testing.assert_array_equal(fit_linear(table, model).mean, fit.mean)


def test_options_are_passed_on(lists):
    model, matches, _ = lists
    strict, *_ = fit_by_magnitude(matches, model, rejection=Rejection(clip_chi2=9.0))
    loose, *_ = fit_by_magnitude(matches, model, rejection=Rejection(clip_chi2=100.0))
    assert strict.n_used < loose.n_used


def test_magnitudes_are_needed():
    model, matches, _ = simulated(92, 100)
    with pytest.raises(InputError, match="need magnitudes"):
        fit_by_magnitude(matches, model)


def test_one_error_for_all_is_that_of_the_residuals_and_their_freedom():
    """With no law to speak of and no false matches: the sum of squares over n - p, by axis."""
    rng = np.random.default_rng(7)
    ratio = []
    for _ in range(20):
        n, order = 60, 3
        x, y = rng.uniform(1, 1000, (2, n))
        u, v = x + rng.normal(0, 0.1, n), y + rng.normal(0, 0.2, n)
        table = Matches(x=x, y=y, u=u, v=v, mag=rng.uniform(15.0, 15.001, n), unit="pix")
        model = build_model(table, order=order, size=(1000, 1000))
        *_, errors = fit_by_magnitude(table, model)
        A = legendre.legvander2d(x / 500 - 1, y / 500 - 1, [order, order])
        A = A[:, np.add.outer(range(order + 1), range(order + 1)).ravel() <= order]
        for data, sigma in ((u, errors.sigma_u), (v, errors.sigma_v)):
            left = data - A @ np.linalg.lstsq(A, data, rcond=None)[0]
            ratio.append(np.median(sigma) / np.sqrt(left @ left / (n - A.shape[1])))
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.02)
    assert np.ptp(ratio) < 0.2


@pytest.mark.parametrize(
    "name", [case_in_full("AstroTomii", instead="another field is run"), "Harry695"]
)
def test_real_pairs_of_every_order_have_errors(name, data_dir):
    """Fields on which fit and errors in turn swung for ever; the climb ends long before its end."""
    path = data_dir / "anet_pairs" / f"{name}_corr.fits"
    table = read_matches(path, format="astrometry.net", sigma="by_magnitude")
    size = (table.x.max() + 1, table.y.max() + 1)
    found = []
    for order in range(1, 8):
        model = build_model(table, order=order, size=size)
        short = fit_by_magnitude(table, model, max_iterations=60)[2]
        fit, _, errors = fit_by_magnitude(table, model, max_iterations=1000)
        np.testing.assert_array_equal(errors.sigma_u, short.sigma_u)
        found.append(errors.sigma_u)
        assert 0.9 < fit.chi2 / fit.dof < 2.0
    if name == "Harry695":  # 697 pairs: the law hardly depends on the order
        assert np.std(np.log(found), axis=0).max() < 0.1


def test_errors_predict_what_was_held_out(data_dir):
    """Half of a real field, with errors from the other half: 68 % within them, by halves of it."""
    path = data_dir / "anet_pairs" / "Harry695_corr.fits"
    table = read_matches(path, format="astrometry.net", sigma="by_magnitude")
    model = build_model(table, order=3, size=(table.x.max() + 1, table.y.max() + 1))
    pulls, bright = [], []
    for part in (0, 1):
        rows = np.arange(len(table)) % 2 == part
        held = table.select(~rows)
        fit, _, errors = fit_by_magnitude(table.select(rows), model)
        sigma = np.stack(errors.at(held.mag), axis=1)
        jacobian = model.jacobian(fit.mean, held.x, held.y)
        var = sigma**2 + np.einsum("nam,mk,nak->na", jacobian, fit.cov, jacobian)
        pulls.append(residuals(fit, held.with_errors(1.0)) / np.sqrt(var))
        bright.append(held.mag < np.median(table.mag))
    pull, bright = np.abs(np.concatenate(pulls)), np.concatenate(bright)
    for half in (pull[bright], pull[~bright]):
        assert (half < 1).mean() == pytest.approx(0.683, abs=0.05)
        assert (half < 2).mean() == pytest.approx(0.954, abs=0.03)
