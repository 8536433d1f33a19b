"""D2IMFILE and NPOLFILE as files: nothing is lost, the real ones are read, defects are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from numpy.testing import assert_allclose, assert_array_equal

from bayesdist.errors import BayesdistError, DegenerateError, FormatError, InputError
from bayesdist.formats.idctab.build import idctab_from_solution
from bayesdist.formats.idctab.table import IdcTab
from bayesdist.formats.lookup.file import LookupFile, read_lookup_file, write_lookup_file
from bayesdist.formats.lookup.format import lint_lookup_file
from bayesdist.formats.lookup.tables import read_d2im, read_npol, write_d2im, write_npol
from bayesdist.model.lookup import LookupTable
from bayesdist.products import describe
from bayesdist.products.common.content import read_content

from .support import F606W, some_solution, wfc_solution

D2IM, NPOL_606, NPOL_814 = "02c1450oj_d2i.fits", "02c14514j_npl.fits", "02c1450rj_npl.fits"


@pytest.fixture(scope="module")
def reference(data_dir) -> Path:
    return data_dir / "hst_reference"


@pytest.fixture(scope="module")
def turned() -> IdcTab:
    """A strong distortion of a mirrored, turned and oblong detector: nothing is near the unit."""
    solution = some_solution(4, unit="arcsec", pixel=0.13, angle=0.9, flip=True, strength=20.0)
    return idctab_from_solution(solution, instrument="WFC3", detector="IR", scale_arcsec=0.12)


def table(chip: int, rng, filter: str = "", shape=(32, 64), **names) -> LookupTable:
    values = rng.normal(size=(2, *shape)) * 0.1
    sigma = rng.uniform(0.005, 0.02, (2, *shape))
    return LookupTable(chip, values, filter, sigma=sigma, **names)


def small(rng) -> LookupTable:
    """For the detector of `turned`, 1200 x 900."""
    return table(1, rng, "F160W", (9, 13), first=(17.5, 21.0), step=(97.0, 107.5))


# -- nothing is lost -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [D2IM, NPOL_606, NPOL_814])
def test_a_real_file_is_written_back_bit_by_bit(reference, tmp_path, name) -> None:
    write_lookup_file(read_lookup_file(reference / name), tmp_path / name)
    assert (tmp_path / name).read_bytes() == (reference / name).read_bytes()


def test_d2im_keeps_everything_to_single_precision(rng, tmp_path) -> None:
    given = [table(c, rng, first=(1 / 3, 0.1), step=(64.0, 63.7)) for c in (1, 2)]
    write_d2im(given, tmp_path / "a_d2i.fits")
    read = read_d2im(tmp_path / "a_d2i.fits")
    assert [t.chip for t in read] == [2, 1]  # EXTVER 1 is chip 2
    for t in given:
        [back] = [b for b in read if b.chip == t.chip]
        assert (back.first, back.step, back.filter) == (t.first, t.step, "")
        assert_array_equal(back.values, t.values.astype(np.float32))
        assert_array_equal(back.sigma, t.sigma.astype(np.float32))
    write_d2im(read, tmp_path / "b_d2i.fits")
    assert (tmp_path / "a_d2i.fits").read_bytes() == (tmp_path / "b_d2i.fits").read_bytes()


def test_npol_keeps_everything_to_single_precision(rng, tmp_path, turned) -> None:
    """There and back through the polynomial's derivatives; a second time the same numbers."""
    given = small(rng)
    write_npol([given], tmp_path / "a_npl.fits", idctab=turned, filters=["F160W"])
    [back] = read_npol(tmp_path / "a_npl.fits", turned)
    assert (back.chip, back.filter, back.first, back.step) == (1, "F160W", given.first, given.step)
    assert_allclose(back.values, given.values, atol=1e-7)
    assert_allclose(back.sigma, given.sigma, atol=1e-7)
    write_npol([back], tmp_path / "b_npl.fits", idctab=turned, filters=["F160W"])
    a, b = (read_lookup_file(tmp_path / f"{n}_npl.fits") for n in "ab")
    assert_array_equal(a.values(1), b.values(1))


@pytest.mark.parametrize("name", [NPOL_606, NPOL_814])
def test_a_real_npolfile_survives_the_way_through_our_tables(
    reference, tmp_path, real, name
) -> None:
    source = read_lookup_file(reference / name)
    tables = read_npol(reference / name, real)
    assert {t.filter for t in tables} == {"F606W" if name == NPOL_606 else "F814W"}
    write_npol(tables, tmp_path / "a_npl.fits", idctab=real, filters=source.filters)
    again = read_lookup_file(tmp_path / "a_npl.fits")
    assert again.filters == source.filters
    for chip in (1, 2):
        # a zero comes back as 1e-19 pixel
        assert_allclose(again.values(chip), source.values(chip), rtol=0, atol=1e-18)


