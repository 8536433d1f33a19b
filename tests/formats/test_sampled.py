"""Headers of any projection, sampled and written again: judged by astropy.wcs and astropy."""

from __future__ import annotations

import re

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from astropy.wcs.utils import pixel_to_skycoord

from tests.app.support import cli, good

SIZE = (600, 400)
STEP = 3e-4  # degrees in a pixel: a field of 0.18 degrees
SURFACE = "3. 4. 4. 2. -0.1 0.1 -0.08 0.08"  # polynomial of order 3 with half the cross terms
TNX = {
    1: f'wtype=tnx axtype=ra lngcor = "{SURFACE} 1.0E-5 2.0E-4 -3.0E-5 1.0E-3 3.0E-4 1.0E-3 '
    '2.0E-4 1.0E-4 1.0E-3 2.0E-3 "',
    2: f'wtype=tnx axtype=dec latcor = "{SURFACE} 2.0E-5 1.0E-4 -2.0E-3 1.0E-3 1.0E-4 1.0E-3 '
    '2.0E-3 2.0E-4 1.0E-3 2.0E-3 "',
}


def header_of(kind: str) -> fits.Header:
    """Header of SIZE about (150, 2) degrees; its system is FK4 for `kind` "FK4"."""
    code = "TAN" if kind in ("FK4", "galactic") else kind
    lon, lat = ("GLON", "GLAT") if kind == "galactic" else ("RA--", "DEC-")
    header = fits.Header({"NAXIS": 2, "NAXIS1": SIZE[0], "NAXIS2": SIZE[1]})
    header["CTYPE1"], header["CTYPE2"] = f"{lon}-{code}", f"{lat}-{code}"
    header["CRPIX1"], header["CRPIX2"], header["CRVAL1"], header["CRVAL2"] = (
        310.0,
        190.0,
        150.0,
        2.0,
    )
    header["CD1_1"], header["CD1_2"], header["CD2_1"], header["CD2_2"] = -STEP, 1e-5, 2e-5, STEP
    if kind == "ZPN":
        header["PV2_1"], header["PV2_3"] = 1.0, 400.0
    if kind == "FK4":
        header["RADESYS"], header["EQUINOX"] = "FK4", 1950.0
    if kind == "TNX":
        header["WAT0_001"] = "system=image"
        for axis, text in TNX.items():
            for k in range(0, len(text), 68):
                header[f"WAT{axis}_{k // 68 + 1:03d}"] = text[k : k + 68]
    return header


@pytest.mark.parametrize(
    ("kind", "name"),
    [("ZPN", "ZPN"), ("TNX", "TNX"), ("ARC", "ARC"), ("FK4", "FK4"), ("galactic", "GALACTIC")],
)
def test_a_sampled_header_has_the_positions_that_astropy_has(tmp_path, kind, name):
    """Refused with the way out, which then gives the same positions in ICRS."""
    header, path = header_of(kind), tmp_path / "given.hdr"
    header.totextfile(path, endcard=True)
    if kind not in ("FK4", "galactic"):
        refused = cli("convert", path, "--to", "sip", "-o", tmp_path)
        assert refused.code == 1
        assert kind in refused.err and "--sample" in refused.err
    out = good("convert", path, "--sample", "--to", "tpv", "-o", tmp_path / "new.head").out
    assert name in out
    said = float(re.search(r"is (\S+) pix \(\S+ mas\) from it at worst", out)[1])
    x, y = (
        z.ravel() for z in np.meshgrid(np.linspace(1, SIZE[0], 31), np.linspace(1, SIZE[1], 31))
    )
    truth = pixel_to_skycoord(x, y, WCS(header), origin=1).icrs
    made = WCS(fits.Header.fromtextfile(tmp_path / "new.head"))
    new = pixel_to_skycoord(x, y, made, origin=1).icrs
    worst = truth.separation(new).deg.max() / STEP
    assert worst < 1e-3
    assert worst < 1.1 * said + 1e-8
    assert abs(said - worst) < 0.5 * said + 1e-8


