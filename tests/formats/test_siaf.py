"""SIAF tables of coefficients: pysiaf reads ours, and its own tables are read."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bayesdist.errors import FormatError, InputError
from bayesdist.formats.siaf.table import SiafTable
from bayesdist.products import registry
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import Choice

from .v2v3 import files, imager, read, same_calibration, some_pixels, with_tables

SIZE, PIXEL = (2048.0, 2048.0), 0.0656
SETTINGS = {"aperture": "NIS_CEN", "order": 6}
LIMIT = 1e-6  # pixels


@pytest.fixture(scope="module")
def calibration():
    """About the middle of the detector, which is where pysiaf's aperture has its reference."""
    made = imager(SIZE, PIXEL)
    [chip] = made.model.chips
    model = replace(made.model, chips=(replace(chip, reference_pixel=(1024.5, 1024.5)),))
    return replace(made, solution=replace(made.solution, model=model))


@pytest.fixture(scope="module")
def written(calibration, tmp_path_factory):
    """Table and side file in a folder."""
    folder = tmp_path_factory.mktemp("siaf")
    side, table = files("siaf", calibration, SETTINGS)
    for one in (side, table):
        (folder / one.file_name).write_bytes(one.content)
    return folder / table.file_name, folder / side.file_name


def changed(path: Path, *edits):
    """The document of a table whose rows (index, exponents, values) were edited."""
    head, rows = [], []
    for line in path.read_text().splitlines():
        if line.startswith("#") or "AperName" in line:
            head.append(line)
        else:
            rows.append([cell.strip() for cell in line.split(",")])
    for edit in edits:
        rows = edit(rows)
    text = "\n".join([*head, *(",".join(row) for row in rows)])
    return registry.recognized(Content("changed.txt", text.encode()))


# -- read back ------------------------------------------------------------------------------------


def test_a_table_with_its_side_file_is_the_same_calibration(calibration, written):
    document = registry.open_document(written[0])
    same_calibration(calibration, document.calibration())
    levels = {f.level for f in document.lint()}
    assert levels <= {"note"}
    assert "covariance" in document.describe()


def test_a_side_file_alone_is_the_same_calibration(calibration, written):
    document = registry.open_document(written[1])
    same_calibration(calibration, document.calibration())
    assert "covariance of the SIAF table of NIS_CEN" in document.describe()


def test_a_table_alone_has_the_map_without_errors(calibration, written, tmp_path):
    alone = tmp_path / "alone.txt"
    alone.write_bytes(written[0].read_bytes())
    found = registry.read_calibration(alone)
    x, y = some_pixels(calibration)
    far = found.forward(x, y, chip=1) - calibration.forward(x, y, chip=1)
    assert np.abs(far).max() < LIMIT * PIXEL and found.errors == "none"


def test_the_side_file_has_sigmas_and_covariance_of_the_coefficients(calibration, written):
    """Sci2IdlXnj multiplies x^(n-j) y^j: its variance is that of a fit's monomial."""
    side = json.loads(written[1].read_text())
    poly = calibration.chip(origin="stated").monomials()
    k = side["names"].index("Sci2IdlY31")  # x^2 y
    j = poly.index(2, 1) + len(poly.terms)
    assert side["values"][k] == poly.values[1, poly.index(2, 1)]
    assert_allclose(side["sigma"][k] ** 2, poly.cov[j, j], rtol=1e-12)
    assert_allclose(side["covariance"], poly.cov, rtol=1e-12)


def test_look_up_tables_are_left_out_and_that_is_said(calibration):
    _, table = files("siaf", with_tables(calibration, ""), SETTINGS)
    assert b"# Look-up tables are left out." in table.content
    x, y = some_pixels(calibration, 100)
    found = read(table).calibration()
    assert_allclose(found.forward(x, y, chip=1), calibration.forward(x, y, chip=1), atol=1e-9)


def test_a_mirrored_calibration_has_an_inverse_too():
    made = imager(SIZE, PIXEL, order=3)
    flipped = np.array(made.solution.mean)
    flipped[made.model.coefficient_slice(None, 1)] *= -1
    solution = replace(made.solution, mean=flipped)
    _, table = files("siaf", replace(made, solution=solution), SETTINGS)
    assert table.summary["closure_pix"] < 0.01
    assert any(f.message.startswith("parity") for f in read(table).lint())


