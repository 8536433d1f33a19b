"""Tables as text, chips by name, pixels from 0, and what is none of these."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time

from bayesdist.data import ReadOptions, open_matches, read_matches
from bayesdist.data.reading.columns import numbered
from bayesdist.data.tables.names import ALIASES
from bayesdist.errors import InputError
from bayesdist.files.tables import read_table
from bayesdist.files.text_tables import is_text_table
from tests.data.tables import matches_from_table


def stars(n=6, **more):
    k = np.arange(1.0, n + 1)
    return Table({"x": 100 * k, "y": 50 * k + k**2, "u": k, "v": 2 * k, **more})


def test_numbers_without_names_are_refused(tmp_path):
    path = tmp_path / "stars.txt"
    path.write_text("1 2 3 4\n5 6 7 8\n")
    with pytest.raises(InputError, match=r"stars\.txt: is of an unknown kind"):
        read_matches(path, sigma=1.0, unit="pix")
    path.write_text("# made by hand\n1 2 3 4\n5 6 7 8\n")  # three words, four columns
    assert not is_text_table(path.read_text().splitlines())
    path = tmp_path / "stars.tbl"
    path.write_text("1 2 3 4\n5 6 7 8\n")
    with pytest.raises(InputError, match="no line with the names of its columns; write one"):
        read_matches(path, sigma=1.0, unit="pix")


def test_numbers_in_the_first_line_of_a_csv_are_no_names(tmp_path):
    rows = "".join(f"{r['x']},{r['y']},{r['u']},{r['v']}\n" for r in stars())
    path = tmp_path / "stars.csv"
    for text in (rows, "# x,y,u,v\n" + rows, rows.replace(",", ";"), rows.replace(".0", "")):
        path.write_text(text)
        with pytest.raises(InputError, match="no line with the names of its columns: the first"):
            read_matches(path, sigma=1.0, unit="pix")
    path.with_suffix(".tsv").write_text(rows.replace(",", "\t"))
    with pytest.raises(InputError, match="no line with the names of its columns: the first"):
        read_matches(path.with_suffix(".tsv"), sigma=1.0, unit="pix")
    path.write_text("x,y,u,v,606,814\n1.5,2,3,4,5,6\n7,8,9,1,2,3\n")  # magnitudes by filter
    assert read_matches(path, sigma=1.0, unit="pix").x.tolist() == [1.5, 7]


def written(path, head, rows, mark, comma=False, end="\n"):
    lines = [mark.join(f"{value:.2f}" for value in row) for row in rows]
    lines = [line.replace(".", ",") for line in lines] if comma else lines
    path.write_text(end.join([head, *lines, ""]), encoding="utf-8", newline="")
    return path


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize(
    ("name", "head", "mark", "comma"),
    [
        ("a.csv", "\ufeffx,y,u,v", ",", False),
        ("a.csv", "x;y;u;v", ";", False),
        ("a.csv", "x;y;u;v", ";", True),
        ("a.tsv", "x\ty\tu\tv", "\t", True),
        ("a.txt", "\ufeffx;y;u;v", ";", True),
        ("a.txt", "x y u v", " ", True),
        ("a.txt", "x y\tu v", " ", False),  # one tab among blanks
        ("a.txt", "x\ty\tu\tv", "   ", False),
        ("a.txt", "x y u v", "\t", False),
        ("a.txt", "# x y\tu v", " ", False),
        ("a.txt", "x\ty\tu\tv\t", "\t", False),  # a tab at the end
        ("a.csv", "x,y,u,v,", ",", False),
        ("a.csv", "x y u v", " ", False),  # other marks than the extension says
        ("a.csv", "x\ty\tu\tv", "\t", False),
        ("a.tsv", "x,y,u,v", ",", False),
        ("a.tsv", "x y\tu v", "  ", False),
    ],
)
def test_marks_of_text_tables(tmp_path, name, head, mark, comma, end):
    rows = [[k + 0.25, 1000 * k + 0.5, -k - 0.75, 3.0 * k] for k in range(1, 6)]
    m = read_matches(
        written(tmp_path / name, head, rows, mark, comma, end), sigma=1.0, unit="arcsec"
    )
    np.testing.assert_array_equal(np.transpose([m.x, m.y, m.u, m.v]), rows)


@pytest.mark.parametrize(
    ("row", "why"),
    [("1,234;2,345;3,5;4.5", "others points: 4.5"), ("1,234;2,345;3;4", "divide thousands")],
)
def test_commas_that_are_perhaps_not_decimal_are_refused(tmp_path, row, why):
    path = tmp_path / "a.csv"
    path.write_text(f"x;y;u;v\n{row}\n")
    with pytest.raises(InputError, match=rf"a\.csv: some numbers have commas \(1,234\).*{why}"):
        read_matches(path, sigma=1.0, unit="pix")


@pytest.mark.parametrize(
    ("x", "y", "mag"),
    [("pixel_centroid_x", "pixel_centroid_y", "auto_mag"), ("x_psf", "y_psf", "mag_data")],
)
def test_names_of_sourcextractor_plus_plus_and_of_lists_of_psf_fits(x, y, mag):
    table = stars(mag=np.arange(6.0))
    table.rename_columns(("x", "y", "mag"), (x, y, mag))
    m = matches_from_table(table, ReadOptions(unit="pix", sigma=1.0))
    assert m.x.tolist() == stars()["x"].tolist() and m.mag.tolist() == list(range(6))
    assert m.y.tolist() == stars()["y"].tolist()


def test_a_truncated_ipac_table_is_refused(tmp_path):
    path = tmp_path / "stars.txt"
    stars().write(path, format="ascii.ipac")
    assert len(read_matches(path, sigma=1.0, unit="pix")) == 6
    path.write_text(path.read_text()[:-9])
    with pytest.raises(InputError, match=r"stars\.txt, row 6: ends after"):
        read_matches(path, sigma=1.0, unit="pix")


@pytest.mark.parametrize("mark", [",", ";", "\t"])
@pytest.mark.parametrize("name", ["a.txt", "a.csv", "a.tsv"])
def test_a_row_without_all_cells_is_refused_whatever_the_mark(tmp_path, name, mark):
    path = tmp_path / name
    path.write_text("x,y,u,v\n1,2,3,4\n5,6,7\n8,9,1,2\n".replace(",", mark))
    with pytest.raises(InputError, match=r"row 2: has 3 of 4 cells"):
        read_matches(path, sigma=1.0, unit="pix")


@pytest.mark.parametrize("suffix", ["csv", "tsv"])
def test_a_row_that_is_cut_short_is_refused(tmp_path, suffix):
    path = tmp_path / f"stars.{suffix}"
    stars().write(path, format={"csv": "ascii.csv", "tsv": "ascii.tab"}[suffix])
    text = path.read_text()
    assert len(read_matches(path, sigma=1.0, unit="pix")) == 6
    path.write_text(text[: text.rindex("," if suffix == "csv" else "\t")])
    with pytest.raises(InputError, match=rf"stars\.{suffix}, row 6: has 3 of 4 cells"):
        read_matches(path, sigma=1.0, unit="pix")


def test_columns_in_plain_text(tmp_path):
    rows = "".join(f"{r['x']} {r['y']} {r['u']} {r['v']}\n" for r in stars())
    for head in ("x y u v\n", "# a remark\n# x y u v\n", "#x y u v\n"):
        path = tmp_path / "stars.dat"
        path.write_text(head + rows)
        m = read_matches(path, sigma=1.0, unit="pix")
        np.testing.assert_array_equal(m.x, stars()["x"])
        np.testing.assert_array_equal(m.v, stars()["v"])


def test_several_chips_of_an_ldac_catalogue(tmp_path):
    hdus = [fits.PrimaryHDU()]
    header = fits.Header({"SIMPLE": True, "DATE-OBS": "2009-05-14T12:00:00"})
    text = np.array([header.tostring()])
    for _ in range(2):
        card = fits.Column("Field Header Card", f"{len(text[0])}A", array=text)
        hdus.append(fits.BinTableHDU.from_columns([card], name="LDAC_IMHEAD"))
        table = stars()
        table.rename_columns(("x", "y"), ("XWIN_IMAGE", "YWIN_IMAGE"))
        hdus.append(fits.BinTableHDU(table.as_array(), name="LDAC_OBJECTS"))
    fits.HDUList(hdus).writeto(tmp_path / "chips.ldac")
    m = read_matches(tmp_path / "chips.ldac", sigma=1.0, unit="pix")
    assert m.chip_numbers == (1, 2) and m.chip.tolist() == [0] * 6 + [1] * 6


def ldac(path, tables, headers, *, in_cards):
    """Write a FITS_LDAC catalogue; image headers as one string, or as an array of cards."""
    hdus = [fits.PrimaryHDU()]
    for table, header in zip(tables, headers, strict=True):
        text = header.tostring()
        shape = f"(80, {len(text) // 80})" if in_cards else None
        row = [[text[k : k + 80] for k in range(0, len(text), 80)]] if in_cards else [text]
        form = f"{len(text)}A"
        column = fits.Column("Field Header Card", form, dim=shape, array=np.array(row))
        hdus.append(fits.BinTableHDU.from_columns([column], name="LDAC_IMHEAD"))
        hdus.append(fits.BinTableHDU(table.as_array(), name="LDAC_OBJECTS"))
    fits.HDUList(hdus).writeto(path)


@pytest.mark.parametrize("in_cards", [True, False])
@pytest.mark.parametrize(
    "date", [{"DATE-OBS": "2009-05-14T12:00:00"}, {"MJD-OBS": 54965.5}, {"MJD-OBS": 54965}]
)
def test_the_date_of_an_ldac_catalogue_moves_its_reference_stars(tmp_path, in_cards, date):
    header = fits.Header({"SIMPLE": True, "OBJECT": "M 51", **date, "EXPTIME": 30.0})
    ra, dec = 202.0 + 0.01 * stars()["x"] / 100, 0.001 * stars()["y"]
    table = Table({"XWIN_IMAGE": stars()["x"], "YWIN_IMAGE": stars()["y"], "ra": ra, "dec": dec})
    still = tmp_path / "still.ldac"
    ldac(still, [table], [header], in_cards=in_cards)
    for name, value in (("pmra", 0.0), ("pmdec", 1000.0), ("ref_epoch", 2016.0)):
        table[name] = value
    table["parallax"], table["ruwe"] = 1e-9, 1.0  # the Gaia archive's, so that units are its
    moving = tmp_path / "moving.ldac"
    ldac(moving, [table], [header], in_cards=in_cards)
    options = {"sigma": 1.0, "tangent_point": (202.0, 0.0)}
    shift = read_matches(moving, **options).v - read_matches(still, **options).v
    year = Time("2009-05-14T12:00:00").decimalyear
    # a day is 0.003 arcsec; the curvature of the sky is far less
    np.testing.assert_allclose(shift, year - 2016.0, atol=0.003)


def test_chips_of_an_ldac_catalogue_keep_their_dates(tmp_path):
    days = 54965.25, 55330.25
    tables = [Table({"XWIN_IMAGE": [1.0, 2, 3], "YWIN_IMAGE": [4.0, 9, 1], "u": [1.0, 2, 3],
                     "v": [4.0, 9, 1]}) for _ in days]  # fmt: skip
    headers = [fits.Header({"SIMPLE": True, "MJD-OBS": day}) for day in days]
    ldac(tmp_path / "a.ldac", tables, headers, in_cards=True)
    m = read_matches(tmp_path / "a.ldac", sigma=1.0, unit="pix")
    years = Time(np.repeat(days, 3), format="mjd").decimalyear
    np.testing.assert_allclose(m.epoch, years, atol=1e-5)


def test_chips_by_name_keep_one_numbering(tmp_path):
    assert numbered(["S10", "S2", "N1", "S2"]) == {"N1": 1, "S2": 2, "S10": 3}
    a, b = stars(detpos=["S10"] * 3 + ["S2"] * 3), stars(detpos=["S2"] * 3 + ["N1"] * 3)
    a.write(tmp_path / "a.csv")
    b.write(tmp_path / "b.csv")
    m = read_matches(tmp_path / "?.csv", sigma=1.0, unit="pix")
    assert m.chip_numbers == (1, 2, 3) and m.chip_names == ("N1", "S2", "S10")
    assert m.chip_number.tolist() == [3] * 3 + [2] * 3 + [2] * 3 + [1] * 3
    given = {"S2": 7, "S10": 4, "N1": 9}
    m = read_matches(tmp_path / "?.csv", sigma=1.0, unit="pix", chips=given)
    assert m.chip_numbers == (4, 7, 9) and m.chip_names == ("S10", "S2", "N1")
    with pytest.raises(InputError, match=r"column 'detpos': chip 'S10' is none of S2; add a"):
        matches_from_table(a, ReadOptions(unit="pix", chips={"S2": 1}))
    texts = matches_from_table(stars(ccd=["3"] * 3 + ["12"] * 3), ReadOptions(unit="pix"))
    assert texts.chip_numbers == (3, 12) and texts.chip_names == ()


def test_chips_by_name_on_disk_need_their_numbers(tmp_path):
    stars(detpos=["S10"] * 3 + ["S2"] * 3).write(tmp_path / "a.parquet")
    with pytest.raises(InputError, match=r"column 'detpos': holds names of chips \('S10'\)"):
        open_matches(tmp_path / "a.parquet", sigma=1.0, unit="pix")
    m = open_matches(tmp_path / "a.parquet", sigma=1.0, unit="pix", chips={"S2": 1, "S10": 2})
    assert m.chip_numbers == (1, 2)
    assert m.readers()[0].load().chip_number.tolist() == [2] * 3 + [1] * 3


@pytest.mark.parametrize(
    ("names", "more", "header", "origin"),
    [
        (("x", "y"), (), {}, 1),
        (("xcentroid", "ycentroid"), (), {}, 0),
        (("x_fit", "y_fit"), (), {}, 0),
        (("slot_Centroid_x", "slot_Centroid_y"), (), {}, 0),
        (("XCENTER", "YCENTER"), ("MSKY",), {}, 1),  # IRAF's
        (("xcenter", "ycenter"), ("aperture_sum",), {}, 0),  # photutils'
        (("x", "y"), ("tnpix", "xcpeak"), {}, 0),  # sep's
        (("x", "y"), (), {"version": {"photutils": "2.0"}}, 0),
        (("x", "y"), (), {"PIXORIG": 0}, 0),
        (("xcentroid", "ycentroid"), (), {"pixel_origin": 1}, 1),
    ],
)
def test_pixels_that_count_from_zero_are_noticed(names, more, header, origin):
    t = stars()
    t.rename_columns(("x", "y"), names)
    for name in more:
        t[name] = 1.0
    t.meta = header
    m = matches_from_table(t, ReadOptions(unit="pix"))
    assert (m.x == t[names[0]] + 1 - origin).all() and (m.y == t[names[1]] + 1 - origin).all()
    assert any("first pixel is taken as 0" in note for note in m.notes) == (origin == 0)
    # what is said wins
    assert (matches_from_table(t, ReadOptions(unit="pix", pixel_origin=1)).x == t[names[0]]).all()


def test_names_of_a_pair_go_together():
    t = stars(X_IMAGE=np.ones(6), y_image=np.ones(6))
    t.rename_column("x", "XWIN_IMAGE")  # without its partner
    m = matches_from_table(t, ReadOptions({"y": "y"}, unit="pix"))
    assert (m.x == t["XWIN_IMAGE"]).all()
    t.remove_column("y")
    m = matches_from_table(t[:1], ReadOptions(unit="pix"))
    assert m.x.tolist() == [1.0] and m.y.tolist() == [1.0]


def test_the_documentation_lists_every_name():
    page = (Path(__file__).parents[2] / "docs" / "your_table.md").read_text(encoding="utf-8")
    for key, names in ALIASES.items():
        assert re.search(rf"\b{key}\b", page), key
        for name in names:
            assert f"`{name}`" in page, name


ALLSTAR = """ NL    NX    NY  LOWBAD HIGHBAD  THRESH     AP1  PH/ADU  RNOISE    FRAD
  1  1000   800   -50.0 32000.0   10.00    3.00    2.00    3.00     9.0

      1   512.250   17.500   15.123    0.010   100.00      4.     1.00    0.010
     23     3.125  799.875   18.000    0.050   101.00      7.     0.98   -0.020
"""


def test_a_list_of_allstar(tmp_path):
    """Columns of its manual: id, x, y, magnitude and error, sky, iterations, chi, sharp."""
    path = tmp_path / "field.als"
    path.write_text(ALLSTAR)
    found = read_table(path)
    assert found.colnames[:5] == ["id", "x", "y", "mag", "mag_err"]
    assert list(found["x"]) == [512.25, 3.125] and list(found["mag_err"]) == [0.01, 0.05]
    path.write_text(ALLSTAR.replace("   -0.020", ""))
    with pytest.raises(InputError, match=r"field\.als, row 2: has 8 numbers"):
        read_table(path)
    path.write_text(ALLSTAR.replace("  1  1000", "  2  1000"))
    with pytest.raises(InputError, match="aperture photometry"):
        read_table(path)
