"""Matches on disk are those in memory, and what is wrong with them is named by file, group, row."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bayesdist.data import MagnitudeErrors, Matches, open_matches, read_matches
from bayesdist.data import repeated as duplicates_module
from bayesdist.data.magnitude_errors import AddedErrors
from bayesdist.data.writing import write_partitioned
from bayesdist.errors import FormatError, InputError
from tests.reduced import FULL, only_in_full

ARRAYS = ("x", "y", "u", "v", "sigma_u", "sigma_v", "epoch", "mag", "colour")
CODES = ("exposure", "chip", "filter", "row", "source")
SHARED = (
    "unit", "exposure_names", "chip_numbers", "filter_names", "sources", "n_rows", "rejected",
    "tangent_point", "has_epoch", "has_mag", "has_sigma",
)  # fmt: skip


def stars(rng, n=500, **more):
    columns = {name: rng.uniform(1.0, 2048.0, n) for name in "xyuv"}
    columns |= {"su": rng.uniform(0.01, 0.2, n), "sv": rng.uniform(0.01, 0.2, n)}
    return columns | more


def write(path, columns, *, group=100, units=None, **options):
    """A Parquet file with units in the metadata of its fields."""
    arrays = {name: pa.array(values) for name, values in columns.items()}
    units = {"u": "pix", "v": "pix"} if units is None else units
    fields = [
        pa.field(name, array.type, metadata={"unit": units[name]} if name in units else None)
        for name, array in arrays.items()
    ]
    table = pa.table(list(arrays.values()), schema=pa.schema(fields))
    options = {"write_page_checksum": True, "compression": "none", **options}
    pq.write_table(table, path, row_group_size=group, **options)
    return path


def assert_bitwise(found, expected, *, where=""):
    """Equal to the last bit; NaN and signed zeros would show."""
    if expected is None:
        assert found is None, where
        return
    assert found.dtype == expected.dtype and found.shape == expected.shape, where
    assert found.tobytes() == expected.tobytes(), where


def assert_same(path, *, piece=150, **options):
    """All pieces together are what read_matches gives."""
    whole = read_matches(path, **options)
    opened = open_matches(path, batch_rows=piece, **options)
    for name in SHARED:
        assert getattr(opened, name) == getattr(whole, name), name
    assert len(opened) == len(whole) and opened.exposures == whole.exposures
    parts = [pickle.loads(pickle.dumps(p)) for p in opened.readers()]
    assert all(0 < len(p) <= piece for p in parts)
    tables, in_memory = ([p.load() for p in some] for some in (parts, whole.readers(piece)))
    assert [len(t) for t in tables] == [len(p) for p in parts] == [t.n_rows for t in tables]
    for name in (*ARRAYS, *CODES):
        of_pieces = [getattr(t, name) for t in tables]
        joined = None if of_pieces[0] is None else np.concatenate(of_pieces)
        assert_bitwise(joined, getattr(whole, name), where=name)
        # a table in memory goes the same way
        of_pieces = [getattr(t, name) for t in in_memory]
        joined = None if of_pieces[0] is None else np.concatenate(of_pieces)
        assert_bitwise(joined, getattr(whole, name), where=name)
    for t in tables:
        assert (t.exposure_names, t.chip_numbers) == (whole.exposure_names, whole.chip_numbers)
        assert (t.filter_names, t.sources) == (whole.filter_names, whole.sources)
        assert (t.unit, t.tangent_point) == (whole.unit, whole.tangent_point)
    for n in (1, 7, max(1, len(whole) - 1), len(whole), 10 * len(whole)):
        ours, theirs = opened.sample(n), whole.sample(n)
        assert len(ours) <= n and ours.n_rows == theirs.n_rows
        for name in (*ARRAYS, *CODES):
            assert_bitwise(getattr(ours, name), getattr(theirs, name), where=f"sample of {name}")
    return opened


def test_one_file(rng, tmp_path):
    columns = {"mag": rng.uniform(10, 20, 500), "colour": rng.uniform(0, 2, 500)}
    path = write(tmp_path / "a.parquet", stars(rng, **columns))
    assert len(assert_same(path).readers()) == 5
    assert_same(path, columns={"mag": ""})


def test_a_folder_of_parts_and_files_as_exposures(rng, tmp_path):
    for k, n in enumerate((330, 20, 250)):
        write(tmp_path / f"p{k}.parquet", stars(rng, n))
    assert assert_same(tmp_path).exposure_names == ("1",)
    opened = assert_same(str(tmp_path / "*.parquet"))
    assert opened.exposure_names == ("p0", "p1", "p2")
    files = [tmp_path / f"p{k}.parquet" for k in (2, 0)]
    assert assert_same(files).exposure_names == ("p2", "p0")


def test_labels_are_numbered_through_all_parts(rng, tmp_path):
    """In the order of first appearance, chips sorted, whatever the type and the encoding."""
    exposures = [["b", "a ", "c"], ["c", "d", "a"]]
    for k in range(2):
        pick = rng.integers(3, size=400)
        write(
            tmp_path / f"p{k}.parquet",
            stars(
                rng,
                400,
                exposure=np.array(exposures[k])[pick],
                chip=[3 - k, 1, 7][k] * np.ones(400, np.int32),
                filter=pa.array(np.array(["F606W", "F814W", "F435W"])[pick]).dictionary_encode(),
            ),
            group=[130, 400][k],
        )
    opened = assert_same(tmp_path)
    assert set(opened.exposure_names) == {"a", "b", "c", "d"}
    assert opened.chip_numbers == (1, 3)
    write(tmp_path / "p2.parquet", stars(
        rng, 9, exposure=np.arange(9) % 2, chip=["1"] * 9, filter=[1.0, 2.5] * 4 + [2.0]
    ))  # fmt: skip
    opened = assert_same(tmp_path)
    assert opened.exposure_names[-2:] == ("0", "1")
    assert opened.filter_names[-3:] == ("1", "2.5", "2")


def test_a_dictionary_may_hold_more_than_the_rows_do(rng, tmp_path):
    codes = pa.array(rng.integers(1, 4, 300).astype(np.int8))
    labels = pa.array(["never", "z", "y", "x"])
    write(
        tmp_path / "a.parquet",
        stars(rng, 300, exposure=pa.DictionaryArray.from_arrays(codes, labels)),
    )
    names = assert_same(tmp_path / "a.parquet").exposure_names
    assert sorted(names) == ["x", "y", "z"]


@pytest.mark.parametrize("point", [None, (120.3, -47.1)])
def test_sky_positions_share_one_plane(rng, tmp_path, point):
    for k, n in enumerate((301, 77)):
        columns = stars(rng, n, ra=120.3 + rng.normal(0, 0.1, n), dec=-47 + rng.normal(0, 0.1, n))
        del columns["u"], columns["v"]
        write(tmp_path / f"{k}.parquet", columns, group=64, units={"ra": "deg", "su": "mas"})
    opened = assert_same(tmp_path, tangent_point=point)
    assert opened.unit == "arcsec" and opened.tangent_point == pytest.approx((120.3, -47), abs=0.2)
    with pytest.raises(InputError, match="unit is pix, but sky positions"):
        open_matches(tmp_path, unit="pix")


def test_where_errors_come_from(rng, tmp_path):
    bare = {k: v for k, v in stars(rng, mag=rng.uniform(10, 20, 500)).items() if len(k) != 2}
    path = write(tmp_path / "a.parquet", bare, group=170)
    assert_same(path, sigma=0.05)
    opened = assert_same(path, sigma="by_magnitude")
    assert not opened.has_sigma
    bins = np.array([11.0, 14.0, 19.0])
    errors = MagnitudeErrors(bins, bins / 100, bins / 50, bins.astype(int), bins, bins)
    whole = read_matches(path, sigma="by_magnitude")
    added, doubled = (
        AddedErrors("", ("",), np.array([[0.0, sigma]]), np.zeros(2)) for sigma in (0.3, 0.6)
    )
    two = opened.with_errors((0.1, 0.2))
    for ours, theirs in (
        (opened.with_errors(errors), whole.with_errors(errors.at(whole.mag))),
        (opened.with_errors((0.1, 0.2)), whole.with_errors((0.1, 0.2))),
        (
            two.with_scaled_errors(2.0).with_scaled_errors(4.0),
            whole.with_errors((0.1, 0.2)).with_scaled_errors(8.0),
        ),
        (
            opened.with_errors((0.1, 0.2))
            .with_scaled_errors(2.0)
            .with_errors(added, in_quadrature=True),
            whole.with_errors((0.2, 0.4)).with_errors(added, in_quadrature=True),
        ),
        (
            opened.with_errors((0.1, 0.2))
            .with_errors(added, in_quadrature=True)
            .with_scaled_errors(2.0),
            whole.with_errors((0.2, 0.4)).with_errors(doubled, in_quadrature=True),
        ),
    ):
        assert ours.has_sigma and not opened.has_sigma
        for name in ("sigma_u", "sigma_v"):
            joined = np.concatenate([getattr(p.load(), name) for p in ours.readers()])
            assert_bitwise(joined, getattr(theirs, name))
    with pytest.raises(InputError, match=r"a\.parquet: holds no errors"):
        open_matches(path)
    with pytest.raises(InputError, match="sigma_v is -1, but must be"):
        opened.with_errors((1, -1))
    path = write(tmp_path / "a.parquet", {k: bare[k] for k in "xyuv"})
    with pytest.raises(InputError, match=r"a\.parquet: holds no magnitudes"):
        open_matches(path, sigma="by_magnitude")
    with pytest.raises(InputError, match="holds no magnitudes"):
        open_matches(path, sigma=1.0).with_errors(errors)
    with pytest.raises(InputError, match="sigma is 'column'"):
        open_matches(path, sigma="column")


def test_errors_in_the_file_do_not_matter_once_others_are_given(rng, tmp_path):
    path = write(tmp_path / "a.parquet", stars(rng))
    opened = open_matches(path).with_errors((0.1, 0.2))
    (piece,) = opened.readers()
    assert (piece.load().sigma_u == 0.1).all() and (piece.load().sigma_v == 0.2).all()


def mirrored(matches):
    """A step that acts on each row by itself."""
    return matches.with_columns(x=2049.0 - matches.x)


def test_what_is_done_to_stars_on_disk_is_done_when_they_are_read(rng, tmp_path):
    exposure = np.array(["a", "b", "c"])[rng.integers(3, size=500)]
    path = write(tmp_path / "a.parquet", stars(rng, exp=exposure, mag=rng.uniform(8, 15, 500)))
    whole, opened = read_matches(path), open_matches(path, batch_rows=60)
    some = rng.uniform(size=500) < 0.3
    late = np.arange(500) >= 250  # nothing is left of the first batches
    for step in (
        lambda m: m.select(some, reason="faint"),
        lambda m: m.select(late).with_scaled_errors(3.0),
        lambda m: m.with_scaled_errors(3.0).select(late).mapped(mirrored),
        lambda m: m.mapped(mirrored).with_errors(0.1, in_quadrature=True),
        lambda m: m.with_exposure_names(("c", "none", "b", "a")).select(some).select(late[some]),
        lambda m: m.with_counts(600, {"early": 100}),
    ):
        ours, theirs = step(opened), step(whole)
        assert not ours.in_memory and theirs.in_memory and theirs.load() is theirs
        assert sum(len(pickle.loads(pickle.dumps(p)).load()) for p in ours.readers()) == len(ours)
        loaded = ours.load()
        assert loaded.in_memory and len(ours) == len(theirs)
        for name in (*ARRAYS, *CODES):
            assert_bitwise(getattr(loaded, name), getattr(theirs, name), where=name)
        for name in SHARED:
            assert getattr(ours, name) == getattr(loaded, name) == getattr(theirs, name), name


def test_what_takes_stars_in_memory_says_so(rng, tmp_path):
    opened = open_matches(write(tmp_path / "a.parquet", stars(rng)))
    one = np.full(500, 0.1)
    for call, message in (
        (lambda: opened.x, "the stars are on disk, so their column 'x' is not in memory"),
        (lambda: opened.epoch, "their column 'epoch'"),
        (lambda: opened.with_columns(x=one), "are on disk"),
        (lambda: opened.select([1, 2]), "can only be selected by a mask"),
        (lambda: opened.select(one > 1), "holds no rows"),
        (lambda: opened.with_errors((one, one)), "errors of individual stars cannot be given"),
    ):
        with pytest.raises(InputError, match=message):
            call()
    assert "500 matches on disk" in repr(opened) and "in memory" in repr(opened.load())


def test_the_origin_and_units(rng, tmp_path):
    units = {"u": "arcsec", "v": "arcsec", "su": "mas", "sv": "mas"}
    path = write(tmp_path / "a.parquet", stars(rng), units=units)
    zero = assert_same(path, pixel_origin=0)
    one = assert_same(path, unit="arcsec")
    (a, *_), (b, *_) = zero.readers(), one.readers()
    assert (a.load().x == b.load().x + 1).all() and (a.load().u == b.load().u).all()
    path = write(tmp_path / "b.parquet", stars(rng), units={})
    assert assert_same(path, unit="mas").unit == "mas"
    with pytest.raises(InputError, match="has no unit"):
        open_matches(path)
    with pytest.raises(InputError, match="pixel_origin is 2"):
        open_matches(path, unit="pix", pixel_origin=2)
    with pytest.raises(InputError, match="a tangent point is given"):
        open_matches(path, unit="pix", tangent_point=(1.0, 1.0))


def test_epochs_in_all_their_forms(rng, tmp_path):
    days = np.datetime64("2003-02-01") + rng.integers(0, 4000, 300)
    forms = {
        "texts": days.astype(str),
        "encoded": pa.array(days.astype(str)).dictionary_encode(),
        "dates": days.astype("datetime64[D]"),
        "times": days.astype("datetime64[ms]"),
        "years": 2003 + rng.uniform(0, 10, 300),
        "year texts": [f"{year:.6f}" for year in 2003 + rng.uniform(0, 10, 300)],
        # the years fill pieces of their own: what a text is must not hang on its neighbours
        "both": ["2005.5", "2004.25"] * 100 + ["2007-03-01"] * 100,
    }
    for epoch in forms.values():
        path = write(tmp_path / "a.parquet", stars(rng, 300, epoch=epoch), group=60)
        assert assert_same(path, piece=60).has_epoch
    mjd = 52000 + rng.uniform(0, 4000, 300)
    path = write(
        tmp_path / "a.parquet",
        stars(rng, 300, epoch=mjd),
        units={"u": "pix", "v": "pix", "epoch": "d"},
    )
    assert_same(path)


MOST = 90 if FULL else 25  # rows of a group; some pieces have one row


@settings(
    max_examples=30 if FULL else 8,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    groups=st.lists(st.lists(st.integers(1, MOST), min_size=1, max_size=6), min_size=1, max_size=3),
    piece=st.integers(1, MOST + 30),
    batch=st.integers(1, MOST - 10),
)
def test_any_sizes_of_row_groups_pieces_and_batches(tmp_path_factory, groups, piece, batch):
    rng = np.random.default_rng(sum(sum(g) for g in groups))
    folder = tmp_path_factory.mktemp("parts")
    for k, sizes in enumerate(groups):
        writer = None
        for n in sizes:
            table = pa.table(stars(rng, n, exp=np.array(["p", "q", "r"])[rng.integers(3, size=n)]))
            writer = writer or pq.ParquetWriter(folder / f"{k}.parquet", table.schema)
            writer.write_table(table)
        writer.close()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bayesdist.data.tables.parquet._BATCH", batch)
        patch.setattr("bayesdist.data.storage.BLOCK", piece + 3)
        assert_same(folder, piece=piece, unit="pix")


def test_small_row_groups_and_files_are_joined(rng, tmp_path):
    for k in range(5):
        write(tmp_path / f"{k}.parquet", stars(rng, 300), group=7)
    (piece,) = open_matches(tmp_path).readers()
    assert len(piece) == 1500


def test_large_row_groups_are_split_evenly(rng, tmp_path):
    path = write(tmp_path / "a.parquet", stars(rng, 250), group=250)
    assert [len(p) for p in open_matches(path).readers()] == [250]
    assert [len(p) for p in open_matches(path, batch_rows=100).readers()] == [83, 83, 84]


# -- bad input ------------------------------------------------------------------------------------

N, GROUP = 10_000, 1000
BAD_ROW = 7_654  # counted from 1: in row group 8 of 10


@pytest.fixture(scope="module")
def good():
    rng = np.random.default_rng(4)
    exposure = np.tile(["a", "b"], N // 2)
    return stars(rng, N, mag=rng.uniform(8, 15, N), exp=exposure)


def planted(good, name, value):
    """The columns with one bad value."""
    values = good[name].tolist()
    values[BAD_ROW - 1] = value
    if isinstance(value, str):
        values = [str(v) for v in values]
    return {**good, name: values}


PLANTS = [
    ("x", float("nan"), "value is nan, but must be finite"),
    ("v", float("inf"), "value is inf, but must be finite"),
    ("mag", float("nan"), "value is nan, but must be finite"),
    ("su", 0.0, "sigma is 0, but must be positive"),
    ("sv", -0.25, r"sigma is -0\.25, but must be positive"),
    ("u", None, "value is missing"),
    ("exp", None, "value is missing"),
    ("y", "spam", "'spam' is not a number"),
    ("chip", 1.5, r"value is 1\.5, but must be a whole number"),
    ("epoch", "spring", "'spring' is not a date"),
]


@pytest.mark.parametrize(("name", "value", "message"), PLANTS)
def test_a_bad_value_is_named_with_its_row_group_and_row(good, tmp_path, name, value, message):
    more = {"chip": np.ones(N), "epoch": np.full(N, "2005-03-01")}
    good = {**good, name: more[name]} if name in more else good
    path = write(tmp_path / "a.parquet", planted(good, name, value), group=GROUP)
    where = rf"a\.parquet, row group 8 of 10, row {BAD_ROW}, column '{name}': {message}"
    with pytest.raises(InputError, match=where) as raised:
        open_matches(path)
    assert_one_sentence(raised)


@pytest.mark.parametrize(("name", "value", "message"), PLANTS[:7])
def test_a_file_that_turned_bad_is_named_when_it_is_read(good, tmp_path, name, value, message):
    path = write(tmp_path / "a.parquet", good, group=GROUP)
    opened = open_matches(path)
    write(path, planted(good, name, value), group=GROUP)
    where = rf"a\.parquet, row group 8 of 10, row {BAD_ROW}, column '{name}': {message}"
    with pytest.raises(InputError, match=where) as raised:
        [piece.load() for piece in opened.readers()]
    assert_one_sentence(raised)


def assert_one_sentence(raised):
    text = str(raised.value)
    assert text.endswith(".") and "\n" not in text and len(text) < 500


def flipped(path, group, column):
    """Flip one bit in the middle of the pages of a column in a row group (from 0)."""
    chunk = pq.ParquetFile(path).metadata.row_group(group).column(column)
    content = bytearray(path.read_bytes())
    start = chunk.dictionary_page_offset if chunk.has_dictionary_page else chunk.data_page_offset
    content[start + (chunk.total_compressed_size // 2)] ^= 0x10
    path.write_bytes(bytes(content))


@pytest.mark.parametrize("use_dictionary", [True, ["exp"]])
@pytest.mark.parametrize("column", range(8))
def test_a_damaged_row_group_is_named(good, tmp_path, column, use_dictionary):
    path = write(tmp_path / "a.parquet", good, group=GROUP, use_dictionary=use_dictionary)
    opened = open_matches(path)
    flipped(path, 6, column)
    where = r"a\.parquet, row group 7 of 10 \(rows 6001 to 7000\): cannot be read"
    with pytest.raises(FormatError, match=where) as raised:
        open_matches(path)
    assert_one_sentence(raised)
    with pytest.raises(FormatError, match=where):
        [piece.load() for piece in opened.readers()]


def test_files_cut_short_gone_or_replaced(good, tmp_path):
    path = write(tmp_path / "a.parquet", good, group=GROUP)
    content = path.read_bytes()
    pieces_then = open_matches(path).readers()
    path.write_bytes(content[: len(content) // 2])
    for call in (lambda: open_matches(path), pieces_then[0].load):
        with pytest.raises(FormatError, match=r"a\.parquet: cannot be read"):
            call()
    path.unlink()
    for call in (lambda: open_matches(path), pieces_then[0].load):
        with pytest.raises(InputError, match=r"a\.parquet: does not exist"):
            call()
    write(path, {k: v[:-1] for k, v in good.items()}, group=GROUP)
    with pytest.raises(InputError, match=r"a\.parquet: has changed since it was opened"):
        pieces_then[0].load()
    write(path, {**good, "exp": np.full(N, "other")}, group=GROUP)
    with pytest.raises(InputError, match=r"a\.parquet: has changed since it was opened"):
        pieces_then[0].load()
    write(path, {k: v for k, v in good.items() if k != "mag"}, group=GROUP)
    with pytest.raises(InputError, match=r"a\.parquet: has changed since it was opened"):
        pieces_then[0].load()


def test_parts_that_do_not_fit_together(rng, tmp_path):
    write(tmp_path / "p0.parquet", stars(rng, mag=np.arange(500.0)))
    write(tmp_path / "p1.parquet", stars(rng, mag=np.arange(500.0)))
    write(tmp_path / "p2.parquet", stars(rng))
    missing = r"p2\.parquet: has no column for 'mag', but .*p0\.parquet has 'mag'"
    with pytest.raises(InputError, match=missing):
        open_matches(tmp_path)
    write(tmp_path / "p2.parquet", stars(rng, mag=np.arange(500.0), epoch=np.full(500, 2005.0)))
    with pytest.raises(InputError, match=r"p0\.parquet: has no column for 'epoch', but .*p2\.parq"):
        open_matches(tmp_path)
    units = {"u": "mas", "v": "mas"}
    write(tmp_path / "p2.parquet", stars(rng, mag=np.arange(500.0)), units=units)
    with pytest.raises(InputError, match=r"p2\.parquet: unit is mas, but pix in .*p0\.parquet"):
        open_matches(tmp_path)
    write(tmp_path / "p2.parquet", {"x": [1.0], "y": [1.0]})
    with pytest.raises(InputError, match=r"p2\.parquet: no column for 'u'"):
        open_matches(tmp_path)
    (tmp_path / "p2.parquet").write_bytes(b"this is not a Parquet file")
    with pytest.raises(FormatError, match=r"p2\.parquet: cannot be read"):
        open_matches(tmp_path)
    (tmp_path / "a.csv").write_text("x,y\n")
    with pytest.raises(FormatError, match=r"a\.csv: is not a Parquet file.*read_matches"):
        open_matches(tmp_path / "a.csv")
    one_sigma = stars(rng)
    del one_sigma["sv"]
    with pytest.raises(InputError, match="'sigma_v' is given without its partner"):
        open_matches(write(tmp_path / "s.parquet", one_sigma))


def test_empty_parts(rng, tmp_path):
    some, none = stars(rng), {k: v[:0] for k, v in stars(rng).items()}
    write(tmp_path / "p0.parquet", none)
    write(tmp_path / "p2.parquet", none)
    with pytest.raises(InputError, match=r"p0\.parquet and 1 more: holds no rows"):
        open_matches(tmp_path)
    write(tmp_path / "p1.parquet", some)
    opened = open_matches(tmp_path)
    assert len(opened) == 500 and len(opened.sources) == 3
    (piece,) = opened.readers()
    assert (piece.load().source == 1).all() and (piece.load().x == some["x"]).all()


# -- rows that stand twice -------------------------------------------------------------------------


def test_a_repeated_row_names_both_places(good, tmp_path, monkeypatch):
    """In another file, and whatever the errors say; in as many buckets as the memory asks for."""
    write(tmp_path / "p0.parquet", good, group=GROUP)
    again = {k: v[:2000] for k, v in good.items()}
    rng = np.random.default_rng(5)
    again |= {k: rng.uniform(1, 100, 2000) for k in "xyuv"}
    for k in "xyuv":
        again[k][1532] = good[k][4320]
    write(tmp_path / "p1.parquet", again, group=GROUP)
    where = (
        r"p1\.parquet, row group 2 of 2, row 1533: repeats "
        r".*p0\.parquet, row group 5 of 10, row 4321:"
    )
    for held in (duplicates_module.HELD, 5000, 700):
        monkeypatch.setattr(duplicates_module, "HELD", held)
        with pytest.raises(InputError, match=where):
            open_matches(tmp_path)
    # measured in another exposure, it is another measurement
    again["exp"] = np.full(2000, "c")
    write(tmp_path / "p1.parquet", again, group=GROUP)
    assert len(open_matches(tmp_path)) == N + 2000


def test_signed_zeros_are_equal_on_disk_too(tmp_path):
    columns = {"x": [0.0, -0.0], "y": [1.0, 1.0], "u": [1.0, 1.0], "v": [-0.0, 0.0]}
    with pytest.raises(InputError, match=r"row 2: repeats .*row 1"):
        open_matches(write(tmp_path / "a.parquet", columns), sigma=1.0)


@pytest.mark.parametrize("buckets", [1, 2, 5])
def test_the_earliest_repetition_is_found_in_any_number_of_buckets(rng, buckets):
    keys = [rng.integers(0, 40, 3000).astype(float) for _ in range(3)]
    rows = list(zip(*(k.tolist() for k in keys), strict=True))
    second = next(i for i, row in enumerate(rows) if row in rows[:i])

    def batches():
        return ([k[a : a + 77] for k in keys] for a in range(0, 3000, 77))

    expected = (rows.index(rows[second]), second)
    assert duplicates_module.first_repetition(batches, buckets) == expected
    assert duplicates_module.first_duplicate(keys) == expected


@pytest.mark.parametrize("different", [1, 150])
def test_rows_whose_hashes_meet_by_chance_are_no_repetition(rng, different):
    def bad_hash(keys):
        return (keys[0] * 1e6).astype(np.uint64) % np.uint64(different)

    keys = [rng.uniform(size=500) for _ in range(2)]
    assert duplicates_module.first_duplicate(keys, hashing=bad_hash) is None
    repeated_keys = [np.r_[k, k[7]] for k in keys]
    assert duplicates_module.first_duplicate(repeated_keys, hashing=bad_hash) == (7, 500)


def test_more_repetitions_than_are_compared_at_a_time(rng):
    keys = [np.tile(rng.uniform(size=300), 2)]
    for buckets in (1, 4):
        first, second = duplicates_module.first_repetition(lambda: (keys,), buckets, at_once=10)
        assert second == first + 300


# -- writing --------------------------------------------------------------------------------------


def some_tables(rng):
    for n in (700, 1, 300):
        yield Matches(
            **{name: rng.uniform(1, 1000, n) for name in "xyuv"},
            sigma_u=rng.uniform(0.1, 1, n), sigma_v=rng.uniform(0.1, 1, n), unit="mas",
            epoch=rng.uniform(2002, 2014, n), mag=rng.uniform(10, 20, n),
            colour=rng.uniform(-1, 2, n),
            exposure=rng.integers(3, size=n), exposure_names=("j1", "j2", "é"),
            chip=rng.integers(2, size=n), chip_numbers=(2, 4),
            filter=rng.integers(2, size=n), filter_names=("F606W", ""),
        )  # fmt: skip


def test_what_is_written_is_read_back_to_the_last_bit(rng, tmp_path):
    tables = list(some_tables(rng))
    paths = write_partitioned(iter(tables), tmp_path / "a" / "b", rows_per_group=150)
    assert [p.name for p in paths] == [f"part-0000{k}.parquet" for k in range(3)]
    assert [pq.ParquetFile(p).num_row_groups for p in paths] == [5, 1, 2]
    assert sorted(p.name for p in (tmp_path / "a" / "b").iterdir()) == [p.name for p in paths]
    assert_same(tmp_path / "a" / "b")
    back = read_matches(tmp_path / "a" / "b")
    whole = Matches.concatenate(tables)
    assert back.unit == "mas"
    for name in ARRAYS:
        assert_bitwise(getattr(back, name), getattr(whole, name), where=name)
    for codes, labels in (
        ("exposure", "exposure_names"), ("chip", "chip_numbers"), ("filter", "filter_names")
    ):  # fmt: skip
        of = [np.array(getattr(t, labels))[getattr(t, codes)] for t in (back, whole)]
        assert (of[0] == of[1]).all()


def test_written_parts_are_damaged_visibly(rng, tmp_path):
    paths = write_partitioned(some_tables(rng), tmp_path, rows_per_group=150)
    flipped(paths[0], 2, 1)
    with pytest.raises(FormatError, match=r"part-00000\.parquet, row group 3 of 5 \(rows 301 to"):
        open_matches(tmp_path)


def test_nothing_half_written_stays(rng, tmp_path):
    def broken():
        yield from some_tables(rng)
        raise RuntimeError("the source dried up")

    with pytest.raises(RuntimeError):
        write_partitioned(broken(), tmp_path / "a")
    first, *_ = some_tables(rng)
    bare = Matches(x=first.x, y=first.y, u=first.u, v=first.v)
    with pytest.raises(InputError, match="table 2 has another unit or other columns"):
        write_partitioned([first, bare], tmp_path / "a")
    with pytest.raises(InputError, match="no tables to write"):
        write_partitioned([], tmp_path / "a")
    assert not list((tmp_path / "a").iterdir())
    write_partitioned([bare], tmp_path / "a")
    assert pq.ParquetFile(tmp_path / "a" / "part-00000.parquet").schema_arrow.names == list("xyuv")
    with pytest.raises(InputError, match="holds Parquet files already"):
        write_partitioned([bare], tmp_path / "a")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="folder cannot be made"):
        write_partitioned([bare], tmp_path / "file" / "a")


# -- memory ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("take", ["a batch", "a sample"])
def test_one_batch_at_a_time_is_in_memory(rng, tmp_path, monkeypatch, take):
    """Beside its columns there is a block of rows, and no batch that came before."""
    monkeypatch.setattr("bayesdist.data.storage.BLOCK", 20_000)
    for name in "abcd":
        write(tmp_path / f"{name}.parquet", stars(rng, 100_000), group=100_000)
    opened = open_matches(tmp_path, batch_rows=200_000)
    first, _ = opened.readers()
    held = sum(column.nbytes for column in first.load()._columns.values())
    tracemalloc.start()
    try:
        kept = first.load() if take == "a batch" else opened.sample(100)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(kept) in (100, 200_000)
    assert peak < 1.5 * held


MEASURE = """
import json, sys, tracemalloc
import numpy as np, pyarrow as pa
from bayesdist.data import open_matches, repeated, storage