# -- what reads them ------------------------------------------------------------------------------


def test_pysiaf_maps_pixels_as_we_do(calibration, written):
    """Aperture with the rows that pysiaf read: Sci to Ideal to 1e-6 px, and back as stated."""
    pytest.importorskip("pysiaf")
    from .siaf_aperture import aperture_of

    aperture = aperture_of(written[0])
    x, y = some_pixels(calibration)
    theirs = np.stack(aperture.sci_to_idl(x, y))
    ours = calibration.forward(x, y, chip=1).T
    assert np.hypot(*(ours - theirs)).max() / PIXEL < LIMIT
    back = np.stack(aperture.idl_to_sci(*theirs))
    document = registry.open_document(written[0])
    closure = document.holds.closure()
    assert np.hypot(*(back - [x, y])).max() <= closure * (1 + 1e-6) < 0.02
    # that of a calibration takes positions about the one of the reference pixel
    read_back = document.calibration()
    zero = read_back.forward([1024.5], [1024.5], chip=1).T
    assert np.hypot(*zero) / PIXEL > 0.1
    assert_allclose(read_back.inverses[1].pixels(*(ours - zero)), back, atol=LIMIT)
    worst, _ = read_back.inverses[1].misses(read_back.at(origin="chip")[1])
    assert worst == pytest.approx(closure, rel=0.05)


def test_the_polynomial_functions_read_our_order_of_coefficients(calibration, written):
    """pysiaf.utils.polynomial takes them row by row."""
    pytest.importorskip("pysiaf")
    from .siaf_aperture import pysiaf_offline

    pysiaf = pysiaf_offline()
    rows = pysiaf.iando.read.read_siaf_distortion_coefficients(file_name=str(written[0]))
    x, y = some_pixels(calibration, 300)
    order = int(max(rows["exponent_x"]))
    theirs = [
        pysiaf.polynomial.poly(np.array(rows[name]), x - 1024.5, y - 1024.5, order)
        for name in ("Sci2IdlX", "Sci2IdlY")
    ]
    ours = calibration.forward(x, y, chip=1).T
    assert np.hypot(*(ours - np.stack(theirs))).max() / PIXEL < LIMIT


def source_tables() -> list[Path]:
    """Tables of the observatory that pysiaf is made from."""
    from .siaf_aperture import pysiaf_offline

    folder = Path(pysiaf_offline().__file__).parent / "source_data"
    return sorted(folder.glob("*/*_siaf_distortion_*.txt"))


def test_tables_of_the_observatory_are_sound():
    """All of pysiaf: index order, parity and inverse are right, those of order 4 to 0.2 px."""
    pytest.importorskip("pysiaf")
    paths = source_tables()
    assert len(paths) > 20
    for path in paths:
        document = registry.open_document(path)
        assert not [f for f in document.lint() if f.level == "error"], path.name
        assert document.holds.aperture in document.describe()
        assert document.holds.closure() < 0.25
        assert document.calibration().model.order == document.holds.order


def test_tables_of_the_observatory_map_as_its_apertures_do():
    """An aperture of the delivered SIAF and the table that it was made from: the same positions."""
    pytest.importorskip("pysiaf")
    from .siaf_aperture import pysiaf_offline

    aperture = pysiaf_offline().Siaf("NIRISS")["NIS_CEN"]
    [path] = [p for p in source_tables() if p.name.endswith("nis_cen.txt")]
    found = registry.read_calibration(path)
    x, y = some_pixels(found, 300)
    theirs = np.stack(aperture.sci_to_idl(x, y))
    far = np.hypot(*(found.forward(x, y, chip=1).T - theirs))
    assert far.max() / PIXEL < LIMIT


