"""`inspect` of any FITS header with a WCS, judged by astropy.wcs: its own test headers go through.

Positions, scales and angles that the text states are compared with astropy.wcs; the distortion of
one field as TPV and as SIP, which astropy has of one image, has to come out alike.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import astropy.wcs
import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS, FITSFixedWarning

from bayesdist.errors import FormatError
from bayesdist.products import describe

ASTROPY = Path(astropy.wcs.__file__).parent / "tests" / "data"
HEADERS = sorted(p for p in ASTROPY.rglob("*") if p.suffix in (".hdr", ".fits", ".gz"))


@pytest.mark.parametrize("path", HEADERS, ids=lambda p: p.name)
def test_every_header_of_astropy_is_described(path: Path) -> None:
    text = describe(path)
    assert "Findings" in text and "Traceback" not in text
    # what astropy.wcs cannot read is said so, and it alone
    bad = path.name in ("nonstandard_units.hdr", "validate.fits")
    assert ("astropy.wcs cannot read it" in text) == bad


def number(text: str, label: str) -> list[float]:
    """Numbers of the first line with a label."""
    line = next(t for t in text.splitlines() if t.strip().startswith(label))
    return [float(n) for n in re.findall(r"-?\d+\.?\d*(?:e[-+]\d+)?", line.split(label, 1)[1])]


@pytest.mark.parametrize("name", ["irac_sip.hdr", "tpvonly.hdr", "2wcses.hdr", "siponly.hdr"])
def test_centre_and_pixel_are_those_of_astropy(name: str) -> None:
    text = describe(ASTROPY / name)
    header = fits.Header.fromstring((ASTROPY / name).read_bytes())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        wcs = WCS(header)
    centre = [(header["NAXIS1"] + 1) / 2, (header["NAXIS2"] + 1) / 2]
    sky = wcs.all_pix2world([centre], 1)[0]
    assert number(text, "centre")[:2] == pytest.approx(list(sky), rel=2e-8)
    up, right = (wcs.all_pix2world([np.add(centre, step)], 1)[0] for step in ([0, 1], [1, 0]))
    scales = [
        3600 * np.hypot((to[0] - sky[0]) * np.cos(np.radians(sky[1])), to[1] - sky[1])
        for to in (right, up)
    ]
    assert number(text, "pixel")[:2] == pytest.approx(scales, rel=1e-3)


def test_one_field_as_tpv_and_as_sip() -> None:
    tpv, sip = (describe(ASTROPY / f"{kind}only.hdr") for kind in ("tpv", "sip"))
    assert "RA---TPV, DEC--TPV" in tpv and "by the PV terms" in tpv
    assert number(tpv, "moves")[0] == pytest.approx(number(sip, "moves")[0], rel=0.01)
    assert "a header alone" in tpv


def test_all_chips_of_an_exposure() -> None:
    text = describe(ASTROPY / "j94f05bgq_flt.fits")
    for label in ("HDU 1 (SCI,1): SIP", "HDU 4 (SCI,2): SIP", "same in   HDU 3 (DQ,1)"):
        assert label in text
    assert "WCS O, 'OPUS'" in text


def test_tables_of_a_distortion_are_shown() -> None:
    text = describe(ASTROPY / "dist_lookup.fits.gz")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with fits.open(ASTROPY / "dist_lookup.fits.gz") as hdus:
            tables = {f"CPDIS{k}": hdus["WCSDVARR", k].data for k in (1, 2)}
            tables["D2IM1"] = hdus["D2IMARR", 1].data
            header = hdus["SCI", 1].header.copy()
    for name, data in tables.items():
        rows, columns = np.atleast_2d(data).shape
        assert f"table of {columns} x {rows} nodes" in text
        low, high = number(text, name)[-2:] if name != "D2IM1" else number(text, "D2IM1")[-2:]
        assert (low, high) == pytest.approx((data.min(), data.max()), abs=6e-5)
    assert "tables included" in text
    assert "D2IM1" in header or "D2IMDIS1" in header


def test_tables_that_are_not_there_are_missed(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with fits.open(ASTROPY / "dist_lookup.fits.gz") as hdus:
            hdus["SCI", 1].header.tofile(tmp_path / "alone.hdr")
    text = describe(tmp_path / "alone.hdr")
    assert "the tables are extensions of the image, which are not here" in text


def test_two_systems_of_one_header(tmp_path: Path) -> None:
    header = fits.Header({"NAXIS": 2, "NAXIS1": 100, "NAXIS2": 80})
    for key, crval in (("", (10.0, 20.0)), ("A", (30.0, -40.0))):
        for axis, kind in enumerate(("RA---TAN", "DEC--TAN"), start=1):
            header[f"CTYPE{axis}{key}"] = kind
            header[f"CRPIX{axis}{key}"] = (50.5, 40.5)[axis - 1]
            header[f"CRVAL{axis}{key}"] = crval[axis - 1]
            header[f"CDELT{axis}{key}"] = (-1e-4, 1e-4)[axis - 1]
    header["WCSNAMEA"] = "mine"
    header.totextfile(tmp_path / "two.hdr")
    text = describe(tmp_path / "two.hdr")
    assert "primary WCS" in text and "WCS A, 'mine'" in text
    assert "RA 10, DEC 20 deg" in text and "RA 30, DEC -40 deg" in text
    assert text.count("0.36 x 0.36 arcsec") == 2 and "parity as on the sky" in text


def test_an_image_that_is_cut_says_so(tmp_path: Path) -> None:
    header = fits.Header.fromstring((ASTROPY / "irac_sip.hdr").read_bytes())
    fits.PrimaryHDU(np.zeros((256, 256), "f4"), header).writeto(tmp_path / "whole.fits")
    whole = (tmp_path / "whole.fits").read_bytes()
    (tmp_path / "cut.fits").write_bytes(whole[:100_000])
    assert "truncated" in describe(tmp_path / "cut.fits")
    text = describe(tmp_path / "whole.fits")
    assert "truncated" not in text and "a header alone" not in text
    # without a WCS there is nothing to tell, and the damage is the answer
    fits.PrimaryHDU(np.zeros((256, 256), "f4")).writeto(tmp_path / "plain.fits")
    (tmp_path / "plain_cut.fits").write_bytes((tmp_path / "plain.fits").read_bytes()[:100_000])
    with pytest.raises(FormatError, match="truncated"):
        describe(tmp_path / "plain_cut.fits")


def test_a_file_that_is_cut_after_a_header_says_so(tmp_path: Path) -> None:
    """Headers alone, a whole record of each, are a file that somebody may keep."""
    header = fits.Header.fromstring((ASTROPY / "irac_sip.hdr").read_bytes())
    image = fits.ImageHDU(np.zeros((256, 256), "f4"), header, name="SCI")
    for first in (fits.PrimaryHDU(), fits.PrimaryHDU(np.zeros((9, 9)))):
        fits.HDUList([first, image]).writeto(tmp_path / "whole.fits", overwrite=True)
        whole = (tmp_path / "whole.fits").read_bytes()
        begins = len(whole) - 92 * 2880  # of the data of the image, 262,144 bytes
        for length in (begins - 10, begins):
            (tmp_path / "cut.fits").write_bytes(whole[:length])
            alone = length == begins and first.data is None
            assert ("it is truncated" in describe(tmp_path / "cut.fits")) != alone
        assert "truncated" not in describe(tmp_path / "whole.fits")


def test_a_compressed_image_has_its_own_size(tmp_path: Path) -> None:
    header = fits.Header.fromstring((ASTROPY / "irac_sip.hdr").read_bytes())
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(np.ones((256, 256), "i2"), header)]).writeto(
        tmp_path / "a.fits.fz"
    )
    assert "image size 256 x 256 px" in describe(tmp_path / "a.fits.fz")


def test_the_closure_of_a_foreign_inverse_is_computed() -> None:
    """Of Spitzer's header: AP and BP by astropy, at pixels of our choice."""
    text = describe(ASTROPY / "irac_sip.hdr")
    line = next(t for t in text.splitlines() if "inverse" in t)
    found = float(re.search(r"not stated, computed (\S+) px", line)[1])
    wcs = WCS(fits.Header.fromstring((ASTROPY / "irac_sip.hdr").read_bytes()))
    x, y = np.meshgrid(np.linspace(1, 256, 200), np.linspace(1, 256, 200))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    # offsets from CRPIX, and pixels again
    there = wcs.sip_pix2foc(pixels, 1)
    back = wcs.sip_foc2pix(there, 1)
    assert found == pytest.approx(np.hypot(*(back - pixels).T).max(), rel=0.01)


def test_a_rough_maximum_is_a_note_with_numbers() -> None:
    """Spitzer's A_DMAX is 1.6 % high: no program computes with it."""
    text = describe(ASTROPY / "irac_sip.hdr")
    assert "note: A_DMAX: says 0.58 px, but the maximum is 0.5708 px (+1.6 %)" in text
    assert "warning" not in text
