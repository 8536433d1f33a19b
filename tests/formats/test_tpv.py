"""TPV headers: written, read back, read by others, and what is wrong in those of others."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import astropy.wcs
import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose

from bayesdist.calibration.calibration import calibration_of
from bayesdist.errors import FormatError, InputError
from bayesdist.formats.tpv import tpv_of
from bayesdist.model import Chip, DistortionModel, TimeDependence
from bayesdist.products import registry
from bayesdist.products.common.content import read_content
from bayesdist.products.common.document import BuildOptions
from tests.app.support import good

from .skies import PROGRAMS, apart_mas, sky_by, sky_of
from .support import (
    PIXEL,
    POINT,
    StandIn,
    build_into,
    on_sky,
    random_pixels,
    some_covariance,
    some_solution,
)

# SCAMP's head of a mosaic: two chips of one exposure, CRPIX far off the chips, order 3
_SCAMP = """\
HISTORY   Astrometric solution by SCAMP version 2.10.0
COMMENT   (c) 2010-2020 IAP/CNRS/CFHT/SorbonneU
COMMENT
EQUINOX =        2000.00000000 / Mean equinox
RADESYS = 'ICRS    '           / Astrometric system
CTYPE1  = 'RA---TPV'           / WCS projection type for this axis
CTYPE2  = 'DEC--TPV'           / WCS projection type for this axis
CUNIT1  = 'deg     '           / Axis unit
CUNIT2  = 'deg     '           / Axis unit
CRVAL1  =   2.151350000000E+02 / World coordinate on this axis
CRVAL2  =   5.299200000000E+01 / World coordinate on this axis
CRPIX1  = {crpix1:20.12E} / Reference pixel on this axis
CRPIX2  =   4.320500000000E+03 / Reference pixel on this axis
CD1_1   =   1.100000000000E-07 / Linear projection matrix
CD1_2   =   7.285000000000E-05 / Linear projection matrix
CD2_1   =  -7.286000000000E-05 / Linear projection matrix
CD2_2   =   1.300000000000E-07 / Linear projection matrix
PV1_0   =   1.200000000000E-04 / Projection distortion parameter
PV1_1   =   1.000300000000E+00 / Projection distortion parameter
PV1_2   =  -2.100000000000E-04 / Projection distortion parameter
PV1_4   =   4.400000000000E-04 / Projection distortion parameter
PV1_5   =  -1.500000000000E-04 / Projection distortion parameter
PV1_6   =   2.300000000000E-04 / Projection distortion parameter
PV1_7   =   1.800000000000E-03 / Projection distortion parameter
PV1_8   =   1.100000000000E-04 / Projection distortion parameter
PV1_9   =   1.700000000000E-03 / Projection distortion parameter
PV1_10  =  -3.000000000000E-05 / Projection distortion parameter
PV2_0   =  -2.500000000000E-04 / Projection distortion parameter
PV2_1   =   1.000100000000E+00 / Projection distortion parameter
PV2_2   =   1.900000000000E-04 / Projection distortion parameter
PV2_4   =  -3.100000000000E-04 / Projection distortion parameter
PV2_5   =   2.700000000000E-04 / Projection distortion parameter
PV2_6   =  -1.300000000000E-04 / Projection distortion parameter
PV2_7   =   1.900000000000E-03 / Projection distortion parameter
PV2_8   =  -7.000000000000E-05 / Projection distortion parameter
PV2_9   =   1.600000000000E-03 / Projection distortion parameter
PV2_10  =   2.000000000000E-05 / Projection distortion parameter
FGROUPNO=                    1 / SCAMP field group label
ASTIRMS1=   0.000000000000E+00 / Astrom. dispersion RMS (intern., high S/N)
MAGZEROP=   0.000000000000E+00 / Magnitude zero-point (mag)
END     
"""
SCAMP_SIZE = (2048.0, 4096.0)


def scamp_head() -> str:
    return _SCAMP.format(crpix1=-1066.5) + _SCAMP.format(crpix1=1087.25)


write = partial(build_into, "tpv")


def header_of(path: Path) -> fits.Header:
    [head] = tpv_of(read_content(path)).heads
    return head.header


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("order", [1, 3, 7])
def test_programs_have_the_sky_of_the_calibration(tmp_path, program, order):
    """A pixel of 260 mas: 1e-6 of it are 2.6e-4 mas."""
    found = on_sky(order, (PIXEL, ""))
    x, y = random_pixels((1200.0, 900.0), 2000)
    theirs = sky_by(program, header_of(write(tmp_path, found)), x, y)
    assert apart_mas(sky_of(found, x, y), theirs) < 2.6e-4


@pytest.mark.parametrize("order", [1, 4, 7])
def test_what_is_read_back_is_the_calibration_with_its_covariance(tmp_path, order):
    found = on_sky(order, (PIXEL, ""))
    back = registry.read_calibration(write(tmp_path, found))
    assert back.errors == "covariance" and back.unit == "arcsec"
    assert (back.plane.kind, back.plane.point) == ("sky", POINT)
    assert_allclose(back.solution.mean, found.solution.mean, rtol=0, atol=0)
    assert_allclose(back.solution.cov, found.solution.cov, rtol=0, atol=0)
    assert back.model.chips == tuple(replace(c, name="1") for c in found.model.chips)
    assert back.scale == 0.26


def test_the_header_alone_has_the_positions(tmp_path):
    """Without the file beside it; its own numbers, to rounding."""
    found = on_sky(7, (PIXEL, ""))
    path = write(tmp_path, found)
    (tmp_path / "tpv_parameters.fits").unlink()
    back = registry.read_calibration(path)
    x, y = random_pixels((1200.0, 900.0))
    assert back.errors == "none" and "is not here" in back.notes[0]
    far = back.forward(x, y, chip=1) - found.forward(x, y, chip=1)
    assert np.abs(far).max() / 0.26 < 1e-9


def test_crder_is_the_rms_error_over_the_detector(tmp_path):
    found = on_sky(3, (PIXEL, ""))
    header = header_of(write(tmp_path, found))
    x, y = random_pixels((1200.0, 900.0), 100_000)
    cov = found.chip(origin="stated").covariance_at(x, y)
    rms = np.sqrt(cov.mean(axis=0).diagonal()) / 3600
    assert_allclose([header["CRDER1"], header["CRDER2"]], rms, rtol=0.05)


def test_chips_pixels_and_a_date_are_kept(tmp_path):
    """Two chips in pixels that drift: the state at the date, with covariances between the chips."""
    chips = (Chip(2, "A", (400.0, 300.0), (200.5, 150.5)), Chip(5, "B", (400.0, 300.0), (1.0, 1.0)))
    model = DistortionModel(3, chips, "pix", TimeDependence((("u", 1, 0),), (2010.0,)))
    rng = np.random.default_rng(3)
    theta = 0.1 * rng.normal(size=model.n_params)
    for chip in (2, 5):
        for axis in (0, 1):
            theta[model.coefficient_slice(chip, axis)][1 + axis] = (200.0, 150.0)[axis]
    solution = StandIn(model, theta, some_covariance(theta.size, 1e-3, rng))
    found = calibration_of(solution, "made up")
    path = write(tmp_path, found, BuildOptions(epoch=2014.0, scale_arcsec=0.05))
    back = registry.read_calibration(path)
    assert back.numbers == (2, 5) and back.unit == "pix" and back.plane.kind == "free"
    x, y = random_pixels((400.0, 300.0), 500)
    for chip in (2, 5):
        now = found.forward(x, y, chip=chip, epoch=2014.0)
        assert_allclose(back.forward(x, y, chip=chip), now, atol=1e-9)
        assert np.abs(now - found.forward(x, y, chip=chip, epoch=2010.0)).max() > 0.1
    joint = found.joint_covariance((2, 5), 2014.0, origin="stated")
    assert_allclose(back.joint_covariance((2, 5), origin="stated"), joint, atol=1e-18)
    assert np.abs(joint[:20, 20:]).max() > 0
    # the header by itself has them in arcseconds of 0.05 to the pixel
    (tmp_path / "tpv_parameters.fits").unlink()
    alone = registry.read_calibration(path)
    assert alone.unit == "pix"
    assert_allclose(alone.forward(x, y, chip=5), now, atol=1e-8)


def test_scamp_heads_of_a_mosaic(tmp_path):
    path = tmp_path / "exposure.head"
    path.write_text(scamp_head())
    with pytest.raises(InputError, match="does not state the size of the image"):
        registry.read_calibration(path)
    found = registry.read_calibration(path, size=SCAMP_SIZE)
    assert found.numbers == (1, 2) and found.errors == "none" and found.model.order == 3
    assert found.plane.point == (215.135, 52.992)
    x, y = random_pixels(SCAMP_SIZE, 2000)
    for head in tpv_of(read_content(path)).heads:
        theirs = sky_by("astropy.wcs", head.header, x, y)
        assert apart_mas(sky_of(found, x, y, head.number), theirs) < 2.6e-4
    assert not [f for f in registry.lint(path) if f.level != "note"]
    text = registry.describe(path)
    assert "2 chips, TPV of order 3" in text and "chip 2" in text


@pytest.mark.parametrize("program", ["astropy.wcs", "starlink-pyast"])
def test_powers_of_r_are_followed_and_a_note_says_how_well(tmp_path, program):
    """GalSim refuses them."""
    text = _SCAMP.format(crpix1=-1066.5).replace(
        "FGROUPNO", "PV1_11  =  3.0E-03\nPV2_11  =  2.9E-03\nPV1_23  = -2.0E-03\nFGROUPNO"
    )
    path = tmp_path / "radial.head"
    path.write_text(text)
    found = registry.read_calibration(path, size=SCAMP_SIZE)
    [note] = found.notes
    said = float(note.split(" pix off")[0].split()[-1])
    x, y = random_pixels(SCAMP_SIZE, 4000)
    theirs = sky_by(program, tpv_of(read_content(path)).heads[0].header, x, y)
    off = apart_mas(sky_of(found, x, y), theirs) / (3.6e6 * 7.285e-5)
    assert 0 < said < 0.01 and off < 1.5 * said
    assert "powers of r" in str(registry.lint(path))


def test_fits_headers_and_old_scamp_headers_are_read(tmp_path):
    text = _SCAMP.format(crpix1=-1066.5)
    header = fits.Header.fromstring(text.split("END  ")[0], sep="\n")
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(np.zeros((64, 32), np.int16), header)]).writeto(
        tmp_path / "image.fits"
    )
    image = registry.read_calibration(tmp_path / "image.fits")
    assert image.model.chips[0].size == (32.0, 64.0)
    old = tmp_path / "old.head"
    old.write_text(text.replace("TPV'", "TAN'"))
    same = registry.read_calibration(old, size=(32.0, 64.0))
    assert_allclose(same.solution.mean, image.solution.mean)
    assert "as SCAMP used to write" in str(registry.lint(old))


def test_a_real_header_is_read_as_astropy_reads_it():
    """One of a mosaic, among the tests of astropy; CRPIX is twice its width off the chip."""
    path = Path(astropy.wcs.__file__).parent / "tests" / "data" / "tpvonly.hdr"
    found = registry.read_calibration(path)
    assert found.model.order == 4 and found.model.chips[0].size == (2048.0, 4096.0)
    [head] = tpv_of(read_content(path)).heads
    x, y = random_pixels(found.model.chips[0].size, 2000)
    assert apart_mas(sky_of(found, x, y), sky_by("astropy.wcs", head.header, x, y)) < 1e-3
    assert not registry.lint(path)


FAULTS = {
    "missing PV1_1": (lambda t: _without(t, "PV1_1 "), "PV1_1", "missing"),
    "missing PV2_1": (lambda t: _without(t, "PV2_1 "), "PV2_1", "missing"),
    "parity": (lambda t: t.replace("PV1_1   =   1.", "PV1_1   =  -1."), "PV1_1", "parity"),
    "X before Y on axis 2": (
        lambda t: t.replace("PV2_1 ", "PV2_x ").replace("PV2_2 ", "PV2_1 ").replace(
            "PV2_x ", "PV2_2 "),
        "PV2_2", "order of the coefficients"),
    "CD in arcsec": (
        lambda t: t.replace("7.285000000000E-05", "0.262260").replace("7.286000000000E-05",
                                                                      "0.262296"),
        "CD", "its unit is the degree"),
    "PV in arcsec": (
        lambda t: t.replace("PV1_7   =   1.800000000000E-03", "PV1_7   =   2.332800000000E+04"),
        "PV", "powers of degrees"),
    "a copied value": (
        lambda t: t.replace("PV1_9   =   1.700000000000E-03", "PV1_9   =   1.800000000000E-03"),
        "PV1_7, PV1_9", "copy"),
    "axes": (lambda t: t.replace("'DEC--TPV'", "'DEC--TAN'"), "CTYPE1", "only one"),
}  # fmt: skip


def _without(text: str, keyword: str) -> str:
    return "".join(line for line in text.splitlines(True) if not line.startswith(keyword))


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_faults_are_found(tmp_path, fault):
    change, where, message = FAULTS[fault]
    right = _SCAMP.format(crpix1=-1066.5)
    path = tmp_path / "wrong.head"
    path.write_text(change(right))
    assert path.read_text() != right
    found = [f for f in registry.lint(path) if f.where == where and message in f.message]
    assert len(found) == 1 and found[0].level in ("error", "warning")
    path.write_text(right)
    assert not [f for f in registry.lint(path) if f.where == where and message in f.message]


def test_without_pv1_1_programs_differ_and_the_header_is_refused(tmp_path):
    path = tmp_path / "gone.head"
    path.write_text(_without(_SCAMP.format(crpix1=-1066.5), "PV1_1 "))
    with pytest.raises(FormatError, match="PV1_1, which some programs take for 0"):
        registry.read_calibration(path, size=SCAMP_SIZE)
    header = tpv_of(read_content(path)).heads[0].header
    x, y = random_pixels(SCAMP_SIZE, 10)
    a, b = (sky_by(p, header, x, y) for p in ("astropy.wcs", "starlink-pyast"))
    assert apart_mas(a, b) > 1e5  # minutes of arc, as large as the chip


def test_bad_headers_get_a_sentence(tmp_path):
    path = tmp_path / "bad.head"
    right = _SCAMP.format(crpix1=-1066.5)
    for change, message in (
        (lambda t: t.replace("PV1_7 ", "PV1_40"), "above 7, which TPV cannot represent"),
        (lambda t: t.replace("PV1_7   =   1.800000000000E-03", "PV1_7   = 'x'"), "not a finite"),
        (lambda t: _without(t, "CRVAL1"), "CRVAL1: is missing"),
        (lambda t: t + t.replace("2.151350000000E+02", "2.161350000000E+02"), "different points"),
        (lambda t: t.replace("FGROUPNO", "CCDNUM  = 3\nFGROUPNO") * 2, "several headers of chip 3"),
    ):
        path.write_text(change(right))
        with pytest.raises((FormatError, InputError), match=message):
            registry.read_calibration(path, size=SCAMP_SIZE)


def test_a_changed_header_does_not_take_the_errors_beside_it(tmp_path):
    path = write(tmp_path, on_sky(3, (PIXEL, "")))
    text = path.read_text()
    value = header_of(path)["PV1_4"]
    path.write_text(text.replace(repr(value), repr(value * 1.01)))
    with pytest.raises(FormatError, match="one was changed"):
        registry.read_calibration(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda c: calibration_of(some_solution(8, unit="arcsec", pixel=0.26)),
            "limited to order 7",
        ),
        (lambda c: c, "omit it"),
    ],
    ids=["order 8", "two points"],
)
def test_what_tpv_cannot_hold_is_refused(tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        write(tmp_path, change(on_sky(3, (PIXEL, ""))), crval=(10.0, 10.0))


def test_commands_take_heads(tmp_path):
    path = write(tmp_path, on_sky(4, (PIXEL, "")))
    assert "covariance in tpv_parameters.fits" in good("inspect", path).out
    (tmp_path / "stars.csv").write_text("x,y\n600,400\n10,890\n")
    good("apply", path, tmp_path / "stars.csv", "-o", tmp_path / "out.csv")
    lines = (tmp_path / "out.csv").read_text().splitlines()
    assert "sigma_x_out" in lines[0] and len(lines) == 3
    assert good("compare", path, path).out
    assert good("inspect", tmp_path / "tpv_parameters.fits").out.count("covariance") == 1
    scamp = tmp_path / "scamp.head"
    scamp.write_text(scamp_head())
    assert good("inspect", scamp).out.count("Findings") == 3
    (tmp_path / "stars.csv").write_text("x,y,chip\n600,400,1\n10,890,2\n")
    size = ("--size", 2048, 4096)
    good("apply", scamp, tmp_path / "stars.csv", "-o", tmp_path / "two.csv", *size)
    assert len((tmp_path / "two.csv").read_text().splitlines()) == 3