def test_deliveries_have_the_linear_terms_of_the_tables(data_dir):
    """The newest of 39 deliveries against pysiaf's own tables: four coefficients of an aperture."""
    pytest.importorskip("pysiaf")
    with (data_dir / "siaf" / "jwst_siaf_history.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if re.fullmatch(r"PRDOPSSOC-\d+", row["prd"])]
    # those with a letter are of other series, before launch
    newest = {row["aperture"]: row for row in sorted(rows, key=lambda row: row["prd"])}
    compared = 0
    for path in source_tables():
        table = registry.open_document(path).holds
        if table.aperture not in newest or path.stem.endswith("oss"):
            continue
        row, x, y = newest[table.aperture], table.terms("Sci2IdlX"), table.terms("Sci2IdlY")
        ours = x[1, 0], y[0, 1], x[2, 0], x[3, 0]
        theirs = [float(row[f"sci2idl{n}"]) for n in ("x10", "y11", "x20", "x30")]
        assert int(row["deg"]) == table.order
        assert_allclose(ours, theirs, rtol=1e-9)
        compared += 1
    assert compared >= 3


# -- faults ---------------------------------------------------------------------------------------


def exchanged_exponents(rows):
    return [[r[0], r[1], r[3], r[2], *r[4:]] for r in rows]


def exchanged_columns(first):
    """Values of two columns at exchanged powers above the linear ones."""

    def edit(rows):
        by = {(r[2], r[3]): r for r in rows}
        out = []
        for r in rows:
            other = by[r[3], r[2]] if int(r[2]) + int(r[3]) > 1 else r
            values = [*r[4:]]
            values[first : first + 2] = other[4 + first : 6 + first]
            out.append([*r[:4], *values])
        return out

    return edit


def shifted(rows):
    """Rows whose Idl2SciX takes every position three pixels too far."""
    return [
        [*r[:6], repr(float(r[6]) + 3), *r[7:]] if int(r[2]) + int(r[3]) == 0 else r for r in rows
    ]


def scaled(columns, factor):
    def edit(rows):
        return [
            [*r[:4], *(repr(float(v) * (factor if k in columns else 1)) for k, v in
                       enumerate(r[4:]))]
            for r in rows
        ]  # fmt: skip

    return edit


@pytest.mark.parametrize(
    ("edit", "level", "where", "message"),
    [
        (exchanged_exponents, "error", "line", "powers of x and y are exchanged"),
        (exchanged_columns(2), "error", "Idl2SciX, Idl2SciY", "order of coefficients"),
        (exchanged_columns(0), "error", "Sci2IdlX, Sci2IdlY", "order of coefficients"),
        (scaled((2, 3), 0.0), "error", "Idl2SciX, Idl2SciY", "the inverse is missing"),
        (scaled((1,), -1.0), "error", "Sci2IdlX, Sci2IdlY", "parity"),
        (scaled((0, 1), 1 / 3600), "error", "Sci2IdlX, Sci2IdlY", "arcsec (in degrees: 0.065"),
        (shifted, "error", "Idl2SciX, Idl2SciY", "the constant terms are off by 3 and "),
        (scaled((2,), 1.001), "error", "Idl2SciX, Idl2SciY", "miss the inverse of Sci2Idl"),
        (lambda rows: rows[:5] + rows[6:], "error", "22", "there is no row"),
        (lambda rows: [*rows, rows[3]], "error", "20", "more than one row"),
    ],
)
def test_faults_are_found(written, edit, level, where, message):
    found = changed(written[0], edit).lint()
    assert any(
        f.level == level and f.where.startswith(where) and message in f.message for f in found
    ), [str(f) for f in found]


def test_a_side_file_that_is_gone_is_missed(written, tmp_path):
    table = tmp_path / written[0].name
    table.write_bytes(written[0].read_bytes())
    document = registry.open_document(table)
    assert [f.level for f in document.lint() if f.where == "covariance"] == ["warning"]
    found = document.calibration()
    assert found.errors == "none" and f"{written[1].name}, which is not here" in found.notes[0]


def test_a_side_file_of_another_table_lends_no_errors(written, tmp_path):
    table, side = (tmp_path / path.name for path in written)
    text = written[0].read_text().splitlines()
    at = next(k for k, line in enumerate(text) if ",         20 ," in line)
    cells = text[at].split(",")
    cells[4] = repr(float(cells[4]) + 1e-8)
    text[at] = ",".join(cells)
    table.write_text("\n".join(text))
    side.write_bytes(written[1].read_bytes())
    document = registry.open_document(table)
    assert any(f.where == "covariance" and f.level == "error" for f in document.lint())
    found = document.calibration()
    assert found.errors == "none" and "without its covariance" in found.notes[0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("AperName,siaf_index,exponent_x\nA,00,0\n", "columns exponent_y, Sci2IdlX, .* missing"),
        (
            "AperName,siaf_index,exponent_x,exponent_y,Sci2IdlX,Sci2IdlY,Idl2SciX,Idl2SciY\n",
            "there are no rows",
        ),
        (
            "AperName,siaf_index,exponent_x,exponent_y,Sci2IdlX,Sci2IdlY,Idl2SciX,Idl2SciY\n"
            "A,10,1,0,0.1,x,1,1\n",
            "line 2: 'x' is not a finite number",
        ),
        (
            "AperName,siaf_index,exponent_x,exponent_y,Sci2IdlX,Sci2IdlY,Idl2SciX,Idl2SciY\n"
            "A,10,1,0,0.1\n",
            "has 5 values, but there are 8 columns",
        ),
        (
            "AperName,siaf_index,exponent_x,exponent_y,Sci2IdlX,Sci2IdlY,Idl2SciX,Idl2SciY\n"
            "A,00,0,0,0,0,0,0\nB,10,1,0,1,1,1,1\n",
            "holds the apertures A, B",
        ),
        ('{"siaf_covariance": 1, "table"', "is not an auxiliary file"),
    ],
)
def test_broken_tables_are_refused_in_a_sentence(text, message):
    with pytest.raises(FormatError, match=message):
        registry.recognized(Content("broken.txt", text.encode()))


