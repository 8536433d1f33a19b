"""Tables that end too early are refused, or said to; what is whole is read."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from astropy.table import Table

import bayesdist as bd
from bayesdist.app.screen import _Once
from bayesdist.errors import FormatError
from bayesdist.files.tables import read_table
from bayesdist.products.common.content import read_content
from bayesdist.products.registry import open_document
from tests.app.support import good

KINDS = {
    "a.ecsv": {"format": "ascii.ecsv"},
    "b.ecsv": {"format": "ascii.ecsv", "delimiter": ","},
    "c.csv": {"format": "ascii.csv"},
    "d.tsv": {"format": "ascii.tab"},
    "e.txt": {"format": "ascii.basic"},
}


@pytest.fixture(params=KINDS)
def written(request, rng, tmp_path):
    """A table whose last column has four decimals, and its bytes without the last line end."""
    table = Table({name: rng.normal(size=30) for name in "xyv"})
    table["u"] = np.round(10 + rng.integers(100, 999, 30) / 1000 + 1e-4, 4)
    path = tmp_path / request.param
    table.write(path, **KINDS[request.param])
    assert len(read_table(path)) == 30
    return path, path.read_bytes().rstrip(b"\r\n")


@pytest.mark.parametrize("lost", [1, 2, 5])
def test_a_last_number_without_its_last_letters(written, lost):
    path, raw = written
    path.write_bytes(raw[:-lost])
    with pytest.raises(FormatError, match="ends within its last number"):
        read_table(path)


def test_a_last_row_without_its_last_cell(written):
    path, raw = written
    path.write_bytes(raw[:-8])
    with pytest.raises(FormatError, match="truncated"):
        read_table(path)


def test_a_whole_row_without_an_end_of_line(written, caplog):
    path, raw = written
    path.write_bytes(raw)
    with caplog.at_level(logging.WARNING, "bayesdist"):
        assert len(read_table(path)) == 30
    assert f"{path}: its last line has no end" in caplog.text


def test_numbers_in_full_precision_are_warned_of_or_refused_when_little_is_left(tmp_path, caplog):
    path = tmp_path / "a.csv"
    values = np.random.default_rng(1).normal(size=20)
    text = "x,u\n" + "\n".join(f"{k},{v!r}" for k, v in enumerate(values.tolist()))
    path.write_text(text[:-2])
    with caplog.at_level(logging.WARNING, "bayesdist"):
        assert abs(read_table(path)["u"][-1] - values[-1]) < 1e-12
    assert "no end" in caplog.text
    path.write_text(text[: text.rindex(",") + 5])
    with pytest.raises(FormatError, match="ends within its last number"):
        read_table(path)


def test_open_quotation_marks_swallow_no_rows(tmp_path, rng):
    """One in the last column, and two, between which rows would be the text of a cell."""
    table = Table({name: rng.normal(size=30).round(4) for name in "xyuv"})
    table["name"] = [f"star{k}" for k in range(30)]
    for name, options in KINDS.items():
        path = tmp_path / name
        table.write(path, **options)
        assert list(read_table(path)["name"]) == list(table["name"])
        lines = path.read_text().splitlines()
        for rows in ([10], [10, 20]):
            damaged = list(lines)
            for row in rows:
                damaged[row] = damaged[row][: damaged[row].rfind("star")].rstrip('"') + '"'
            path.write_text("\n".join(damaged) + "\n")
            with pytest.raises(FormatError, match=r"cells|quotation mark|cannot be read as"):
                read_table(path)


@pytest.mark.parametrize("first", ["name,x,y", "# name x y"])
def test_the_line_of_an_open_quotation_mark_counts_comments(tmp_path, first):
    path = tmp_path / "stars.csv"
    text = f'# a\n# b\n{first}\na,1,2\n"b,3,4\nc,5,6\n"d,7,8\n'
    path.write_text(text.replace(",", " ") if first[0] == "#" else text)
    with pytest.raises(FormatError, match=r"line 5: .*quotation mark"):
        read_table(path)


@pytest.mark.parametrize(
    "text",
    [
        'name,x,y,u,v\na,1,2,3,4\n"b,1,2,3,4\n',  # in the last row
        'name,x,y,u,v\na,1,2,3,4\nb,1,2,3,"4\n',
        'name,x,y,u,v\na,1,2,3,4\n"b,1,,,\nc",3,4,5,6\nd,1,2,3,4\n',  # of empty cells
        'name x y u v\na 1 2 3 4\n"b 1 2 3 4\n',
    ],
)
def test_open_quotation_marks_of_few_numbers(tmp_path, text):
    path = tmp_path / "stars.csv"
    path.write_text(text)
    with pytest.raises(FormatError, match=r"line 3: .*quotation mark|row 2: has 1 of 5 cells"):
        read_table(path)


def test_cells_with_line_breaks_are_read(tmp_path, rng):
    table = Table({name: rng.normal(size=30).round(4) for name in "xyuv"})
    table["note"] = [
        "in 2 visits, of\nwhich one is 1.5 s, and blended" if k % 7 else "none" for k in range(30)
    ]
    for name, options in KINDS.items():
        if options["format"] not in ("ascii.tab", "ascii.basic"):  # astropy cannot read those again
            path = tmp_path / name
            table.write(path, **options)
            assert list(read_table(path)["note"]) == list(table["note"])


def test_a_fits_file_that_does_not_end_with_its_last_hdu(tmp_path):
    """The objects of a further chip may be missing."""
    path = tmp_path / "stars.fits"
    Table({"x": [1.0, 2.0]}).write(path)
    raw = path.read_bytes()
    for damaged, message in (
        (raw[:-1], r"its HDUs take up"),
        (raw + b"XTENS", r"5 bytes after its last HDU"),
        (raw + b"XTENSIOM= 'BINTABLE'" + bytes(2860), r"20 bytes after its last HDU"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(FormatError, match=message):
            read_table(path)
        with pytest.raises(FormatError, match=message):
            open_document(path)
    # as on tapes; as test data of astropy.wcs; as other programs leave them
    for more in (bytes(2880), b" " * 240, bytes(512), b"\n", b"\0\r\n"):
        path.write_bytes(raw + more)
        assert len(read_table(path)) == 2


@pytest.mark.parametrize(
    ("stated", "says"),
    [(2, True), (1, False), (0, False), ("'two'", False), ("1 2 3", False), (None, False)],
)
def test_a_fits_file_that_was_cut_between_two_hdus(tmp_path, caplog, stated, says):
    """HST states the number of extensions in the primary header."""
    path = tmp_path / "stars.fits"
    Table({"x": [1.0, 2.0]}).write(path)
    raw = path.read_bytes()
    if stated is not None:
        card = f"NEXTEND = {stated}".ljust(80).encode()
        end = raw.index(b"END" + 77 * b" ")
        raw = raw[:end] + card + raw[end : end + 80] + raw[end + 160 :]
    path.write_bytes(raw)
    for read in (read_table, read_content):
        caplog.clear()
        read(path)
        warned = [r for r in caplog.records if "states 2 extensions (NEXTEND)" in r.message]
        assert len(warned) == says
    columns = {"x": [1.0, 900.0], "y": [2.0, 800.0], "u": [1.0, 900.0], "v": [2.0, 800.0]}
    notes = bd.Matches.from_table(
        Table(columns, meta=read_table(path).meta), unit="pix", sigma=0.1
    ).notes
    assert any("states 2 extensions (NEXTEND)" in note for note in notes) == says


def test_a_command_shows_a_warning_of_a_file_once_and_as_a_warning(tmp_path):
    """`init` reads a table several times, and `check` also states what it has read."""
    rng = np.random.default_rng(5)
    x, y = rng.uniform(1, 1000, (2, 300))
    u, v = x - 500 + 0.05 * rng.normal(size=300), y - 500 + 0.05 * rng.normal(size=300)
    path = tmp_path / "stars.fits"
    Table({"x": x, "y": y, "u": u, "v": v, "mag": rng.uniform(14, 20, 300)}).write(path)
    raw = path.read_bytes()
    end = raw.index(b"END" + 77 * b" ")
    card = b"NEXTEND = 3".ljust(80)
    path.write_bytes(raw[:end] + card + raw[end : end + 80] + raw[end + 160 :])
    err = good("init", tmp_path / "config.toml", "--matches", path).err
    lines = [line for line in err.splitlines() if "NEXTEND" in line]
    assert len(lines) == 1
    assert lines[0].startswith("WARNING: ")
    shown = good("check", tmp_path / "config.toml")
    lines = [line for line in (shown.out + shown.err).splitlines() if "NEXTEND" in line]
    assert len(lines) == 1
    assert lines[0].startswith("WARNING: ") and "fetch the whole file" in lines[0]


def test_missing_extensions_leave_a_verdict_as_it_is(tmp_path):
    """The rows that were read are those of a whole table."""
    rng = np.random.default_rng(6)
    x, y = rng.uniform(1, 1000, (2, 400))
    u, v = np.stack([x, y]) - 500 + 0.02 * rng.normal(size=(2, 400))
    path = tmp_path / "stars.fits"
    Table({"x": x, "y": y, "u": u, "v": v}).write(path)
    raw = path.read_bytes()
    end = raw.index(b"END" + 77 * b" ")
    raw = raw[:end] + b"NEXTEND = 3".ljust(80) + raw[end : end + 80] + raw[end + 160 :]
    path.write_bytes(raw)
    run = bd.calibrate(
        read_table(path),
        order=2,
        size=(1000, 1000),
        requirements=bd.Requirement("field", "p95", 0.2),
        catalogue=bd.Catalogue("exact", sigma=0.0005, unit="pix", source="simulated"),
        sigma=0.02,
        settings={"data": {"unit": "pix"}, "sampler": {"target_ess": 400}},
    )
    [margin] = run.check()
    assert margin.verdict == "met"
    [check] = [check for check in run.checks if "NEXTEND" in check.sentence]
    assert (check.level, check.doubt) == ("warn", "")


def test_only_repeated_warnings_are_left_out():
    """Stages say a warning again after their names; errors and results are never left out."""
    passes = _Once().filter

    def said(level: int, text: str) -> bool:
        return passes(logging.makeLogRecord({"levelno": level, "msg": text}))

    assert said(logging.WARNING, "a file is cut")
    assert not said(logging.WARNING, "a file is cut")
    assert not said(logging.WARNING, "evaluate: WARNING: a file is cut")
    assert said(logging.WARNING, "evaluate: WARNING: another file is cut")
    for level in (logging.INFO, logging.ERROR):
        assert said(level, "a file is cut") and said(level, "a file is cut")