# -- what the numbers mean -------------------------------------------------------------------------


def test_npol_is_the_shift_after_the_polynomial(rng, tmp_path, turned) -> None:
    """P(x + F) - P(x) by our own evaluation of the IDCTAB, in units of SCALE, to second order."""
    given = small(rng)
    tiny = LookupTable(1, given.values * 1e-3, "F160W", given.first, given.step)
    file = write_npol([tiny], tmp_path / "a_npl.fits", idctab=turned, filters=["F160W"])
    x, y = (a.ravel() for a in np.meshgrid(*tiny.nodes()))
    shift = tiny.evaluate(x, y)
    before = np.stack(turned.evaluate(1, x, y))
    after = np.stack(turned.evaluate(1, x + shift[:, 0], y + shift[:, 1]))
    expected = ((after - before) / 0.12).reshape(2, *tiny.shape)
    assert_allclose(file.values(1), expected, atol=1e-9)
    assert np.abs(expected - tiny.values).max() > 1e-4  # the two are not the same numbers


def test_the_stated_error_is_the_largest_anywhere(rng, tmp_path, turned) -> None:
    given = small(rng)
    file = write_npol([given], tmp_path / "a_npl.fits", idctab=turned, filters=["F160W"])
    stored = LookupTable(1, file.values(1), "", given.first, given.step)
    x, y = rng.uniform(0.5, 1200.5, 40_000), rng.uniform(0.5, 900.5, 40_000)
    shift = given.evaluate(x, y)
    both = np.stack(turned.evaluate(1, x + shift[:, 0], y + shift[:, 1]), axis=1) - np.stack(
        turned.evaluate(1, x, y), axis=1
    )
    error = np.hypot(*(both - 0.12 * stored.evaluate(x, y)).T).max() * 1e3
    stated = file.header["BDNPLERR"]
    assert stated > 0.1  # of a distortion as strong as this one
    # stated is the maximum over nodes, halves and edges: elsewhere it is larger by little
    assert 0.8 * error < stated < 1.25 * error


def test_sigmas_are_those_of_draws(rng, tmp_path, turned) -> None:
    given = small(rng)
    file = write_npol([given], tmp_path / "a_npl.fits", idctab=turned, filters=["F160W"])
    differences = []
    for _ in range(20):
        moved = given.values + rng.normal(size=given.values.shape) * given.sigma
        draw = LookupTable(1, moved, "F160W", given.first, given.step)
        path = tmp_path / "draw_npl.fits"
        stored = write_npol([draw], path, idctab=turned, filters=["F160W"])
        differences.append(stored.values(1) - file.values(1))
    for axis in (0, 1):
        pulls = np.array(differences)[:, axis] / file.sigma(1)[axis]
        assert np.mean(pulls**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / pulls.size))
        # the linear terms of this detector mix the axes: unturned sigmas would not do
        wrong = np.array(differences)[:, axis] / given.sigma[axis]
        assert abs(np.mean(wrong**2) - 1.0) > 0.1


@pytest.mark.parametrize("names", [{}, {"first": (1.0, 1.0)}, {"first": (32.5, 32.5)}])
def test_a_real_d2imfile_is_registered_as_by_astropy_or_as_told(reference, names) -> None:
    tables = read_d2im(reference / D2IM, **names)
    assert [t.chip for t in tables] == [2, 1]
    with fits.open(reference / D2IM) as hdus:
        for version, t in enumerate(tables, start=1):
            assert t.shape == (32, 64) and t.step == (64.0, 64.0)
            assert t.first == names.get("first", (64.0, 64.0))
            for axis, name in enumerate(("DX", "DY")):
                assert_array_equal(t.values[axis], hdus[name, version].data)


