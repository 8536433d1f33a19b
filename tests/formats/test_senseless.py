"""Files with sizes, scales and coefficients that no detector has."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits

from bayesdist.app.cli import main
from bayesdist.errors import InputError
from bayesdist.products.registry import lint, read_calibration

CARDS = {
    "NAXIS": 2, "NAXIS1": 1000, "NAXIS2": 800, "CTYPE1": "RA---TAN-SIP", "CTYPE2": "DEC--TAN-SIP",
    "CRPIX1": 500.5, "CRPIX2": 400.5, "CRVAL1": 10.0, "CRVAL2": 20.0, "CD1_1": -1e-5, "CD1_2": 0.0,
    "CD2_1": 0.0, "CD2_2": 1e-5, "A_ORDER": 2, "B_ORDER": 2, "A_2_0": 1e-7, "B_0_2": 1e-7,
}  # fmt: skip


def header(tmp_path, **changed):
    path = tmp_path / "a.hdr"
    path.write_text(fits.Header({**CARDS, **changed}).tostring(sep="\n", padding=False))
    return path


def test_a_header_that_makes_sense(tmp_path):
    assert read_calibration(header(tmp_path)).numbers == (1,)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"CRVAL1": 0.0, "CRVAL2": 91.0}, "not a position on the sphere"),
        ({"CRVAL1": 1e9, "CRVAL2": 1e9}, "not a position on the sphere"),
        ({"CRPIX1": 1e9}, "reference pixel at"),
        ({"A_2_0": 1e9}, "linear terms"),
        ({"CD1_1": 0.0}, "without an area|linear terms"),
        ({"NAXIS1": 10**9}, "has 1e\\+09 x 800 pixels"),
        ({"A_ORDER": 10**9, "B_ORDER": 10**9}, "A_ORDER: is 1e\\+09, but at most 12 is supported"),
    ],
)
def test_a_header_that_makes_none(tmp_path, changed, words):
    with pytest.raises(InputError, match=words) as caught:
        read_calibration(header(tmp_path, **changed))
    assert str(caught.value).startswith(str(tmp_path))


def test_what_lint_says_of_it(tmp_path):
    found = [str(one) for one in lint(header(tmp_path, CRVAL2=91.0))]
    assert "error: CRVAL1, CRVAL2: (10, 91) degrees are not a position on the sphere" in found


def _idctab(data_dir, tmp_path, change):
    with fits.open(data_dir / "hst_reference" / "0461802ej_idc.fits") as file:
        change(file[1])
        file.writeto(tmp_path / "a_idc.fits")
    return tmp_path / "a_idc.fits"


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("XREF", np.nan, "column XREF: not a finite number"),
        ("YSIZE", -1, "column YSIZE: -1 is not between 1 and 1e+06 pixels"),
        ("V2REF", 1e9, "column V2REF: 1e+09 is not between -648000 and 648000 arcseconds"),
        ("SCALE", 0, "column SCALE: is zero"),
        ("CX22", np.inf, "column CX22: not a finite number"),
    ],
)
def test_a_table_with_one_value_that_cannot_be(data_dir, tmp_path, capsys, column, value, words):
    def change(hdu):
        hdu.data[column][:] = value

    path = _idctab(data_dir, tmp_path, change)
    assert main(["inspect", str(path)]) == 0
    assert words in capsys.readouterr().out
    with pytest.raises(InputError, match="a_idc"):
        read_calibration(path, filter="F606W")


def test_a_table_without_rows(data_dir, tmp_path, capsys):
    def change(hdu):
        hdu.data = hdu.data[:0]

    path = _idctab(data_dir, tmp_path, change)
    assert main(["inspect", str(path)]) == 0
    assert "error: rows: there are none" in capsys.readouterr().out
    with pytest.raises(InputError, match="has no rows"):
        read_calibration(path)