repeated.HELD = 400_000
storage.BLOCK = 50_000
open_matches(sys.argv[1])  # what is loaded once
tracemalloc.start()
opened = open_matches(sys.argv[2], batch_rows=100_000)
total = sum(batch.x.sum() for batch in opened.batches())
sample = opened.sample(1000)
pool = pa.default_memory_pool()
print(json.dumps({"arrow": pool.max_memory(), "left": pool.bytes_allocated(),
                  "numpy": tracemalloc.get_traced_memory()[1], "rows": len(opened)}))
"""


def measured(small, path):
    run = subprocess.run(
        [sys.executable, "-c", MEASURE, str(small), str(path)],
        capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    return json.loads(run.stdout)


@pytest.mark.slow
@only_in_full("tests/kinds/matches/test_at_scale counts rows")
@pytest.mark.parametrize("group", [10_000, 10_000_000])
def test_memory_does_not_grow_with_the_table(rng, tmp_path, group):
    """A table of 8 times as many rows, in small row groups or one that holds them all."""
    small = write(tmp_path / "small.parquet", stars(rng, 1000))
    found, times = [], 8
    for k, n in enumerate((400_000, times * 400_000)):
        path = write(tmp_path / f"{k}.parquet", stars(rng, n), group=group, use_dictionary=False)
        found.append(measured(small, path))
        path.unlink()
    one, more = found
    assert more["rows"] == times * one["rows"] and more["left"] == 0
    # the columns of the additional rows alone would be 134 MB
    for pool in ("arrow", "numpy"):
        assert more[pool] < 1.3 * one[pool] + 2**20
