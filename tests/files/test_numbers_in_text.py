"""Cells of text tables are numbers as tables define them, not as Python or C does."""

from __future__ import annotations

import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from astropy.time import Time

from bayesdist.data import read_matches
from bayesdist.errors import InputError
from bayesdist.files.tables import read_table
from bayesdist.utils.text import number_of

NAMES = ("x", "y", "u", "v", "exposure")


def written(folder, end, cell, exposure="1_00"):
    """File with three rows, whose x in the second row is a given cell."""
    rows = [[x, "20.5", "3.25", "4.5", exposure] for x in ("1.5", cell, "7.25")]
    cells = {".csv": ",", ".tsv": "\t", ".dat": " ", ".ecsv": " "}
    if end == ".vot":
        fields = "".join(f'<FIELD name="{n}" datatype="double"/>' for n in NAMES[:4])
        fields += '<FIELD name="exposure" datatype="char" arraysize="*"/>'
        body = "".join(f"<TR>{''.join(f'<TD>{c}</TD>' for c in row)}</TR>" for row in rows)
        text = (
            '<?xml version="1.0" encoding="UTF-8"?><VOTABLE version="1.3" '
            'xmlns="http://www.ivoa.net/xml/VOTable/v1.3"><RESOURCE><TABLE>'
            f"{fields}<DATA><TABLEDATA>{body}</TABLEDATA></DATA></TABLE></RESOURCE></VOTABLE>"
        )
    elif end == ".tbl":
        kinds = ["double"] * 4 + ["char"]
        head = ["|".join(["", *(c.rjust(10) for c in line), ""]) for line in (NAMES, kinds)]
        text = "\n".join([*head, *(" " + " ".join(c.rjust(10) for c in r) for r in rows)]) + "\n"
    else:
        head = ""
        if end == ".ecsv":
            pairs = zip(NAMES, ["float64"] * 4 + ["string"], strict=True)
            listed = [f"# - {{name: {n}, datatype: {k}}}" for n, k in pairs]
            head = "\n".join(["# %ECSV 1.0", "# ---", "# datatype:", *listed]) + "\n"
        text = head + "\n".join(cells[end].join(row) for row in [NAMES, *rows]) + "\n"
    path = folder / f"table{end}"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("end", [".csv", ".tsv", ".dat", ".ecsv", ".tbl", ".vot"])
@pytest.mark.parametrize("cell", ["1_00", "１００", "٣", "0x1A", "0x1p3", "1e1_0", "1_0.5"])
def test_what_no_table_has_for_a_number_is_refused(tmp_path, end, cell):
    with pytest.raises(InputError, match=r"not a number|cannot be read"):
        read_matches(written(tmp_path, end, cell), unit="pix", sigma=0.01)


@pytest.mark.parametrize("end", [".csv", ".tsv", ".dat", ".ecsv", ".tbl", ".vot"])
@pytest.mark.parametrize("cell", ["\u00a02.5", "2.5\u00a0", "\u20032.5", "2.5\u3000"])
def test_blanks_of_other_scripts_are_no_part_of_a_number(tmp_path, end, cell):
    """Python strips U+00A0, which spreadsheets write between thousands, as it strips spaces."""
    with pytest.raises(InputError, match=r"not a number|cannot be read"):
        read_matches(written(tmp_path, end, cell), unit="pix", sigma=0.01)
    if end in (".csv", ".tsv", ".dat"):
        spaced = read_matches(written(tmp_path, end, " 2.5 "), unit="pix", sigma=0.01)
        assert spaced.x.tolist() == [1.5, 2.5, 7.25]


@pytest.mark.parametrize("end", [".ecsv", ".tbl", ".vot"])  # whose columns have types
@pytest.mark.parametrize("name", ["1_00", "１００", "0x1A"])
def test_names_of_exposures_may_look_like_such_numbers(tmp_path, end, name):
    matches = read_matches(written(tmp_path, end, "2.5", name), unit="pix", sigma=0.01)
    assert matches.x.tolist() == [1.5, 2.5, 7.25]
    assert matches.exposure_names == (name,)


@pytest.mark.parametrize("end", [".csv", ".tsv", ".ecsv", ".tbl"])
@pytest.mark.parametrize("cell", ["4\0.5", "\0", "2.5\0"])
def test_nul_is_refused_with_its_line(tmp_path, end, cell):
    """Readers in C end the cell there: 4.5 would be 4."""
    path = written(tmp_path, end, cell)
    line = 1 + path.read_text().partition("\0")[0].count("\n")
    with pytest.raises(InputError, match=f"line {line}: has a NUL character"):
        read_matches(path, unit="pix", sigma=0.01)


def test_coordinates_and_times_are_several_columns(tmp_path):
    """Columns of ECSV that astropy makes one object of."""
    path = tmp_path / "a.ecsv"
    QTable(
        {"exposure": ["1_00", "2_00"], "x": [1.25, 2.5] * u.pix, "y": [3.5, 4.5],
         "time": Time([58849.25, 58850.5], format="mjd"),
         "sky": SkyCoord([10.5, 11.5] * u.deg, [1.5, 2.5] * u.deg)}
    ).write(path)  # fmt: skip
    assert read_table(path)["sky"].ra.deg.tolist() == [10.5, 11.5]
    for number, name in (("1.25", "x"), ("11.5", "sky.ra"), ("4.5", "y")):
        changed = tmp_path / f"{name}.ecsv"
        text = path.read_text().replace(f" {number}", " 1_0")
        changed.write_text(text)
        with pytest.raises(
            InputError, match=f"column '{name}': '1_0' is not a number|cannot be read"
        ):
            read_table(changed)


@pytest.mark.parametrize("text", ["1", "-1.", "+.5", "1e5", " 2.5E-3\n", "nan", "-INF"])
def test_numbers_are_those_of_python(text):
    assert repr(number_of(text)) == repr(float(text))


@pytest.mark.parametrize("text", ["", "1_0", "0x1", "１", "1 2", "1e", "e5", ".", "1d5", "\u00a01"])
def test_other_texts_are_none(text):
    with pytest.raises(ValueError, match="not a number"):
        number_of(text)