def test_an_order_that_is_too_low_is_stated_with_its_error(tmp_path):
    header, path = header_of("ZPN"), tmp_path / "given.hdr"
    header["PV2_3"] = 40000.0
    header.totextfile(path, endcard=True)
    given = ("convert", path, "--sample", "--order", 1, "--to", "tpv", "-o", tmp_path / "new.head")
    out = good(*given).out
    assert "warning: no polynomial follows this header well" in out
    assert float(re.search(r"of order 1 is (\S+) pix", out)[1]) > 0.1


@pytest.mark.parametrize("option", [("--chip", 1), ("--epoch", 2016.0), ("--filter", "F606W")])
def test_options_that_a_sampled_header_has_no_use_for_are_refused(tmp_path, option):
    path = tmp_path / "given.hdr"
    header_of("ARC").totextfile(path, endcard=True)
    found = cli("convert", path, "--sample", "--to", "sip", "-o", tmp_path, *option)
    assert found.code == 1 and option[0] in found.err and "leave it out" in found.err


# -- headers of images whose catalogues have positions made from the pixels ------------------------


def ldac(path, headers):
    """A FITS_LDAC catalogue, as SExtractor writes the headers of its images."""
    hdus = [fits.PrimaryHDU()]
    for header in headers:
        text = np.array([[card.image.encode() for card in header.cards] + [b"END".ljust(80)]])
        column = fits.Column(
            "Field Header Card", f"{80 * text.size}A", dim=f"(80, {text.size})", array=text
        )
        hdus.append(fits.BinTableHDU.from_columns([column], name="LDAC_IMHEAD"))
        objects = [fits.Column("X_IMAGE", "D", array=np.arange(3.0))]
        hdus.append(fits.BinTableHDU.from_columns(objects, name="LDAC_OBJECTS"))
    fits.HDUList(hdus).writeto(path)
    return path


def tpv_header(offset=0.0):
    header = header_of("TPV")
    header["CRPIX1"] -= offset
    for axis in (1, 2):
        for k, value in {0: 0.0, 1: 1.0, 2: 0.0, 4: 0.02, 5: 0.03, 7: 0.4, 9: -0.3}.items():
            header[f"PV{axis}_{k}"] = value
    return fits.PrimaryHDU(np.zeros(SIZE[::-1], "u1"), header).header


@pytest.mark.parametrize("to", ["sip", "tpv"])
def test_headers_of_images_in_a_catalogue_of_sextractor_are_converted(tmp_path, to):
    headers = [tpv_header(), tpv_header(offset=650.0)]
    path = ldac(tmp_path / "chips.cat", headers)
    said = good("inspect", path).out
    assert "TPV of order 3" in said
    options = ("--chip", 2) if to == "sip" else ()
    good("convert", path, "--to", to, "-o", tmp_path / "new.head", *options)
    text = (tmp_path / "new.head").read_text()
    written = [
        fits.Header.fromstring(part, sep="\n") for part in text.split("\nEND") if "CRVAL1" in part
    ]
    x, y = np.random.default_rng(1).uniform(1, 400, (2, 50))
    for old, new in zip(headers[-len(written) :], written, strict=True):
        expected = pixel_to_skycoord(x, y, WCS(old), origin=1)
        found = pixel_to_skycoord(x, y, WCS(new), origin=1)
        assert expected.separation(found).arcsec.max() < 1e-5 * 3600 * STEP


def test_a_wcs_without_distortion_is_named_as_one_and_can_be_sampled(tmp_path):
    header = header_of("TAN")
    path = tmp_path / "image.fits"
    fits.PrimaryHDU(np.zeros(SIZE[::-1], "f4"), header).writeto(path)
    refused = cli("convert", path, "--to", "sip", "-o", tmp_path)
    assert refused.code == 1
    assert "is a WCS without distortion" in refused.err and "convert FILE --sample" in refused.err
    good("convert", path, "--sample", "--to", "sip", "-o", tmp_path / "new.hdr")
    written = WCS(fits.Header.fromtextfile(tmp_path / "new.hdr"))
    x, y = np.random.default_rng(1).uniform(1, 400, (2, 50))
    off = pixel_to_skycoord(x, y, WCS(header), origin=1).separation(
        pixel_to_skycoord(x, y, written, origin=1)
    )
    assert off.arcsec.max() < 1e-5 * 3600 * STEP
