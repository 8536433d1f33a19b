"""Look-up tables by CPDIS and DP records: written, read back, used by astropy.wcs, and faults."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import astropy.wcs
import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from numpy.testing import assert_allclose

from bayesdist.calibration.calibration import calibration_of
from bayesdist.errors import FormatError, InputError
from bayesdist.model import LookupTable
from bayesdist.products import registry
from bayesdist.products.common.document import BuildOptions
from tests.app.support import good

from .skies import apart_mas, sky_of
from .support import PIXEL, POINT, build_into, on_sky, random_pixels, some_solution

SIZE = (1200.0, 900.0)
write = partial(build_into, "cpdis")


def sky_by_astropy(path: Path, x: np.ndarray, y: np.ndarray, key: str = " ") -> np.ndarray:
    with fits.open(path) as hdus, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return np.asarray(WCS(hdus["SCI"].header, hdus, key=key).all_pix2world(x, y, 1))


def a_table(chip: int = 1, size: float = 0.2) -> LookupTable:
    values = np.random.default_rng(2).normal(0, size, (2, 16, 20)).astype(np.float32)
    return LookupTable(chip, values, first=(20.5, 10.5), step=(61.0, 58.5))


def test_astropy_has_the_tables_of_the_file_as_we_have(tmp_path):
    """A linear part and one table: the same to 1e-6 of a pixel; astropy keeps single precision."""
    found = replace(on_sky(1), before=(a_table(),))
    path = write(tmp_path, found)
    back = registry.read_calibration(path)
    x, y = random_pixels(SIZE, 4000)
    assert_allclose(back.forward(x, y, chip=1), found.forward(x, y, chip=1), atol=1e-6 * PIXEL)
    assert_allclose(back.solution.cov, found.solution.cov, rtol=0, atol=0)
    assert apart_mas(sky_of(back, x, y), sky_by_astropy(path, x, y)) < 1e-6 * PIXEL * 1e3
    assert np.hypot(*(back.forward(x, y, chip=1) - on_sky(1).forward(x, y, chip=1)).T).max() > 0.05


@pytest.mark.parametrize("step", [None, 64.0, 16.0])
def test_between_nodes_it_is_as_far_off_as_it_says(tmp_path, step):
    """Bilinear tables of an order-4 polynomial: sixteen times better for steps of a quarter."""
    found = on_sky(4)
    path = write(tmp_path, found, step=step)
    stated = float(fits.getheader(path, "SCI")["BDWORST"])
    x, y = random_pixels(SIZE, 20_000)
    off = apart_mas(sky_of(found, x, y), sky_by_astropy(path, x, y)) / (1e3 * PIXEL)
    assert 0.3 * stated < off < 1.1 * stated
    coarse = float(fits.getheader(write(tmp_path, found, step=64.0), "SCI")["BDWORST"])
    if step == 16.0:
        assert 12 < coarse / stated < 20


def test_what_is_read_back_is_the_calibration_with_its_covariance(tmp_path):
    found = on_sky(4)
    path = write(tmp_path, found, step=32.0)
    back = registry.read_calibration(path)
    assert back.errors == "covariance" and (back.plane.kind, back.plane.point) == ("sky", POINT)
    assert_allclose(back.solution.mean, found.solution.mean, rtol=0, atol=0)
    assert_allclose(back.solution.cov, found.solution.cov, rtol=0, atol=0)
    assert not registry.lint(path)


def test_a_polynomial_with_tables_keeps_its_covariance(tmp_path):
    """At the nodes of the file exactly; the rest is said."""
    found = replace(on_sky(3), before=(a_table(),))
    path = write(tmp_path, found, step=4.0)
    back = registry.read_calibration(path)
    stated = float(fits.getheader(path, "SCI")["BDWORST"])
    x, y = random_pixels(SIZE, 4000)
    off = np.hypot(*(back.forward(x, y, chip=1) - found.forward(x, y, chip=1)).T).max() / PIXEL
    assert off < 1.3 * stated
    assert_allclose(back.solution.cov, found.solution.cov, rtol=0, atol=0)


def test_errors_of_nodes_are_those_of_the_covariance(tmp_path):
    found = on_sky(3)
    path = write(tmp_path, found, step=64.0)
    with fits.open(path) as hdus:
        sigma = [hdus["WCSDVERR", k].data[3, 5] for k in (1, 2)]
        table = hdus["WCSDVARR", 1].header
        at = [table[f"CRVAL{a}"] + n * table[f"CDELT{a}"] for a, n in ((1, 5), (2, 3))]
    one = found.chip(origin="stated")
    back = np.linalg.inv(one.linear)
    cov = back @ one.covariance_at(*(np.array([v]) for v in at))[0] @ back.T
    assert_allclose(sigma, np.sqrt(cov.diagonal()), rtol=1e-6)


def test_chips_in_pixels_are_kept(tmp_path):
    found = calibration_of(some_solution(3), "made up")
    back = registry.read_calibration(
        write(tmp_path, found, BuildOptions(scale_arcsec=0.13), step=32.0)
    )
    assert back.unit == "pix" and back.plane.kind == "free" and back.numbers == (1,)
    assert_allclose(back.solution.mean, found.solution.mean, rtol=0, atol=0)


def of_others(folder: Path) -> Path:
    """A file as PUNCH has it: records alone, helioprojective, a second system on the sky."""
    y, x = np.indices((11, 13), float)
    planes = (0.4 * (x - 6) / 6 + 0.05 * y, 0.3 * (y - 5) / 5 * x / 12)
    header = fits.Header()
    for keyword, value in {
        "CTYPE1": "HPLN-ARC", "CTYPE2": "HPLT-ARC", "CUNIT1": "deg", "CUNIT2": "deg",
        "CRPIX1": 150.5, "CRPIX2": 125.5, "CDELT1": 0.0225, "CDELT2": 0.0225, "CRVAL1": 1.0,
        "CRVAL2": 2.0, "PC1_1": 0.9962, "PC1_2": -0.0872, "PC2_1": 0.0872, "PC2_2": 0.9962,
        "CTYPE1A": "RA---ARC", "CTYPE2A": "DEC--ARC", "CRPIX1A": 150.5, "CRPIX2A": 125.5,
        "CDELT1A": -0.0225, "CDELT2A": 0.0225, "CRVAL1A": 30.0, "CRVAL2A": 12.0,
    }.items():  # fmt: skip
        header[keyword] = value
    for axis in (1, 2):
        header[f"CPDIS{axis}"] = "LOOKUP"
        for record in (f"EXTVER: {axis}.0", "NAXES: 2.0", "AXIS.1: 1.0", "AXIS.2: 2.0"):
            card = fits.Card.fromstring(f"DP{axis:<6}= '{record}'".ljust(80))
            header.append(card, end=True)
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(np.zeros((250, 300), np.int16), header, name="SCI")]
    for version, plane in enumerate(planes, start=1):
        table = fits.ImageHDU(plane.astype(np.float32), name="WCSDVARR", ver=version)
        for axis in (1, 2):
            table.header[f"CRPIX{axis}"] = 1.0
            table.header[f"CRVAL{axis}"] = 0.5
            table.header[f"CDELT{axis}"] = 25.0
        hdus.append(table)
    path = folder / "punch.fits"
    fits.HDUList(hdus).writeto(path)
    return path


def test_files_of_others_are_read_as_astropy_reads_them(tmp_path):
    path = of_others(tmp_path)
    found = registry.read_calibration(path)
    assert found.errors == "none" and found.plane.kind == "free" and found.unit == "arcsec"
    x, y = random_pixels((300.0, 250.0), 2000)
    with fits.open(path) as hdus, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        wcs = WCS(hdus["SCI"].header, hdus)
        focal = wcs.pix2foc(np.column_stack([x, y]), 1)
        at = (wcs.pixel_scale_matrix @ (focal - [150.5, 125.5]).T).T
    theirs = 3600 * at
    assert np.abs(found.forward(x, y, chip=1) - theirs).max() / 81 < 1e-6
    text = registry.describe(path)
    assert "13 x 11 nodes" in text and "CPDIS1A" in text
    assert not [f for f in registry.lint(path) if f.level == "error"]


def test_the_second_system_is_what_the_finding_says(tmp_path):
    """With the tables in astropy that shares them; without them where it keeps to the standard."""
    path = of_others(tmp_path)
    x, y = random_pixels((300.0, 250.0), 200)
    theirs = sky_by_astropy(path, x, y, key="A")
    with fits.open(path) as hdus, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        header = hdus["SCI"].header.copy()
        shifted = WCS(header, hdus).pix2foc(np.column_stack([x, y]), 1)
        for keyword in [k for k in header if k.startswith(("CPDIS", "DP"))]:
            del header[keyword]
        plain = WCS(header, key="A")
        with_tables = np.asarray(plain.wcs_pix2world(*shifted.T, 1))
        without = np.asarray(plain.wcs_pix2world(x, y, 1))
    assert min(apart_mas(theirs, with_tables), apart_mas(theirs, without)) < 1e-3
    [finding] = [f for f in registry.lint(path) if f.where == "CPDIS1A"]
    assert finding.level == "warning"


def test_tables_beside_sip_are_noted():
    """An image of ACS, which astropy has among its own tests: SIP with D2IM and CPDIS tables."""
    path = Path(astropy.wcs.__file__).parent / "tests" / "data" / "dist_lookup.fits.gz"
    assert registry.open_document(path).format.key == "sip"
    [note] = registry.read_calibration(path).notes
    assert note.startswith("without the look-up tables") and "CPDIS1, CPDIS2" in note


def _records(header, axis, field, value):
    header[f"DP{axis}.{field}"] = value


def _shifted(hdus, by):
    for k in (1, 2):
        hdus["WCSDVARR", k].header["CRVAL1"] += by


def _in_degrees(hdus):
    for k in (1, 2):
        hdus["WCSDVARR", k].data = hdus["WCSDVARR", k].data * np.float32(0.26 / 3600)


def _no_registration(hdus):
    for k in (1, 2):
        for name in ("CRPIX1", "CRPIX2", "CRVAL1", "CRVAL2"):
            del hdus["WCSDVARR", k].header[name]


FAULTS = {
    "missing extension": (lambda h: h.pop(2), "DP1.EXTVER", "no extension WCSDVARR,1"),
    "axes exchanged": (
        lambda h: (_records(h["SCI"].header, 1, "AXIS.1", 2.0),
                   _records(h["SCI"].header, 1, "AXIS.2", 1.0)), "DP1.AXIS", "transposes"),
    "one table for both": (
        lambda h: _records(h["SCI"].header, 2, "EXTVER", 1.0), "DP2.EXTVER", "one extension"),
    "error below zero": (
        lambda h: h["SCI"].header.__setitem__("CPERR1", -0.1), "CPERR1", "leaves the table out"),
    "polynomial": (
        lambda h: h["SCI"].header.__setitem__("CPDIS1", "POLYNOMIAL"), "CPDIS1", "leaves it out"),
    "a node off": (lambda h: _shifted(h, 25.0), "WCSDVARR,1", "a node off"),
    "no registration": (_no_registration, "WCSDVARR,1", "version 6.1"),
    "degrees": (_in_degrees, "WCSDVARR", "unit is the pixel"),
    "parity": (
        lambda h: h["SCI"].header.__setitem__("CDELT1", -0.0225), "CD", "parity of a mirror"),
    "parity of the sky": (
        lambda h: h["SCI"].header.update(CTYPE1="RA---TAN", CTYPE2="DEC--TAN"),
        "CD", "parity of a mirror"),
    "not finite": (
        lambda h: h["WCSDVARR", 2].data.__setitem__((0, 0), np.nan), "WCSDVARR,2", "not finite"),
    "one axis": (
        lambda h: h["SCI"].header.remove("CPDIS2"), "CPDIS2", "that axis has no distortion"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_faults_are_found(tmp_path, fault):
    change, where, message = FAULTS[fault]
    right = of_others(tmp_path)
    wrong = tmp_path / "wrong.fits"
    with fits.open(right) as hdus:
        change(hdus)
        hdus.writeto(wrong)
    assert not [f for f in registry.lint(right) if f.where == where]
    found = [f for f in registry.lint(wrong) if f.where == where and message in f.message]
    assert len(found) == 1 and registry.describe(wrong)


def test_a_header_without_a_sky_is_not_wider_than_it(tmp_path):
    """One unit per pixel and no CTYPE: tables on pixels, which are no 300 degrees of the sky."""
    path = tmp_path / "plane.fits"
    with fits.open(of_others(tmp_path)) as hdus:
        header = hdus["SCI"].header
        for keyword in [key for key in header if key[:5] in ("CTYPE", "CUNIT") or key[-1] == "A"]:
            del header[keyword]
        header.update(CDELT1=1.0, CDELT2=1.0, CRVAL1=0.0, CRVAL2=0.0)
        hdus.writeto(path)
    findings = registry.lint(path)
    assert not [f for f in findings if f.level == "error"], findings
    assert [f.level for f in findings if f.where == "CTYPE"] == ["note"]


def test_bad_files_get_a_sentence(tmp_path):
    right = of_others(tmp_path)
    for k, (change, message) in enumerate(
        (
            (FAULTS["missing extension"][0], "no extension WCSDVARR,1"),
            (FAULTS["axes exchanged"][0], "not all programs read"),
            (FAULTS["polynomial"][0], "not a look-up table"),
            (lambda h: h["WCSDVARR", 2].header.__setitem__("CDELT1", 20.0), "different grids"),
            (FAULTS["not finite"][0], "not finite"),
        )
    ):
        wrong = tmp_path / f"wrong{k}.fits"
        with fits.open(right) as hdus:
            change(hdus)
            hdus.writeto(wrong)
        with pytest.raises((FormatError, InputError), match=message):
            registry.read_calibration(wrong)


def test_changed_tables_do_not_take_the_errors_in_the_file(tmp_path):
    path = write(tmp_path, on_sky(3), step=32.0)
    wrong = tmp_path / "wrong.fits"
    with fits.open(path) as hdus:
        hdus["WCSDVARR", 2].data = hdus["WCSDVARR", 2].data + np.float32(0.1)
        hdus.writeto(wrong)
    with pytest.raises(FormatError, match=r"off by 0\.1 pixels from its parameters"):
        registry.read_calibration(wrong)
    assert "from its parameters" in str(registry.lint(wrong))


def test_commands_take_the_tables(tmp_path):
    path = of_others(tmp_path)
    (tmp_path / "stars.csv").write_text("x,y\n31,9\n150,200\n")
    good("apply", path, tmp_path / "stars.csv", "-o", tmp_path / "out.csv")
    assert "approximated by a polynomial" in good("compare", path, path).out


def test_errors_of_one_axis_alone_and_names_that_are_no_text(tmp_path):
    path = write(tmp_path, on_sky(2))
    with fits.open(path) as hdus:
        del hdus["WCSDVERR", 2]
        hdus.writeto(tmp_path / "one.fits")
    [finding] = [f for f in registry.lint(tmp_path / "one.fits") if f.where == "WCSDVERR,2"]
    assert finding.level == "warning" and "is missing" in finding.message
    raw = path.read_bytes()
    card = b"EXTNAME = 'WCSDVERR'"
    assert raw.count(card) == 2
    (tmp_path / "number.fits").write_bytes(raw.replace(card, b"EXTNAME = ".ljust(17) + b"606", 1))
    with pytest.raises(FormatError, match=r"the name of HDU \d \(EXTNAME\) is not text"):
        registry.read_calibration(tmp_path / "number.fits")