def test_astropy_alone_reads_our_file_as_we_do(rng, tmp_path) -> None:
    """Without stwcs: its keywords written by hand, the extensions as they are."""
    [given] = write_and_read(tmp_path, [table(1, rng, first=(7.0, 20.5), step=(61.0, 65.0))])
    header = fits.Header({"NAXIS": 2, "NAXIS1": 4096, "NAXIS2": 2048})
    hdus = fits.HDUList([fits.PrimaryHDU()])
    with fits.open(tmp_path / "a_d2i.fits") as source:
        for axis, name in enumerate(("DX", "DY"), start=1):
            header[f"D2IMDIS{axis}"] = "Lookup"
            header[f"D2IM{axis}.EXTVER"] = axis
            header[f"D2IM{axis}.AXIS.1"], header[f"D2IM{axis}.AXIS.2"] = 1, 2
            hdu = fits.ImageHDU(source[name].data, source[name].header, name="D2IMARR")
            hdu.header["EXTVER"] = axis
            hdus.append(hdu)
    wcs = WCS(header, hdus)
    x, y = rng.uniform(-200, 4300, 1000), rng.uniform(-200, 2300, 1000)
    theirs = np.stack(wcs.det2im(x, y, 1), axis=1) - np.stack([x, y], axis=1)
    assert_allclose(given.evaluate(x, y), theirs, atol=1e-9)


def write_and_read(folder: Path, tables, **names) -> tuple[LookupTable, ...]:
    write_d2im(tables, folder / "a_d2i.fits", **names)
    return read_d2im(folder / "a_d2i.fits")


@pytest.mark.parametrize("sign", [-1.0, 0.0])
def test_a_table_of_zeros_or_of_one_sign(tmp_path, sign) -> None:
    tables = [LookupTable(c, np.full((2, 32, 64), 0.1 * sign)) for c in (1, 2)]
    read = write_and_read(tmp_path, tables)
    assert all(t.shape == (32, 64) for t in read)
    assert_allclose(np.concatenate([t.values for t in read]), 0.1 * sign, atol=1e-8)
    padded = read_lookup_file(tmp_path / "a_d2i.fits").planes
    for plane in padded:
        assert ("BDPAD" in plane.header) == (sign < 0)
        assert plane.values.max() >= 0
    assert lint_levels(read_lookup_file(tmp_path / "a_d2i.fits")) <= {"note", "warning"}


def lint_levels(file: LookupFile) -> set[str]:
    return {finding.level for finding in lint_lookup_file(file)}


def test_the_cards_say_what_the_user_knows(rng, tmp_path) -> None:
    long = "A line of history that is much longer than the seventy-two characters of a card. " * 2
    file = write_d2im(
        [table(1, rng), table(2, rng)], tmp_path / "a_d2i.fits", description="Words",
        useafter="Mar 01 2002 00:00:00", pedigree="INFLIGHT 01/05/2006", history=[long, "end"],
    )  # fmt: skip
    with fits.open(tmp_path / "a_d2i.fits", checksum=True) as hdus:
        hdus.verify("exception")
        header = hdus[0].header
        assert header["DESCRIP"] == "Words" and header["USEAFTER"] == "Mar 01 2002 00:00:00"
        assert " ".join(header["HISTORY"]).split() == [*long.split(), "end"]
        assert [h.name for h in hdus[1:5]] == ["DX", "DY", "DX", "DY"]
        assert all(h.name.startswith("SIGMA_") for h in hdus[5:])
    assert lint_lookup_file(file) == ()


# -- what is refused -------------------------------------------------------------------------------


def test_tables_that_do_not_belong_into_the_file(rng, tmp_path, turned) -> None:
    path = tmp_path / "x.fits"
    cases = [
        (InputError, "table of the detector", lambda: write_d2im([table(1, rng, "F606W")], path)),
        (InputError, "no look-up table is given", lambda: write_d2im([], path)),
        (InputError, "2 look-up tables of chip 1", lambda: write_d2im([table(1, rng)] * 2, path)),
        (InputError, "is not of F606W CLEAR2L, filter F606W",
         lambda: write_npol([table(1, rng)], path, idctab=turned, filters=F606W)),
        (InputError, "is not of F160W",
         lambda: write_npol([table(1, rng, "F125W")], path, idctab=turned, filters=["F160W"])),
        (InputError, "0 names",
         lambda: write_npol([small(rng)], path, idctab=turned, filters=[])),
        (InputError, "there is no row",
         lambda: write_npol([table(7, rng, "F160W")], path, idctab=turned, filters=["F160W"])),
    ]  # fmt: skip
    for kind, message, call in cases:
        with pytest.raises(kind, match=message):
            call()
    assert not list(tmp_path.iterdir())


def test_a_filter_that_the_idctab_does_not_have(rng, tmp_path, real) -> None:
    with pytest.raises(InputError, match="there is no row for filter"):
        write_npol(
            [table(1, rng, "F999W")], tmp_path / "x.fits", idctab=real, filters=["F999W", "CLEAR2L"]
        )


