"""D2IMFILE and NPOLFILE of ours, as stwcs and astropy.wcs apply them.

The model says: the sky of a pixel is what the IDCTAB alone makes of the *corrected* pixel.  So
every comparison is between stwcs with all files at (x, y) and stwcs with the IDCTAB alone at
`corrected(tables, x, y)`, and once with our own evaluation of the IDCTAB in its place.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose

from bayesdist.formats.idctab.build import idctab_from_solution
from bayesdist.formats.idctab.table import IdcTab, read_idctab, write_idctab
from bayesdist.formats.lookup.file import LookupFile, write_lookup_file
from bayesdist.formats.lookup.tables import read_d2im, read_npol, write_d2im, write_npol
from bayesdist.model.lookup import LookupTable, corrected
from tests.reduced import case_in_full

from .stwcs_offline import gnomonic, separation_mas, sky, solutions
from .support import F606W, wfc_solution

pytest.importorskip("stwcs")
CHIPS = (1, 2)
SHAPE = (32, 64)
DATES = ("2005-03-07", "2016-07-01")


@pytest.fixture(scope="module")
def idctab(data_dir, tmp_path_factory) -> tuple[Path, IdcTab]:
    """A table of ours with the numbers of a real one."""
    real = read_idctab(data_dir / "hst_reference" / "0461802ej_idc.fits")
    record = real.rows[real.row(2, F606W)]
    tab = idctab_from_solution(
        wfc_solution(real), instrument="ACS", detector="WFC", scale_arcsec=0.05, filters=F606W,
        v2ref=float(record["V2REF"]), v3ref=float(record["V3REF"]),
    )  # fmt: skip
    path = tmp_path_factory.mktemp("idctab") / "ours_idc.fits"
    write_idctab(tab, path)
    return path, tab


@pytest.fixture(scope="module")
def pixels():
    """Everywhere, the strips beyond the outermost nodes and the very edges included."""
    rng = np.random.default_rng(6)
    x, y = rng.uniform(0.5, 4096.5, 500), rng.uniform(0.5, 2048.5, 500)
    x[:100], y[100:200] = rng.uniform(0.5, 32.5, 100), rng.uniform(2016.5, 2048.5, 100)
    return np.append(x, [0.5, 4096.5]), np.append(y, [2048.5, 0.5])


def rough(chip: int, amplitude: float, seed: int, filter: str = "", **names) -> LookupTable:
    """Neighbouring nodes are strangers: no smoothness hides a wrong registration."""
    rng = np.random.default_rng([seed, chip])
    values = rng.uniform(-amplitude, amplitude, (2, *SHAPE))
    return LookupTable(chip, values, filter, sigma=np.full(values.shape, 0.01), **names)


@cache
def solutions_without_tables(idctab: Path, date: str | None):
    """Of stwcs with the IDCTAB alone, once for all tests."""
    return solutions(idctab.parent, idctab, date)


def plain_sky(idctab: Path, x, y, chip: int, date: str | None = None):
    """Sky positions (N, 2) in degrees of pixels of a chip, of the IDCTAB alone."""
    found = solutions_without_tables(idctab, date)[chip]
    return found.all_pix2world(np.stack([x, y], axis=1), 1)


def worst_mas(folder, idctab, pixels, tables, *, date=None, **files: Path) -> float:
    """Largest distance between stwcs with the files and our model, over both chips."""
    return farthest_mas(sky(folder, idctab, *pixels, date, **files), idctab, pixels, tables, date)


def farthest_mas(theirs, idctab, pixels, tables, date=None) -> float:
    """Largest distance between positions of stwcs and our model, over both chips."""
    worst = 0.0
    for chip in CHIPS:
        x, y = corrected(tables, *pixels, chip=chip, filter="F606W")
        alone = plain_sky(idctab, x, y, chip, date)
        worst = max(worst, separation_mas(theirs[chip], alone).max())
    return worst


@pytest.mark.parametrize("date", DATES)
def test_detector_and_filter_tables_together(tmp_path, idctab, pixels, date) -> None:
    path, tab = idctab
    detector = [rough(c, 0.2, 1) for c in CHIPS]
    by_filter = [rough(c, 0.05, 2, "F606W") for c in CHIPS]
    write_d2im(detector, tmp_path / "a_d2i.fits")
    npol = write_npol(by_filter, tmp_path / "a_npl.fits", idctab=tab, filters=F606W)
    files = {"D2IMFILE": tmp_path / "a_d2i.fits", "NPOLFILE": tmp_path / "a_npl.fits"}
    theirs = sky(tmp_path, path, *pixels, date, **files)
    for chip in CHIPS:  # the tables do something: tens of mas on many pixels, on both chips
        plain = plain_sky(path, *pixels, chip, date)
        assert np.median(separation_mas(theirs[chip], plain)) > 5
    worst = farthest_mas(theirs, path, pixels, [*by_filter, *detector], date)
    assert worst < 0.1
    # and what remains is what the file says of itself, with single precision and ten years' drift
    assert worst < npol.header["BDNPLERR"] + 0.005


def test_the_detector_table_alone_is_exact(tmp_path, idctab, pixels) -> None:
    """Only single precision is left: 0.2 px x 6e-8 x 50 mas."""
    path, _ = idctab
    tables = [rough(c, 0.2, 3) for c in CHIPS]
    write_d2im(tables, tmp_path / "a_d2i.fits")
    worst = worst_mas(tmp_path, path, pixels, tables, D2IMFILE=tmp_path / "a_d2i.fits")
    assert worst < 1e-5


def test_our_own_plane_is_that_of_stwcs(tmp_path, idctab, pixels) -> None:
    """(xi, eta) of stwcs against (Xc, Yc) of the IDCTAB at the corrected pixel, both chips at once.

    Left free: one rotation and one shift.  The scale is not: the table has no velocity aberration,
    which stwcs puts back as 1.0000187.
    """
    path, tab = idctab
    tables = [rough(c, 0.2, 1) for c in CHIPS] + [rough(c, 0.05, 2, "F606W") for c in CHIPS]
    write_d2im(tables[:2], tmp_path / "a_d2i.fits")
    write_npol(tables[2:], tmp_path / "a_npl.fits", idctab=tab, filters=F606W)
    theirs = sky(
        tmp_path, path, *pixels,
        D2IMFILE=tmp_path / "a_d2i.fits", NPOLFILE=tmp_path / "a_npl.fits",
    )  # fmt: skip
    epoch = 2005 + 66 / 365.25
    ours = []
    for chip in CHIPS:
        record = tab.rows[tab.row(chip, F606W)]
        base = tab.rows[tab.row(2, F606W)]
        x, y = corrected(tables, *pixels, chip=chip, filter="F606W")
        place = np.stack(tab.evaluate(chip, x, y, filter=F606W, epoch=epoch), axis=1)
        offset = [record["V2REF"] - base["V2REF"], base["V3REF"] - record["V3REF"]]
        ours.append(place + np.array(offset))
    a = np.concatenate(ours) * 1.000018683511
    b = gnomonic(np.concatenate([theirs[1], theirs[2]]), theirs[2].mean(axis=0))
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    left, _, right = np.linalg.svd(b.T @ a)
    assert np.hypot(*(b - a @ (left @ right).T).T).max() * 1e3 < 0.1


@pytest.mark.parametrize(
    ("first", "step", "shape"),
    [case_in_full((32.5, 32.5), (64.0, 64.0), (32, 64), instead="one that is less usual is run"),
     case_in_full((1.0, 1.0), (64.0, 64.0), (33, 65), instead="one that is less usual is run"),
     ((100.0, 77.5), (180.5, 93.0), (20, 22))],
)  # fmt: skip
def test_any_registration_is_kept(tmp_path, idctab, pixels, first, step, shape) -> None:
    path, tab = idctab
    rng = np.random.default_rng(9)
    tables = [
        LookupTable(c, rng.normal(size=(2, *shape)) * size, f, first, step)
        for f, size in (("", 0.1), ("F606W", 0.02)) for c in CHIPS
    ]  # fmt: skip
    write_d2im(tables[:2], tmp_path / "a_d2i.fits")
    npol = write_npol(tables[2:], tmp_path / "a_npl.fits", idctab=tab, filters=F606W)
    worst = worst_mas(
        tmp_path, path, pixels, tables,
        D2IMFILE=tmp_path / "a_d2i.fits", NPOLFILE=tmp_path / "a_npl.fits",
    )  # fmt: skip
    assert worst < 0.1
    assert worst < npol.header["BDNPLERR"] + 0.005


@pytest.mark.parametrize(
    "first",
    [
        case_in_full((32.5, 32.5), instead="another one is run"),
        case_in_full((1.0, 1.0), instead="another one is run"),
        (100.0, 50.0),
    ],
)
def test_tables_without_a_positive_node_do_not_drop_out(tmp_path, idctab, pixels, first) -> None:
    """stwcs gives their maximum as CPERR, and astropy leaves out what is below zero."""
    path, tab = idctab
    rng = np.random.default_rng(8)
    tables = [
        LookupTable(c, -rng.uniform(0.3, 1.0, (2, *SHAPE)) * size, f, first)
        for f, size in (("", 0.2), ("F606W", 0.05)) for c in CHIPS
    ]  # fmt: skip
    write_d2im(tables[:2], tmp_path / "a_d2i.fits")
    write_npol(tables[2:], tmp_path / "a_npl.fits", idctab=tab, filters=F606W)
    files = {"D2IMFILE": tmp_path / "a_d2i.fits", "NPOLFILE": tmp_path / "a_npl.fits"}
    assert worst_mas(tmp_path, path, pixels, tables, **files) < 0.1
    for read, given in (
        (read_d2im(files["D2IMFILE"]), tables[:2]),
        (read_npol(files["NPOLFILE"], tab), tables[2:]),
    ):
        for table in given:
            [back] = [t for t in read if t.chip == table.chip]
            assert back.shape == SHAPE
            assert_allclose(back.values, table.values, atol=1e-8)


def test_without_padding_they_would(tmp_path, idctab, pixels) -> None:
    """The trap is real: the same file less its padding leaves stwcs without the correction."""
    path, _ = idctab
    tables = [LookupTable(c, np.full((2, *SHAPE), -0.2)) for c in CHIPS]
    write_d2im(tables, tmp_path / "padded_d2i.fits")
    with fits.open(tmp_path / "padded_d2i.fits") as hdus:
        for hdu in hdus[1:]:
            hdu.data = hdu.data[:, : -hdu.header["BDPAD"]]
        hdus.writeto(tmp_path / "bare_d2i.fits")
    plain = {c: plain_sky(path, *pixels, c) for c in CHIPS}
    shift = {}
    for name in ("padded", "bare"):
        theirs = sky(tmp_path, path, *pixels, D2IMFILE=tmp_path / f"{name}_d2i.fits")
        shift[name] = [separation_mas(theirs[c], plain[c]) for c in CHIPS]
    assert np.min(shift["padded"]) > 12  # 0.28 px
    assert np.max(shift["bare"]) == 0.0


def test_one_chip_alone(tmp_path, idctab, pixels) -> None:
    path, tab = idctab
    tables = [rough(1, 0.2, 1), rough(1, 0.05, 2, "F606W")]
    write_d2im(tables[:1], tmp_path / "a_d2i.fits")
    write_npol(tables[1:], tmp_path / "a_npl.fits", idctab=tab, filters=F606W)
    files = {"D2IMFILE": tmp_path / "a_d2i.fits", "NPOLFILE": tmp_path / "a_npl.fits"}
    assert worst_mas(tmp_path, path, pixels, tables, **files) < 0.1


def test_real_files_are_read_as_stwcs_uses_them(tmp_path, data_dir, idctab, pixels) -> None:
    """No CRPIX, no CRVAL: our reading of them is that of the installed astropy."""
    folder = data_dir / "hst_reference"
    path, tab = idctab
    files = {"D2IMFILE": folder / "02c1450oj_d2i.fits", "NPOLFILE": folder / "02c14514j_npl.fits"}
    tables = [*read_d2im(files["D2IMFILE"]), *read_npol(files["NPOLFILE"], tab)]
    assert {t.first for t in tables} == {(64.0, 64.0)}
    assert worst_mas(tmp_path, path, pixels, tables, **files) < 0.1
    # written anew with a registration they mean the same
    write_d2im(tables[:2], tmp_path / "new_d2i.fits")
    write_npol(tables[2:], tmp_path / "new_npl.fits", idctab=tab, filters=F606W)
    files = {"D2IMFILE": tmp_path / "new_d2i.fits", "NPOLFILE": tmp_path / "new_npl.fits"}
    assert worst_mas(tmp_path, path, pixels, tables, **files) < 0.1


def test_swapped_chips_would_be_seen(tmp_path, idctab, pixels) -> None:
    path, _ = idctab
    tables = [rough(c, 0.2, 1) for c in CHIPS]
    swapped = [LookupTable(3 - t.chip, t.values) for t in tables]
    file: LookupFile = write_d2im(swapped, tmp_path / "a_d2i.fits")
    write_lookup_file(file, tmp_path / "b_d2i.fits")
    worst = worst_mas(tmp_path, path, pixels, tables, D2IMFILE=tmp_path / "b_d2i.fits")
    assert worst > 10
