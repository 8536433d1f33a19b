"""Reading and writing of real IDCTABs, and the names of their coefficients."""

from __future__ import annotations

import gzip
import io
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose, assert_array_equal

from bayesdist.errors import FormatError, InputError
from bayesdist.formats.idctab.table import (
    idctab_column,
    idctab_powers,
    read_idctab,
    write_idctab,
)
from bayesdist.model import polynomial_terms

from .support import F606W

REAL = {
    "0461802ej_idc.fits": (5, "2015", 672),
    "qbu1641sj_idc.fits": (4, "default", 736),
    "postsm4_idc.fits": (4, "order", 736),
}


@pytest.mark.parametrize("name", REAL)
def test_real_tables_are_written_back_bit_by_bit(data_dir, tmp_path: Path, name: str) -> None:
    source = data_dir / "hst_reference" / name
    write_idctab(read_idctab(source), tmp_path / name)
    assert (tmp_path / name).read_bytes() == source.read_bytes()


@pytest.mark.parametrize("name", REAL)
def test_what_the_real_tables_hold(data_dir, name: str) -> None:
    path = data_dir / "hst_reference" / name
    tab = read_idctab(path)
    order, scheme, n = REAL[name]
    assert (tab.norder, tab.tdd_scheme, len(tab.rows)) == (order, scheme, n)
    assert (tab.instrument, tab.detector, tab.is_acs_wfc) == ("ACS", "WFC", True)
    theirs = fits.getdata(path, 1)
    for column in ("DETCHIP", "XREF", "CX11", "CY22"):
        assert_array_equal(tab.rows[column], theirs[column])
    assert tab.sigma is None
    assert tab.covariance is None


def test_coefficients_are_those_of_the_delivered_file(data_dir) -> None:
    # F606W, WFC1 and WFC2, as printed by the table itself (CX11 goes with x, CX10 with y)
    tab = read_idctab(data_dir / "hst_reference" / "0461802ej_idc.fits")
    cx, cy = tab.coefficients(1, F606W)
    assert tab.terms[:4] == ((0, 0), (1, 0), (0, 1), (2, 0))
    row = tab.rows[tab.row(1, F606W)]
    assert (cx[1], cx[2], cy[1], cy[2]) == (row["CX11"], row["CX10"], row["CY11"], row["CY10"])
    assert cx[0] == 0.0
    # along x an ACS pixel is 0.049 arcsec, and the axes lie near those of the aperture
    assert cx[1] == pytest.approx(0.0492, abs=1e-4)
    assert abs(cx[2]) < 0.1 * cx[1]


def test_evaluation_is_that_of_stwcs(data_dir) -> None:
    models = pytest.importorskip("stwcs.distortion.models")
    path = data_dir / "hst_reference" / "0461802ej_idc.fits"
    tab = read_idctab(path)
    rng = np.random.default_rng(3)
    x, y = rng.uniform(1, 4096, 500), rng.uniform(1, 2048, 500)
    for chip in (1, 2):
        theirs = models.IDCModel(str(path), chip=chip, filter1="F606W", filter2="CLEAR2L")
        theirs.pscale = 1.0  # arcseconds, in place of pixels of SCALE
        expected = theirs.apply(np.stack([x, y], axis=1))
        ours = tab.evaluate(chip, x, y, filter=F606W)
        assert_allclose(np.stack(ours), np.stack(expected), atol=1e-11, rtol=0)


def test_filters_are_chosen_as_stwcs_does(data_dir) -> None:
    tab = read_idctab(data_dir / "hst_reference" / "0461802ej_idc.fits")
    assert tab.row(1, F606W) == tab.row(1, "F606W") == tab.row(1, ("F606W", "CLEAR2S"))
    assert tab.row(1, "F814W") == tab.row(1, ("CLEAR1L", "F814W"))
    assert tab.row(1, ("CLEAR1L", "CLEAR2L")) == tab.row(1, "CLEAR")
    with pytest.raises(InputError, match="name the filter"):
        tab.row(1)
    with pytest.raises(InputError, match=r"no row for filter 'F999W'"):
        tab.row(1, "F999W")
    with pytest.raises(InputError, match="there is no row"):
        tab.row(3, F606W)
    with pytest.raises(InputError, match="there is no row"):
        tab.row(1, F606W, "INVERSE")


def test_other_schemes_of_time_are_not_guessed(data_dir) -> None:
    for name, scheme in (("postsm4_idc.fits", "order"), ("qbu1641sj_idc.fits", "default")):
        tab = read_idctab(data_dir / "hst_reference" / name)
        with pytest.raises(InputError, match=f"scheme '{scheme}'"):
            tab.evaluate(1, 1.0, 1.0, filter=F606W, epoch=2010.0)


# -- small tables of other formats ---------------------------------------------------------------