def test_a_singular_polynomial_is_refused(rng, tmp_path, data_dir, real) -> None:
    solution = wfc_solution(real)
    flat = idctab_from_solution(solution, instrument="ACS", detector="WFC", scale_arcsec=0.05)
    block = flat.hdus[1]
    data = fits.BinTableHDU.fromstring(block.to_bytes()).data.copy()
    data["CX11"] = data["CX10"] = 0.0
    broken = IdcTab(
        (flat.hdus[0], type(block)(block.cards, data.view(np.ndarray).tobytes())), "flat"
    )
    with pytest.raises(DegenerateError, match="the linear part is singular"):
        write_npol([table(1, rng, "F606W")], tmp_path / "x.fits", idctab=broken, filters=F606W)


def test_files_of_the_other_kind(reference, real) -> None:
    with pytest.raises(FormatError, match="is an NPOLFILE, not a D2IMFILE; read it with read_npol"):
        read_d2im(reference / NPOL_606)
    with pytest.raises(FormatError, match="is a D2IMFILE, not an NPOLFILE"):
        read_npol(reference / D2IM, real)
    with pytest.raises(FormatError, match="has no image extension DX or DY"):
        read_d2im(reference / "0461802ej_idc.fits")
    with pytest.raises(InputError, match="does not exist"):
        read_d2im(reference / "none.fits")


def test_a_detector_without_a_name_is_refused_by_its_file(rng, tmp_path) -> None:
    path = tmp_path / "d2i.fits"
    write_d2im([table(1, rng)], path, instrument="ACS", detector="WFC")
    found = path.read_bytes()
    card = found.index(b"DETECTOR=")
    path.write_bytes(
        found[:card] + b"DETECTOR=                1E400".ljust(80) + found[card + 80 :]
    )
    with pytest.raises(FormatError, match=r"d2i.fits, keyword DETECTOR: is inf; give a name"):
        _ = read_lookup_file(path).detector


# -- lint ------------------------------------------------------------------------------------------


def altered(source: Path, folder: Path, change) -> Path:
    """A copy of a file that `change` has edited."""
    path = folder / "altered.fits"
    with fits.open(source) as hdus:
        change(hdus)
        hdus.writeto(path, overwrite=True)
    return path


def drop(hdus, *keywords) -> None:
    for hdu in hdus:
        for keyword in keywords:
            hdu.header.remove(keyword, ignore_missing=True)


def swap(hdus) -> None:
    for hdu in hdus[1:]:
        hdu.header["CCDCHIP"] = 3 - hdu.header["CCDCHIP"]


def put_nan(hdus) -> None:
    hdus["DY", 2].data[3, 4] = np.nan


def negative(hdus) -> None:
    hdus["DX", 1].data[:] = -0.1 - np.abs(hdus["DX", 1].data)


def copy_chip(hdus) -> None:
    hdus["DX", 2].data = hdus["DX", 1].data


def lose(*name):
    def change(hdus) -> None:
        del hdus[hdus.index_of(name)]

    return change


DEFECTS = [
    (lambda h: drop(h, "CRPIX1", "CRPIX2", "CRVAL1", "CRVAL2"), "warning",
     "registration: without CRPIX and CRVAL astropy.wcs puts the first node at pixel (64, 64)"),
    (lambda h: drop(h, "CRVAL2"), "warning", "registration: CRVAL2 missing"),
    (lambda h: drop(h, "CDELT1"), "error", "CDELT1 missing: nodes are taken to be 1 pixel apart"),
    (lambda h: h["DX", 1].header.set("CRVAL1", 500.0), "warning", "the nodes span pixels 500 to"),
    (lambda h: h["DX", 1].header.set("CDELT1", 32.0), "error",
     "DX and DY differ in shape or registration: DX has 64 x 32 nodes from pixel (32.5, 32.5), 32"),
    (swap, "warning", "the chips may be swapped"),
    (lambda h: drop(h, "CCDCHIP"), "error", "no CCDCHIP"),
    (put_nan, "error", "DY,2: 1 nodes are not finite"),
    (negative, "error", "below zero"),
    (copy_chip, "warning", "DX,1, DX,2: the same values"),
    (lambda h: drop(h, "INSTRUME"), "error", "INSTRUME: is missing"),
    (lambda h: drop(h, "USEAFTER"), "note", "USEAFTER: is missing"),
    (lose("SIGMA_DX", 1), "warning", "SIGMA_DY has no SIGMA_DX beside it"),
    (lambda h: h["SIGMA_DX", 2].data.__imul__(-1.0), "warning", "SIGMA_DX,2: some sigmas"),
]  # fmt: skip