def test_an_unknown_aperture_needs_a_size(calibration):
    _, table = files("siaf", calibration, {"aperture": "MADE_UP"})
    text = "\n".join(
        line
        for line in table.content.decode().splitlines()
        if not line.startswith("# XSci") and not line.startswith("# YSci")
    )
    document = registry.recognized(Content("table.txt", text.encode()))
    assert "size of the detector is unknown" in document.describe()
    with pytest.raises(InputError, match="MADE_UP is not a known full frame"):
        document.calibration()
    assert document.calibration(Choice(size=SIZE)).model.chips[0].size == SIZE


def test_a_subarray_is_not_taken_for_the_full_frame(data_dir):
    """Its size is asked for, and the positions are then those of pysiaf's own aperture."""
    pytest.importorskip("pysiaf")
    from .siaf_aperture import pysiaf_offline

    document = registry.open_document(data_dir / "reports" / "siaf_NRCA5_SUB320.txt")
    with pytest.raises(InputError, match=r"NRCA5_SUB320 is not a known full frame.*--size"):
        document.calibration()
    found = document.calibration(Choice(size=(320.0, 320.0)))
    assert found.model.chips[0].size == (320.0, 320.0)
    assert any("XSciRef, YSciRef are not stated" in note for note in found.notes)
    aperture = pysiaf_offline().Siaf("NIRCam")["NRCA5_SUB320"]
    x, y = some_pixels(found, 300)
    theirs = np.stack(aperture.sci_to_idl(x, y))
    assert np.hypot(*(found.forward(x, y, chip=1).T - theirs)).max() / 0.063 < LIMIT


def test_full_frames_have_the_size_and_reference_pixel_of_pysiaf():
    pytest.importorskip("pysiaf")
    from .siaf_aperture import pysiaf_offline

    module = pysiaf_offline()
    names = {"NIRCam": "NRCA1_FULL NRCB5_FULL", "NIRISS": "NIS_CEN", "FGS": "FGS1_FULL FGS2_FULL",
             "MIRI": "MIRIM_FULL", "Roman": "WFI01_FULL"}  # fmt: skip
    for instrument, apertures in names.items():
        siaf = module.Siaf(instrument)
        for name in apertures.split():
            table, known = SiafTable("t", name, (), {}), siaf[name]
            assert table.size == (known.XSciSize, known.YSciSize), name
            assert table.reference_pixel(table.size) == (known.XSciRef, known.YSciRef), name


def test_a_size_that_is_not_that_of_the_aperture_is_refused(written):
    document = registry.open_document(written[0])
    assert document.calibration(Choice(size=SIZE)).model.chips[0].size == SIZE
    with pytest.raises(InputError, match="has 2048 x 2048 pixels, but 320 x 320 are given"):
        document.calibration(Choice(size=(320.0, 320.0)))


def test_an_aperture_has_a_name(calibration):
    with pytest.raises(InputError, match="the aperture has no name"):
        files("siaf", calibration, {})