def small_table(order: int = 1, **changes) -> fits.HDUList:
    """A table of one chip, with CX00 and without filters, as older formats have it."""
    columns = {"XSIZE": 100, "YSIZE": 80, "XREF": 50.0, "YREF": 40.0, "V2REF": 1.0, "V3REF": 2.0,
               "SCALE": 0.1, "CX00": 7.0, "CY00": 8.0, "CX10": 0.0, "CX11": 0.1, "CY10": 0.1,
               "CY11": 0.0}  # fmt: skip
    keywords = {"INSTRUME": "WFC3", "DETECTOR": "UVIS", "NORDER": order}
    for name, value in changes.items():
        target = keywords if name in keywords else columns
        if value is None:
            del target[name]
        else:
            target[name] = value
    primary = fits.PrimaryHDU()
    primary.header.update(keywords)
    table = fits.BinTableHDU.from_columns(
        [fits.Column(n, "1J" if "SIZE" in n else "1D", array=[v]) for n, v in columns.items()]
    )
    return fits.HDUList([primary, table])


def save(hdus: fits.HDUList, path: Path) -> Path:
    hdus.writeto(path)
    return path


def test_constants_are_not_used_and_directions_default_to_forward(tmp_path: Path) -> None:
    tab = read_idctab(save(small_table(), tmp_path / "a.fits"))
    assert tab.coefficients(1)[0][0] == 7.0
    x, y = tab.evaluate(1, 53.0, 44.0)
    assert (x, y) == (pytest.approx(0.3), pytest.approx(0.4))
    assert tab.row(1, "anything") == 0  # no filter columns: for all filters
    assert tab.tdd_scheme == "none"
    assert tab.evaluate(1, 53.0, 44.0, epoch=2020.0) == (x, y)


def test_a_linear_term_of_one_means_units_of_scale(tmp_path: Path) -> None:
    models = pytest.importorskip("stwcs.distortion.models")
    path = save(small_table(CX11=1.0, CY10=1.01), tmp_path / "a_idc.fits")
    theirs = models.IDCModel(str(path), chip=1, filter1="F606W", filter2=None)
    theirs.pscale = 1.0
    expected = theirs.apply(np.array([[53.0, 44.0]]))
    assert_allclose(read_idctab(path).evaluate(1, [53.0], [44.0]), expected, rtol=1e-14)


def test_old_names_of_columns(tmp_path: Path) -> None:
    names = {f"{new}{n}": None for new in ("CX", "CY") for n in ("00", "10", "11")}
    old = {"A10": 0.0, "A11": 0.1, "B10": 0.1, "B11": 0.0}
    tab = read_idctab(save(small_table(**names, **old), tmp_path / "a.fits"))
    assert tab.prefixes == ("A", "B")
    assert_allclose(tab.evaluate(1, 53.0, 44.0), (0.3, 0.4))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"NORDER": None}, "keyword NORDER: is missing"),
        ({"INSTRUME": None}, "keyword INSTRUME: is missing"),
        ({"NORDER": 2}, "column CX22: is missing"),
        ({"NORDER": 0}, "keyword NORDER: is 0"),
        ({"NORDER": "five"}, "keyword NORDER: is 'five'"),
        ({"CY11": None}, "column CY11: is missing"),
        ({"SCALE": None}, "column SCALE: is missing"),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, changes: dict, message: str) -> None:
    path = save(small_table(**changes), tmp_path / "a.fits")
    with pytest.raises(FormatError, match=rf"a\.fits, {message}"):
        read_idctab(path)


def test_damaged_files(tmp_path: Path) -> None:
    stream = io.BytesIO()
    small_table().writeto(stream)
    whole = stream.getvalue()
    cases = {
        "cut in the data": whole[: len(whole) - 2881],
        "cut in a header": whole[:4000],
        "not FITS": b"DETCHIP,CX10\n1,0.05\n",
        "empty": b"",
        "gzip cut": gzip.compress(whole)[:200],
    }
    for name, content in cases.items():
        path = tmp_path / f"{name}.fits"
        path.write_bytes(content)
        with pytest.raises(FormatError, match=f"{name}.fits"):
            read_idctab(path)
    (tmp_path / "zipped.fits.gz").write_bytes(gzip.compress(whole))
    assert len(read_idctab(tmp_path / "zipped.fits.gz").rows) == 1
    image = tmp_path / "image.fits"
    fits.PrimaryHDU(np.zeros((3, 3))).writeto(image)
    with pytest.raises(FormatError, match="INSTRUME"):
        read_idctab(image)
    with pytest.raises(InputError, match="does not exist"):
        read_idctab(tmp_path / "none.fits")


# -- names of coefficients -------------------------------------------------------------------------


@pytest.mark.parametrize(("i", "j"), polynomial_terms(9))
def test_names_and_powers_are_inverse_to_one_another(i: int, j: int) -> None:
    assert idctab_powers(idctab_column("CX", i, j)) == ("CX", i, j)


def test_first_order_is_as_stwcs_has_it() -> None:
    # stwcs makes its CD matrix of [[CX11, CX10], [CY11, CY10]]: x first
    assert [idctab_column("CX", 1, 0), idctab_column("CX", 0, 1)] == ["CX11", "CX10"]


@pytest.mark.parametrize("name", ["CX12", "CX1", "CZ11", "A_1", "XREF", "AP_ORDER", "A_10_0"])
def test_other_names_are_no_coefficients(name: str) -> None:
    assert idctab_powers(name) is None
