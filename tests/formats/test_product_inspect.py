"""Products in words."""

from __future__ import annotations

from pathlib import Path

import astropy.wcs
import numpy as np
import pytest
from astropy.io import fits

from bayesdist.errors import FormatError, InputError
from bayesdist.formats.idctab.build import idctab_from_solution
from bayesdist.formats.idctab.table import read_idctab, write_idctab
from bayesdist.formats.sip.build import sip_from_solution
from bayesdist.formats.sip.files import write_sip
from bayesdist.products import describe

from .support import F606W, some_solution, wfc_solution

ASTROPY = Path(astropy.wcs.__file__).parent / "tests" / "data"


def test_a_real_table(data_dir) -> None:
    text = describe(data_dir / "hst_reference" / "0461802ej_idc.fits")
    for part in ("IDCTAB of ACS/WFC, order 5, 672 rows", "TDD_CTB1 = 1.829497383e-06",
                 "336 combinations", "errors    none", "DETCHIP 1", "DETCHIP 2",
                 "XREF 2048", "parity"):  # fmt: skip
        assert part in text


def test_our_own_table_shows_its_sigmas(data_dir, tmp_path: Path) -> None:
    real = read_idctab(data_dir / "hst_reference" / "0461802ej_idc.fits")
    made = idctab_from_solution(
        wfc_solution(real), instrument="ACS", detector="WFC", filters=F606W, scale_arcsec=0.05
    )
    write_idctab(made, tmp_path / "a_idc.fits")
    text = describe(tmp_path / "a_idc.fits")
    assert "errors    standard deviations and covariance" in text
    [line] = [t for t in text.splitlines() if t.strip().startswith("CX11")][:1]
    name, power_x, power_y, value, sigma = line.split()
    assert (name, power_x, power_y) == ("CX11", "x^1", "y^0")
    first = made.rows[0]
    assert float(value) == pytest.approx(float(first["CX11"]), rel=1e-12)
    assert float(sigma) == pytest.approx(float(made.sigma["CX11"][0]), rel=1e-3)


@pytest.mark.parametrize("suffix", ["hdr", "fits"])
def test_our_own_header(tmp_path: Path, suffix: str) -> None:
    sip = sip_from_solution(some_solution(4, flip=True, strength=0.5), scale_arcsec=0.1)
    path = tmp_path / f"a.{suffix}"
    write_sip(sip, path)
    text = describe(path)
    assert "SIP header, A_ORDER 4, B_ORDER 4, image size 1200 x 900 px" in text
    assert f"{sip.a[2, 0]:.13e}" in text
    assert f"{sip.sigma_a[2, 0]:.3e}" in text
    findings = text[text.index("Findings:") :].splitlines()
    assert len(findings) == 2 and "errors of positions are not stated" in findings[1]


def test_headers_of_others() -> None:
    assert "A_ORDER 4" in describe(ASTROPY / "siponly.hdr")
    assert "RA---TAN-SIP" in describe(ASTROPY / "j94f05bgq_flt.fits")


def test_other_files_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("# Notes\n\nnothing here\n")
    fits.PrimaryHDU(np.zeros((3, 3))).writeto(tmp_path / "image.fits")
    for path in (tmp_path / "notes.txt", tmp_path / "image.fits"):
        with pytest.raises(
            InputError, match="give a SIP header, an IDCTAB, a D2IMFILE or NPOLFILE, "
        ) as caught:
            describe(path)
        assert path.name in str(caught.value)
    with pytest.raises(InputError, match="does not exist"):
        describe(tmp_path / "none")


def test_damage_is_told_from_another_kind(data_dir, tmp_path: Path) -> None:
    whole = (data_dir / "hst_reference" / "0461802ej_idc.fits").read_bytes()
    (tmp_path / "cut.fits").write_bytes(whole[:100_000])
    with pytest.raises(FormatError, match="truncated"):
        describe(tmp_path / "cut.fits")
    (tmp_path / "bad.hdr").write_text("A_ORDER = 3\nB_ORDER = 3\nCRPIX1  = 'left'\n")
    with pytest.raises(FormatError, match="CRPIX1"):
        describe(tmp_path / "bad.hdr")
