"""Reading and writing of SIP headers."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import astropy.wcs
import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose

from bayesdist.errors import FormatError, InputError
from bayesdist.formats.sip.build import sip_from_solution
from bayesdist.formats.sip.files import read_sip, sip_header, write_sip

from .support import astropy_wcs, random_pixels, some_solution

ASTROPY = Path(astropy.wcs.__file__).parent / "tests" / "data"
HST = ASTROPY / "j94f05bgq_flt.fits"


def images(header: fits.Header) -> list[str]:
    return [card.image for card in header.cards]


def full_precision():
    return sip_from_solution(some_solution(5, angle=0.3, seed=9), scale_arcsec=0.1)


@pytest.mark.parametrize("ext", [1, 4])
def test_real_hst_header_is_kept_card_by_card(tmp_path: Path, ext: int) -> None:
    original = fits.getheader(HST, ext)
    write_sip(read_sip(HST, ext=ext), tmp_path / "a.hdr")
    assert images(fits.Header.fromtextfile(tmp_path / "a.hdr")) == images(original)
    write_sip(read_sip(tmp_path / "a.hdr"), tmp_path / "b.hdr")
    assert (tmp_path / "a.hdr").read_bytes() == (tmp_path / "b.hdr").read_bytes()


def test_the_first_hdu_with_sip_is_read() -> None:
    sip = read_sip(HST)
    assert sip.a[2, 0] == fits.getheader(HST, 1)["A_2_0"]
    assert sip.order == (4, 4)
    assert not sip.has_inverse
    with pytest.raises(InputError, match="no AP_ORDER"):
        sip.inverse(0.0, 0.0)


@pytest.mark.parametrize("name", ["siponly.hdr", "irac_sip.hdr", "sip.fits", "sip2.fits"])
def test_headers_of_others_map_as_in_astropy(name: str) -> None:
    path = ASTROPY / name
    sip = read_sip(path)
    header = sip_header(sip)
    x, y = random_pixels((250, 250), 200)
    foc = astropy_wcs(header).sip_pix2foc(np.stack([x, y], axis=1), 1).T
    assert_allclose(np.stack(sip.forward(x, y)), foc, atol=1e-8, rtol=0)


@pytest.mark.parametrize("name", ["a.hdr", "a.fits", "a.fits.gz"])
def test_everything_comes_back_to_the_last_bit(tmp_path: Path, name: str) -> None:
    sip = full_precision()
    write_sip(sip, tmp_path / name)
    back = read_sip(tmp_path / name)
    for field in ("crpix", "crval", "ctype", "order", "a", "b", "inverse_order", "ap", "bp",
                  "sigma_a", "sigma_b", "dmax", "closure", "offset", "unit", "size"):  # fmt: skip
        assert getattr(back, field) == getattr(sip, field), field
    assert np.array_equal(back.cd, sip.cd)


def test_astropy_reads_the_same_from_text_and_fits(tmp_path: Path) -> None:
    sip = full_precision()
    write_sip(sip, tmp_path / "a.hdr")
    write_sip(sip, tmp_path / "a.fits")
    x, y = random_pixels((1200, 900), 100)
    headers = [fits.Header.fromtextfile(tmp_path / "a.hdr"), fits.getheader(tmp_path / "a.fits")]
    text, table = (astropy_wcs(h).all_pix2world(x, y, 1) for h in headers)
    assert np.array_equal(text, table)
    with fits.open(tmp_path / "a.fits") as hdus:
        hdus.verify("exception")


def test_a_changed_field_changes_its_card_only(tmp_path: Path) -> None:
    sip = read_sip(HST, ext=1)
    changed = replace(sip, a={**sip.a, (2, 0): 8.5e-06})
    before, after = images(sip_header(sip)), images(sip_header(changed))
    different = [(b, a) for b, a in zip(before, after, strict=True) if b != a]
    assert len(different) == 1
    assert different[0][1].startswith("A_2_0   =              8.5E-06")


def test_what_is_taken_away_leaves_the_file(tmp_path: Path) -> None:
    sip = full_precision()
    write_sip(sip, tmp_path / "a.hdr")
    read = read_sip(tmp_path / "a.hdr")
    bare = replace(read, inverse_order=None, ap={}, bp={}, sigma_a={}, sigma_b={}, closure=None)
    write_sip(bare, tmp_path / "b.hdr")
    names = set(fits.Header.fromtextfile(tmp_path / "b.hdr"))
    assert not [n for n in names if n.startswith(("AP_", "BP_", "AE_", "BE_", "BDCLOS"))]
    assert {"A_5_0", "B_0_5", "A_DMAX", "CD1_1"} <= names


def test_pc_with_cdelt_and_crota_make_a_cd_matrix(tmp_path: Path) -> None:
    base = "CRPIX1  = 5.0\nCRPIX2  = 6.0\nA_ORDER = 2\nB_ORDER = 2\n"
    wcs_lines = "CTYPE1  = 'RA---TAN-SIP'\nCTYPE2  = 'DEC--TAN-SIP'\n"
    for lines in (
        "CDELT1  = -0.1\nCDELT2  = 0.2\n"
        "PC1_1   = 0.8\nPC1_2   = -0.6\nPC2_1   = 0.6\nPC2_2   = 0.8\n",
        "CDELT1  = -0.1\nCDELT2  = 0.2\nCROTA2  = 30.0\n",
        "CD1_1   = -0.1\nCD2_2   = 0.2\n",
    ):
        text = base + wcs_lines + lines
        header = fits.Header.fromstring(text, sep="\n")
        ours = read_header(tmp_path, text)
        # wcslib's own idea of the linear transformation
        theirs = astropy_wcs(header).pixel_scale_matrix
        assert_allclose(ours.cd, theirs, atol=1e-15)
        assert images(sip_header(ours)) == images(header)  # still in the form it had


def read_header(folder: Path, text: str):
    (folder / "h.hdr").write_text(text)
    return read_sip(folder / "h.hdr")


GOOD = "CRPIX1  = 5.0\nCRPIX2  = 6.0\nA_ORDER = 2\nB_ORDER = 2\nA_2_0   = 1E-5\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (GOOD.replace("A_ORDER", "A_ORDR "), "no A_ORDER"),
        (GOOD.replace("B_ORDER", "B_ORDR "), "B_ORDER: is missing"),
        (GOOD.replace("CRPIX2", "CRPIX3"), "CRPIX2: is missing"),
        (GOOD.replace("1E-5", "'1E-5'"), "keyword A_2_0: value '1E-5' is not a finite number"),
        (GOOD.replace("A_ORDER = 2", "A_ORDER = 2.5"), "A_ORDER: polynomial order is 2.5"),
        (GOOD + "AP_ORDER= 3\n", "BP_ORDER: is missing"),
        ("name,value\nA_ORDER,3\n", "no A_ORDER"),
    ],
)
def test_defects_are_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        read_header(tmp_path, text)


def test_files_that_are_no_headers(tmp_path: Path) -> None:
    (tmp_path / "bytes").write_bytes(bytes(range(256)) * 20)
    with pytest.raises(FormatError, match="not a header that can be read"):
        read_sip(tmp_path / "bytes")
    (tmp_path / "short.gz").write_bytes(gzip.compress(HST.read_bytes())[:500])
    with pytest.raises(FormatError, match="broken gzip file"):
        read_sip(tmp_path / "short.gz")
    with pytest.raises(InputError, match="does not exist"):
        read_sip(tmp_path / "none.hdr")
    with pytest.raises(InputError, match="no HDU 9; choose one of 0 to 6"):
        read_sip(HST, ext=9)
    write_sip(full_precision(), tmp_path / "a.hdr")
    with pytest.raises(InputError, match="leave out ext"):
        read_sip(tmp_path / "a.hdr", ext=1)


def test_a_failed_write_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"):
        write_sip(full_precision(), tmp_path / "nowhere" / "a.hdr")
    assert list(tmp_path.iterdir()) == []