@pytest.fixture(scope="module", params=["d2im", "npol"])
def good(request, tmp_path_factory, real) -> Path:
    """A file of ours without a fault."""
    rng = np.random.default_rng(3)
    path = tmp_path_factory.mktemp("good") / f"{request.param}.fits"
    words = {"useafter": "Mar 01 2002 00:00:00", "pedigree": "INFLIGHT 01/05/2006"}
    name = "" if request.param == "d2im" else "F606W"
    tables = [table(c, rng, name) for c in (1, 2)]
    if name:
        write_npol(tables, path, idctab=real, filters=F606W, **words)
    else:
        write_d2im(tables, path, **words)
    return path


def test_a_good_file_is_clean(good) -> None:
    assert lint_lookup_file(read_lookup_file(good)) == ()


@pytest.mark.parametrize(("change", "level", "message"), DEFECTS)
def test_each_defect_is_found(good, tmp_path, change, level, message) -> None:
    findings = lint_lookup_file(read_lookup_file(altered(good, tmp_path, change)))
    text = "\n".join(str(f) for f in findings if f.level == level or not level)
    assert message in text
    assert bool(findings) == bool(level)


@pytest.mark.parametrize("name", [("DY", 1), ("DX", 2)])
def test_a_lost_extension_is_worse_in_an_npolfile(good, tmp_path, name) -> None:
    path = altered(good, tmp_path, lose(*name))
    levels = {f.level for f in lint_lookup_file(read_lookup_file(path)) if name[0] in f.message}
    assert levels == ({"error"} if good.stem == "npol" else {"warning"})


def test_a_file_that_lint_calls_broken_is_not_read(good, tmp_path, real) -> None:
    def read(path):
        return read_d2im(path) if good.stem == "d2im" else read_npol(path, real)

    for change, message in (
        (put_nan, "value of y at node row 4, column 5 is nan"),
        (lose("DY", 1), "there are 0 extensions DY"),
        (lambda h: h["DX", 1].header.set("CRVAL1", 500.0), "DX and DY differ"),
        (lambda h: h["DX", 1].header.set("CRVAL1", "left"), "CRVAL1: is 'left'"),
    ):
        with pytest.raises(BayesdistError, match=message) as caught:
            read(altered(good, tmp_path, change))
        assert "altered.fits" in str(caught.value)


def test_real_files_lack_their_registration_and_nothing_else(reference) -> None:
    for name in (D2IM, NPOL_606, NPOL_814):
        [finding] = lint_lookup_file(read_lookup_file(reference / name))
        assert finding.level == "warning"
        assert "puts the first node at pixel (64, 64), before its version 6.1 at (1, 1)" in str(
            finding
        )


# -- in words --------------------------------------------------------------------------------------


def test_a_real_file_in_words(reference) -> None:
    text = describe(reference / D2IM)
    for part in ("D2IMFILE of ACS/WFC, 2 chip(s)", "chip 2: 64 x 32 nodes, first at pixel (64, 64)",
                 "step 64 x 64", "registration"):  # fmt: skip
        assert part in text
    with fits.open(reference / D2IM) as hdus:
        data = hdus["DY", 2].data.astype(float)
    lines = text[text.index("chip 1:") :].splitlines()
    [row] = [line.split() for line in lines if line.split()[:1] == ["DY"]]
    expected = [data.min(), data.max(), np.sqrt(np.mean(data**2))]
    assert_allclose([float(v) for v in row[1:]], expected, atol=5e-5)
    assert "filters   CLEAR1L F814W" in describe(reference / NPOL_814)


def test_our_own_file_shows_its_sigmas(good) -> None:
    text = describe(good)
    assert "median sigma" in text and "Findings: none" in text
    file = read_lookup_file(good)
    for chip in (1, 2):
        for sigma in file.sigma(chip):
            assert f"{np.median(sigma):.4f}" in text
    assert ("error of the linear form" in text) == (good.stem == "npol")


def test_compressed_tables_are_named(tmp_path):
    path = tmp_path / "a.fits"
    tables = [fits.CompImageHDU(np.zeros((32, 64), np.float32), name=name) for name in ("DX", "DY")]
    fits.HDUList([fits.PrimaryHDU(), *tables]).writeto(path)
    with pytest.raises(FormatError, match=r"a\.fits: extension DX,1 is a compressed image"):
        read_lookup_file(path)
    with pytest.raises(FormatError, match="extension DY,1 is a compressed image"):
        read_content(path).hdus[2].image  # noqa: B018
