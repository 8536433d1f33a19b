"""Orders above nine, as calibrations with masks of pinholes take them."""

from __future__ import annotations

import numpy as np
import pytest

import bayesdist as bd
from bayesdist.calibration.calibration import calibration_of
from bayesdist.errors import InputError
from bayesdist.infer.solution.linear import NO_REJECTION
from bayesdist.products.common.document import BuildOptions
from bayesdist.products.registry import build, product_settings, read_calibration

pytestmark = pytest.mark.plugins

ORDER = 12
CHIP = bd.Chip(1, "MICADO", (2048.0, 2048.0), (1024.5, 1024.5))
SIGMA = 0.005


@pytest.fixture(scope="module")
def stars():
    """Stars with a distortion of some pixels, whose terms fall with the order."""
    rng = np.random.default_rng(1)
    model = bd.DistortionModel(ORDER, (CHIP,), "arcsec")
    theta = np.zeros(model.n_params)
    total = np.array([i + j for i, j in model.basis().terms])
    for axis in (0, 1):
        part = model.coefficient_slice(1, axis)
        theta[part] = 0.01 * rng.normal(size=model.n_terms) * 0.5**total
        theta[part.start + 1 + axis] = 0.004 * 1024
    matches, truth = bd.simulate_matches(model, theta, 2000, sigma=SIGMA, fraction=0.0, rng=rng)
    return model, matches, truth.theta


@pytest.fixture(scope="module")
def fit(stars):
    model, matches, _ = stars
    return bd.fit_linear(matches, model, rejection=NO_REJECTION)


def test_the_fit_is_that_of_least_squares(stars, fit):
    """numpy.linalg.lstsq on Legendre products by numpy, to a ten-thousandth of the errors."""
    model, matches, _ = stars
    X, Y = ((2 * matches.column(c) - 2049) / 2048 for c in "xy")
    one = np.polynomial.legendre.legvander
    terms = [(n - j, j) for n in range(ORDER + 1) for j in range(n + 1)]
    design = np.stack([one(X, ORDER)[:, i] * one(Y, ORDER)[:, j] for i, j in terms], axis=1)
    cov = SIGMA**2 * np.linalg.inv(design.T @ design)
    for axis, values in enumerate("uv"):
        expected = np.linalg.lstsq(design, matches.column(values), rcond=None)[0]
        part = model.coefficient_slice(1, axis)
        sigma = np.sqrt(np.diag(cov))
        np.testing.assert_allclose(fit.mean[part], expected, rtol=0, atol=1e-4 * sigma.min())
        np.testing.assert_allclose(fit.sigma[part], sigma, rtol=1e-6)


def test_the_posterior_holds(stars, fit):
    """With jitter and false matches in the model: near the fit, errors as they should be."""
    _, matches, theta = stars
    posterior = bd.sample(fit, matches, seed=1, target_ess=200)
    assert posterior.convergence.converged
    off = (posterior.mean - fit.mean) / fit.sigma
    assert np.abs(off).max() < 0.6  # jitter, and the noise of 200 draws: 0.07
    ratio = posterior.sigma / fit.sigma
    assert ratio.min() > 0.8 and ratio.max() < 1.25
    pull = (posterior.mean - theta) / posterior.sigma
    assert np.abs(pull).max() < 4.5


PLACED = {
    "useafter": "2022-07-01T00:00:00", "pedigree": "GROUND", "author": "A",
    "v2ref": 10.0, "v3ref": -20.0, "v3idlyangle": 0.5,
}  # fmt: skip
HOLD = {
    "ast": {},
    "jwst": {"instrument": "NIRISS", "detector": "NIS", "filter": "CLEAR", "pupil": "F200W"},
    "roman": {"detector": "WFI01", "optical_element": "F158"},
}


@pytest.mark.parametrize("key", HOLD)
def test_formats_without_a_limit_hold_them(fit, tmp_path, key):
    if key != "ast":
        pytest.importorskip("asdf")
    given = HOLD[key] if key == "ast" else HOLD[key] | PLACED
    files = build(key, calibration_of(fit, "run"), product_settings()[key](**given))
    for one in files:
        (tmp_path / one.file_name).write_bytes(one.content)
    name = next(f.file_name for f in files if f.kind != "parameters")
    found = read_calibration(tmp_path / name)
    np.testing.assert_array_equal(found.solution.cov, fit.cov)


@pytest.mark.parametrize(
    ("key", "highest", "given"),
    [
        ("sip", 9, {}),
        ("tpv", 7, {}),
        ("siaf", 9, {}),
        ("idctab", 9, {"instrument": "ACS", "detector": "WFC"}),
        ("wise_meta", 9, {}),
    ],
)
def test_formats_with_a_limit_say_it(fit, key, highest, given):
    settings = product_settings()[key].model_construct(**given)
    with pytest.raises(InputError, match=f"order is 12.* limited to order {highest}"):
        build(key, calibration_of(fit, "run"), settings, BuildOptions())
