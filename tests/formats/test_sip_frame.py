"""SIP headers of u, v in a frame of pixels, and what is warned of in others."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS, FITSFixedWarning

import bayesdist as bd
from bayesdist.calibration.calibration import Calibration, calibration_of
from bayesdist.calibration.chip_map import FurtherError
from bayesdist.calibration.plane import Plane
from bayesdist.errors import InputError
from bayesdist.formats import sip_from_solution
from bayesdist.infer.solution.solution import GaussianSolution
from bayesdist.missions.wise import simulate_wise
from bayesdist.products.common.document import BuildOptions, Choice
from bayesdist.products.registry import (
    build,
    lint,
    open_document,
    product_settings,
    read_back,
    read_calibration,
)


@pytest.fixture(scope="module")
def fit():
    """An order-3 distortion whose u, v are pixels of a frame that is turned and mirrored."""
    rng = np.random.default_rng(1)
    chip = bd.Chip(1, "camera", (900.0, 700.0), (450.5, 350.5))
    model = bd.DistortionModel(3, (chip,), "pix")
    theta = 0.3 * rng.normal(size=model.n_params)
    u, v = (model.coefficient_slice(1, axis).start for axis in (0, 1))
    theta[[u, u + 1, u + 2]] = 1200.0, 100.0, 340.0
    theta[[v, v + 1, v + 2]] = -300.0, 440.0, -90.0
    stars, _ = bd.simulate_matches(model, theta, 400, sigma=0.01, rng=rng)
    return bd.fit_linear(stars, model)


def made(fit, tmp_path, **settings):
    calibration = calibration_of(fit, "run")
    files = build("sip", calibration, product_settings()["sip"](**settings), BuildOptions())
    for one in files:
        (tmp_path / one.file_name).write_bytes(one.content)
    return files, tmp_path / files[-1].file_name


@pytest.mark.parametrize("linear", ["cd"])
def test_astropy_gives_u_and_v_of_linear_axes(fit, tmp_path, linear):
    """all_pix2world is the model to 1e-6 px, and all_world2pix the way back; no sky is made."""
    files, path = made(fit, tmp_path, axes="linear", linear=linear)
    header = fits.Header.fromtextfile(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        wcs = WCS(header)
    assert not wcs.has_celestial
    rng = np.random.default_rng(2)
    x, y = rng.uniform(1, 900, 300), rng.uniform(1, 700, 300)
    expected = calibration_of(fit).forward(x, y, chip=1)
    np.testing.assert_allclose(np.stack(wcs.all_pix2world(x, y, 1), axis=-1), expected, atol=1e-6)
    assert files[-1].warnings == ()
    found = read_calibration(path)
    assert found.unit == "pix"
    np.testing.assert_allclose(found.forward(x, y, chip=1), expected, atol=1e-6)
    [back] = read_back("sip", files, calibration_of(fit), BuildOptions())
    np.testing.assert_allclose(back.forward(x, y, 1, None), expected, atol=1e-6)
    assert [f.level for f in lint(path)] == ["note"]


def test_what_programs_would_make_of_a_header_is_warned_of(fit, tmp_path):
    [_, one], _ = made(fit, tmp_path)
    [note] = one.notes
    assert "CRVAL is a placeholder" in note and "axes = 'linear'" in note
    assert not one.warnings  # the settings cause it, and the file says it
    determinant = np.linalg.det(calibration_of(fit).chip().linear)
    assert ("mirror" in note) == (determinant > 0)
    [_, one], _ = made(fit, tmp_path, crval=(10.0, 20.0))
    assert not one.notes
    assert "check that they are" in one.warnings[0]  # a crval that is given is not asked for
    assert "crval" not in one.warnings[0].lower()


def test_constant_and_linear_terms_that_are_asked_for_are_noted(tmp_path):
    rng = np.random.default_rng(3)
    matches, _ = simulate_wise(400, rng=rng)
    fit = bd.fit_linear(matches, bd.build_model(matches, order=3, size=(1016, 1016)))
    [_, one], _ = made(fit, tmp_path, linear="sip")
    assert any("stwcs and gwcs drop" in note for note in one.notes)
    assert not one.warnings  # the setting causes it
    [_, one], _ = made(fit, tmp_path, linear="cd")
    assert not any("stwcs" in text for text in (*one.notes, *one.warnings))


def test_axes_of_the_sky_are_not_linear(fit, tmp_path):
    with pytest.raises(InputError, match="leave out axes"):
        made(fit, tmp_path, axes="linear", crval=(1.0, 2.0))


def test_parameters_beside_a_header_have_the_covariance(fit, tmp_path):
    """Together they are the solution, alone the header has no errors; changed, an error."""
    chip = bd.Chip(1, "camera", (900.0, 700.0), (450.5, 350.5))
    model = bd.DistortionModel(3, (chip,), "arcsec")
    further = (FurtherError("structure", "local", 0.002, 0.001),)
    mean = 0.25 * fit.mean
    mean[[0, model.n_terms]] = 20.0, -10.0
    solution = GaussianSolution(model, mean, 0.0625 * fit.cov)
    calibration = Calibration("run", solution, Plane("sky", point=(30.0, 60.0)), further=further)
    files = build("sip", calibration, product_settings()["sip"](), BuildOptions())
    for one in files:
        (tmp_path / one.file_name).write_bytes(one.content)
    assert [one.file_name for one in files] == ["sip_parameters.fits", "sip.hdr"]
    found = read_calibration(tmp_path / "sip.hdr")
    np.testing.assert_array_equal(found.solution.cov, solution.cov)
    assert found.errors == "covariance" and found.further == further
    used = open_document(tmp_path / "sip.hdr").calibration(Choice(as_used=True))
    assert used.errors == "none"
    assert not any("AE and BE" in note for note in found.notes)
    text = (tmp_path / "sip.hdr").read_text()
    card = next(line for line in text.splitlines() if line.startswith("CD1_1"))
    value = float(card[10:].split("/")[0])
    (tmp_path / "sip.hdr").write_text(text.replace(card, f"CD1_1   = {value * (1 + 1e-5):.15E}"))
    with pytest.raises(InputError, match="one was changed"):
        read_calibration(tmp_path / "sip.hdr")
    (tmp_path / "sip.hdr").write_text(text)
    (tmp_path / "sip_parameters.fits").unlink()
    found = read_calibration(tmp_path / "sip.hdr")
    assert found.errors == "none" and "which is not here" in found.notes[-1]
    assert "its errors are not stated: AE and BE" in found.notes[0]


@pytest.mark.parametrize(("scale", "linear"), [(120.0, True), (1.0, False)])
def test_a_wide_plane_on_no_sky_is_not_written_as_tan(fit, tmp_path, scale, linear):
    """30 degrees of u, v in arcsec: ARC and TAN differ by r - atan r; a small field is TAN."""
    chip = bd.Chip(1, "camera", (900.0, 700.0), (450.5, 350.5))
    model = bd.DistortionModel(3, (chip,), "arcsec")
    mean = np.array(fit.mean)
    terms = np.arange(mean.size) % model.n_terms
    mean[terms == 0] = 0.0
    for axis, values in enumerate([(450.0, 0.0), (0.0, 350.0)]):
        mean[axis * model.n_terms + 1 : axis * model.n_terms + 3] = values
    solution = GaussianSolution(model, scale * mean, scale**2 * fit.cov)
    calibration = Calibration("run", solution, Plane())
    files = build("sip", calibration, product_settings()["sip"](), BuildOptions())
    for one in files:
        (tmp_path / one.file_name).write_bytes(one.content)
    path = tmp_path / files[-1].file_name
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        wcs = WCS(fits.Header.fromtextfile(path))
    assert wcs.has_celestial is not linear
    assert any("tangent plane is worth" in text for text in files[-1].warnings) is linear
    plain = sip_from_solution(calibration)  # as Python calls it
    assert plain.ctype[0].startswith("RA---TAN") is not linear
    if not linear:
        return
    x, y = np.random.default_rng(2).uniform(1, 700, (2, 50))
    expected = calibration.forward(x, y, chip=1)  # arcsec
    np.testing.assert_allclose(np.stack(wcs.all_pix2world(x, y, 1), axis=-1), expected, atol=1e-4)
    found = read_calibration(path)
    assert found.unit == "arcsec"
    np.testing.assert_allclose(found.forward(x, y, chip=1), expected, atol=1e-4)
    [back] = read_back("sip", files, calibration, BuildOptions())
    np.testing.assert_allclose(back.forward(x, y, 1, None), expected, atol=1e-4)
    product = product_settings()["sip"](axes="linear", crval=(1.0, 2.0))
    with pytest.raises(InputError, match="have one"):
        build("sip", calibration, product, BuildOptions())


WIDE = [(key, size) for key in ("tpv", "cpdis") for size in (120.0, 1.0)]


@pytest.mark.parametrize(("key", "scale"), WIDE)
@pytest.mark.parametrize("unit", ["arcsec", "pix"])
def test_formats_of_a_tangent_plane_refuse_wide_planes_on_no_sky(key, scale, unit, tmp_path):
    """ARC and TAN differ by r - atan r, r the distance from the point of contact."""
    chip = bd.Chip(1, "camera", (900.0, 700.0), (450.5, 350.5))
    model = bd.DistortionModel(2, (chip,), unit)
    factor = scale if unit == "arcsec" else 1.0
    theta = np.zeros(model.n_params)
    basis = model.basis()
    for axis, power in enumerate(((1, 0), (0, 1))):
        values = np.array([factor * (term == power) for term in basis.terms])
        theta[model.coefficient_slice(None, axis)] = basis.from_monomials(values)
    cov = 1e-8 * np.eye(model.n_params)
    calibration = Calibration("run", GaussianSolution(model, theta, cov), Plane())
    options = BuildOptions(scale_arcsec=scale)
    corner = np.radians(scale * np.hypot(449.5, 349.5) / 3600)
    worst = np.degrees(corner - np.arctan(corner)) * 3600 / scale
    plain, placed = product_settings()[key](), product_settings()[key](crval=(10.0, 20.0))
    if worst > 0.1:
        with pytest.raises(InputError, match=rf"differ by {worst:.2g} px") as caught:
            build(key, calibration, plain, options)
        assert f"products.{key}.crval" in str(caught.value)
    else:
        assert build(key, calibration, plain, options)
    for one in build(key, calibration, placed, options):
        (tmp_path / one.file_name).write_bytes(one.content)
    x, y = np.array([1.0, 900.0]), np.array([1.0, 350.5])
    u, v = (np.radians(scale * (a - c) / 3600) for a, c in ((x, 450.5), (y, 350.5)))
    header = tmp_path / ("tpv.head" if key == "tpv" else "cpdis.fits")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if key == "tpv":
            wcs = WCS(fits.Header.fromtextfile(header))
            ra, dec = wcs.all_pix2world(x, y, 1)
        else:
            with fits.open(header) as hdus:
                ra, dec = WCS(hdus[1].header, hdus).all_pix2world(x, y, 1)
    # positions of a tangent plane, in closed form
    dec0 = np.radians(20.0)
    expected_ra = 10.0 + np.degrees(np.arctan2(u, np.cos(dec0) - v * np.sin(dec0)))
    norm = np.sqrt(1 + u**2 + v**2)
    expected_dec = np.degrees(np.arcsin((np.sin(dec0) + v * np.cos(dec0)) / norm))
    np.testing.assert_allclose(ra, expected_ra % 360, atol=1e-7)
    np.testing.assert_allclose(dec, expected_dec, atol=1e-7)
