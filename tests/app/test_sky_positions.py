"""Pixels to the sky with the errors of a calibration: `apply --sky` and `Calibration.to_sky`."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import QTable, Table
from astropy.wcs import WCS

import bayesdist as bd
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import FurtherError, scaled
from bayesdist.calibration.plane import Plane
from bayesdist.calibration.sky_positions import sky_positions
from bayesdist.errors import InputError
from bayesdist.infer.solution.solution import GaussianSolution
from bayesdist.products.common.document import BuildOptions
from bayesdist.products.registry import build, product_settings, read_calibration

from .support import cli

POINT = (150.0, 40.0)
CHIPS = tuple(bd.Chip(n, f"chip {n}", (400.0, 300.0), (200.5, 150.5)) for n in (1, 2))


@pytest.fixture(scope="module")
def calibration():
    """Two chips of 0.26 arcsec to the pixel, a random covariance, and three further errors."""
    rng = np.random.default_rng(1)
    model = bd.DistortionModel(3, CHIPS, "arcsec")
    theta = 0.05 * rng.normal(size=model.n_params)
    for n, offset in ((1, 0.0), (2, 90.0)):
        for axis in (0, 1):
            start = model.coefficient_slice(n, axis).start
            theta[start] = offset * (1 - axis)
            theta[start + 1 + axis] = 0.26 * (200, 150)[axis] * (-1, 1)[axis]
    root = 0.003 * rng.normal(size=(model.n_params, model.n_params)) / np.sqrt(model.n_params)
    return Calibration(
        "camera",
        GaussianSolution(model, theta, root @ root.T),
        Plane("sky", point=POINT),
        further=(
            FurtherError(
                "unmodelled structure",
                "local",
                0.002,
                0.001,
                correlation=((0.25, 30.0), (0.5, 120.0)),
            ),
            FurtherError("catalogue", "systematic", 0.004, 0.003, "given by the user"),
            FurtherError("readout", "random", 0.0, 0.002),
        ),
    )


@pytest.fixture(scope="module")
def stars():
    rng = np.random.default_rng(2)
    n = 6
    return Table(
        {
            "x": rng.uniform(1, 400, n),
            "y": rng.uniform(1, 300, n),
            "chip": [1, 2, 1, 2, 2, 1],
            "sx": rng.uniform(0.005, 0.02, n),
            "sy": rng.uniform(0.005, 0.02, n),
        }
    )


def test_the_covariance_is_that_of_draws(calibration, stars):
    """Parameters, further errors and centroids drawn, and every star taken to the sky with them."""
    rng = np.random.default_rng(3)
    x, y, chip = (np.asarray(stars[c]) for c in ("x", "y", "chip"))
    sigma = np.stack([stars["sx"], stars["sy"]])
    at = sky_positions(calibration, x, y, chip, centroids=tuple(sigma), joint=True)
    n = 3000
    true = SkyCoord(np.tile(at.ra, n), np.tile(at.dec, n), unit="deg")
    theta = calibration.solution.draws(n, rng)
    p = np.stack([x, y])[:, None] + sigma[:, None] * rng.normal(size=(2, n, 6))
    uv = np.empty((2, n, 6))
    for number in (1, 2):
        mine = chip == number
        phi = calibration.model.basis(number).evaluate(*p[:, :, mine].reshape(2, -1))
        phi = phi.reshape(n, mine.sum(), -1)
        for axis in (0, 1):
            of_axis = theta[:, calibration.model.coefficient_slice(number, axis)]
            uv[axis, :, mine] = np.einsum("nsk,nk->sn", phi, of_axis)
    apart = np.sqrt(3) * np.hypot(x[:, None] - x, y[:, None] - y)
    near = sum(f * (1 + apart / l) * np.exp(-apart / l) for f, l in ((0.25, 30.0), (0.5, 120.0)))
    near = np.where(chip[:, None] == chip, near, 0.0) + 0.25 * np.eye(6)
    local = rng.normal(size=(2, n, 6)) @ np.linalg.cholesky(near).T
    uv[0] += 0.004 * rng.normal(size=(n, 1)) + 0.002 * local[0]
    uv[1] += 0.003 * rng.normal(size=(n, 1)) + 0.001 * local[1] + 0.002 * rng.normal(size=(n, 6))
    u, v = uv.reshape(2, -1)
    drawn_sky = SkyCoord(*_gnomonic().wcs_pix2world(u / 3600, v / 3600, 0), unit="deg")
    east, north = true.spherical_offsets_to(drawn_sky)
    drawn = np.cov(np.stack([east.mas, north.mas], axis=-1).reshape(n, -1).T)
    scale = np.sqrt(np.diag(at.joint))
    # of a correlation r the standard error is (1 - r^2) / sqrt(n); the largest of 78
    assert np.abs((drawn - at.joint) / np.outer(scale, scale)).max() < 4.5 * np.sqrt(2 / n)
    blocks = at.joint.reshape(6, 2, 6, 2)[np.arange(6), :, np.arange(6), :]
    np.testing.assert_allclose(blocks, at.cov, rtol=1e-9)


def _gnomonic():
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = "RA---TAN", "DEC--TAN"
    wcs.wcs.crval, wcs.wcs.crpix, wcs.wcs.cdelt = POINT, (1.0, 1.0), (1.0, 1.0)
    return wcs


def test_what_all_stars_share_drops_out_of_differences(calibration, stars):
    """Of two stars nearly at one pixel only the errors of each by itself are left.

    They are a quarter of the local error; the rest is shared by neighbours.
    """
    x, y = [100.0, 100.0 + 1e-6], [50.0, 50.0]
    at = sky_positions(calibration, x, y, 1, joint=True)
    difference = np.array([1.0, 0.0, -1.0, 0.0])
    alone = 2 * 0.25 * (1e3 * 0.002) ** 2
    assert difference @ at.joint @ difference == pytest.approx(alone, rel=1e-3)
    assert at.cov[0, 0, 0] > alone


@pytest.mark.parametrize("key", ["tpv", "cpdis"])
def test_a_file_and_what_it_was_made_from_say_the_same(calibration, stars, tmp_path, key):
    """Positions, errors, and the further ones, from the files as written."""
    for one in build(key, calibration, product_settings()[key]()):
        (tmp_path / one.file_name).write_bytes(one.content)
    first = {"tpv": "tpv.head", "cpdis": "cpdis.fits"}[key]
    again = read_calibration(tmp_path / first)
    assert again.further == calibration.further
    here = calibration.to_sky(stars, centroids=("sx", "sy"))
    there = bd.read_calibration(tmp_path / first).to_sky(stars, centroids=("sx", "sy"))
    for name in ("ra", "dec", "sigma_ra", "sigma_dec", "corr_ra_dec"):
        np.testing.assert_allclose(here[name], there[name], rtol=1e-9, err_msg=name)


def test_tables_of_all_kinds_are_taken(calibration, stars):
    expected = calibration.to_sky(stars)
    frame = pd.DataFrame({c: np.asarray(stars[c]) for c in stars.colnames})
    for one in (QTable(stars), frame, {c: np.asarray(stars[c]) for c in stars.colnames}):
        found = calibration.to_sky(one)
        assert (found["ra"] == expected["ra"]).all() and found["sigma_ra"].unit == units.mas
    zero = stars.copy()
    zero["x"] -= 1
    zero["y"] -= 1
    found = calibration.to_sky(zero, pixel_origin=0)
    np.testing.assert_allclose(found["ra"].value, expected["ra"].value, rtol=0, atol=1e-12)


def test_the_command_writes_what_python_gives(calibration, stars, tmp_path):
    for one in build("tpv", calibration, product_settings()["tpv"]()):
        (tmp_path / one.file_name).write_bytes(one.content)
    stars.write(tmp_path / "stars.csv")
    head, table, out = (str(tmp_path / n) for n in ("tpv.head", "stars.csv", "sky.fits"))
    done = cli("apply", head, table, "-o", out, "--sky", "--centroids", "sx", "sy", "--joint")
    assert done.code == 0, done.err
    for line in (
        "coefficients, with their covariance (correlated between stars)",
        "catalogue (the same for all stars)",
        "unmodelled structure (correlated between stars over 30 to 120 pixels)",
        "centroids (independent for each star)",
    ):
        assert line in done.out
    expected = calibration.to_sky(stars, centroids=("sx", "sy"), covariance=True)
    with fits.open(out) as file:
        np.testing.assert_allclose(
            file["COVARIANCE"].data, expected.meta["covariance"], rtol=1e-8, atol=1e-9
        )
        np.testing.assert_allclose(file[1].data["sigma_ra"], expected["sigma_ra"].value)
    done = cli("apply", head, table, "-o", str(tmp_path / "a.ecsv"), "--sky", "--joint")
    assert done.code == 1 and "name a .fits file" in done.err
    done = cli("apply", head, table, "-o", str(tmp_path / "a.ecsv"), "--joint")
    assert done.code == 2 and "--sky" in done.err


@pytest.mark.parametrize("options", [(), ("--sky",), ("--sky", "--joint")])
def test_units_unknown_to_astropy_stay_out_of_the_terminal(calibration, stars, tmp_path, options):
    for one in build("tpv", calibration, product_settings()["tpv"]()):
        (tmp_path / one.file_name).write_bytes(one.content)
    table = Table(stars, copy=True)
    table["counts"], table["brightness"] = 1.0, 12.0
    hdu = fits.BinTableHDU(table.as_array())
    for name, unit in (("counts", "ELECTRONS/foo"), ("brightness", "Mag")):
        hdu.header[f"TUNIT{table.colnames.index(name) + 1}"] = unit
    hdu.writeto(tmp_path / "stars.fits")
    head, path, out = (str(tmp_path / n) for n in ("tpv.head", "stars.fits", "out.fits"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        done = cli("apply", head, path, "-o", out, *options)
    assert done.code == 0, done.err
    assert [str(one.message) for one in caught] == [] and "Warning" not in done.err
    assert fits.getheader(out, 1)["TUNIT6"] == "ELECTRONS/foo"


@pytest.mark.parametrize("names", [("xcentroid", "ycentroid"), ("x_init", "y_init"), ("x", "y")])
def test_tables_of_photutils_count_from_zero_in_every_command(calibration, stars, tmp_path, names):
    """The positions of the same pixels as FITS counts them, by Python and both forms of apply."""
    for one in build("tpv", calibration, product_settings()["tpv"]()):
        (tmp_path / one.file_name).write_bytes(one.content)
    stars.write(tmp_path / "stars.csv")
    from_zero = stars["chip",]
    for name, key in zip(names, "xy", strict=True):
        from_zero[name] = stars[key] - 1.0
    if names == ("x", "y"):  # a name that says nothing, beside columns of sep
        from_zero["tnpix"] = from_zero["xcpeak"] = 1
    from_zero.write(tmp_path / "zero.csv")
    expected = calibration.to_sky(stars)
    sky = calibration.to_sky(from_zero, columns=names)
    assert sky.meta["pixel_origin"] == 0 and expected.meta["pixel_origin"] == 1
    np.testing.assert_allclose(sky["ra"].value, expected["ra"].value, rtol=1e-13)
    if names[0] in ("xcentroid", "x"):  # names that tables of matches are known by
        usual = calibration.to_sky(from_zero)
        np.testing.assert_array_equal(usual["ra"].value, sky["ra"].value)
    given = calibration.to_sky(from_zero, columns=names, pixel_origin=1)
    assert np.abs(given["dec"] - expected["dec"]).max() > 0.1 * units.arcsec
    head = str(tmp_path / "tpv.head")
    for options, added in ((("--sky",), "dec"), ((), "y_out")):
        results = []
        for table, columns in (("stars.csv", ("x", "y")), ("zero.csv", names)):
            out = str(tmp_path / "out.ecsv")
            done = cli("apply", head, str(tmp_path / table), "-o", out, "--force", *options,
                       "--columns", *columns)  # fmt: skip
            assert done.code == 0, done.err
            origin = "1: as in FITS" if table == "stars.csv" else "0: "
            assert f"the first pixel is {origin}" in done.out
            results.append(Table.read(out)[added])
        np.testing.assert_allclose(*results, rtol=1e-10)


def test_planes_that_are_not_on_the_sky_are_refused(calibration, stars):
    for plane, message in (
        (Plane("free"), "tangent point of its plane"),
        (Plane("aperture", v2v3=(0.0, 0.0)), "V2, V3"),
    ):
        with pytest.raises(InputError, match=message):
            replace(calibration, plane=plane).to_sky(stars)
    free = replace(calibration, plane=Plane("free"))
    found = free.to_sky(stars, point=POINT)
    expected = calibration.to_sky(stars)
    assert (found["dec"] == expected["dec"]).all()


@pytest.mark.parametrize(
    ("to", "name", "unit", "limit_mas"),
    [("tpv", "tpv.head", "pix", 1e-3), ("tpv", "tpv.head", "arcsec", 1e-3),
     ("cpdis", "cpdis.fits", "pix", 0.1)],
)  # fmt: skip
def test_a_header_of_a_given_crval_is_applied_where_others_have_it(
    calibration, stars, tmp_path, to, name, unit, limit_mas
):
    """Of u, v with no sky: astropy.wcs has the positions, and (0, 0) on the plane the CRVAL."""
    pixel = 0.26 if unit == "pix" else 1.0
    model = replace(calibration.model, unit=unit)
    mean, cov = calibration.solution.mean / pixel, calibration.solution.cov / pixel**2
    free = replace(
        calibration, solution=GaussianSolution(model, mean, cov), plane=Plane("free"),
        further=scaled(calibration.further, 1 / pixel),
    )  # fmt: skip
    if to == "cpdis":
        free = free.only(1)
    settings = product_settings()[to](crval=POINT)
    for one in build(to, free, settings, BuildOptions(None, 0.26 if unit == "pix" else None)):
        (tmp_path / one.file_name).write_bytes(one.content)
    mine = stars[stars["chip"] == 1]
    expected = calibration.to_sky(mine, covariance=True)
    found = bd.read_calibration(tmp_path / name).to_sky(mine, covariance=True)
    at = SkyCoord(found["ra"], found["dec"])
    assert at.separation(SkyCoord(expected["ra"], expected["dec"])).mas.max() < limit_mas
    np.testing.assert_allclose(found.meta["covariance"], expected.meta["covariance"], rtol=1e-6)
    if to == "tpv":
        text = (tmp_path / name).read_text().split("\nEND")[0]
        wcs = WCS(fits.Header.fromstring(text, sep="\n"))
    else:
        with fits.open(tmp_path / name) as file:
            header = file[1].header.copy()
            del header["NAXIS"]  # an image without data
            wcs = WCS(header, file)
    theirs = wcs.pixel_to_world(mine["x"] - 1, mine["y"] - 1)
    assert at.separation(theirs).mas.max() < limit_mas


@pytest.mark.parametrize("to", ["tpv", "cpdis"])
@pytest.mark.parametrize(
    ("plane", "unit", "crval", "message"),
    [(Plane("sky", point=POINT), "arcsec", POINT, "omit it"),
     (Plane(), "arcsec", (150.0, 91.0), "not a right ascension and declination"),
     (Plane(), "pix", POINT, "pixels of unknown size")],
    ids=["two points", "no position", "no scale"],
)  # fmt: skip
def test_a_crval_that_cannot_be_is_refused(calibration, to, plane, unit, crval, message):
    model = replace(calibration.model, unit=unit)
    solution = replace(calibration.solution, model=model)
    with pytest.raises(InputError, match=message):
        build(
            to,
            replace(calibration, solution=solution, plane=plane),
            product_settings()[to](crval=crval),
        )


@pytest.mark.parametrize("unit", [units.arcsec, units.mm, units.deg])
def test_positions_that_are_no_pixels_are_refused(calibration, unit):
    rows = QTable({"x": [1.0] * units.pix, "y": [2.0] * unit, "chip": [1]})
    with pytest.raises(InputError, match=f"column 'y': unit is {unit}, but .* are in pix; name"):
        calibration.to_sky(rows)
    rows["y"] = [2.0] * units.pix
    assert np.isfinite(calibration.to_sky(rows)["ra"][0])
