"""Selection piece by piece is that of the whole; pairs on disk are those that were written."""

from __future__ import annotations

import numpy as np
import pyarrow.parquet as pq
import pytest

from bayesdist.data import Matches
from bayesdist.errors import InputError
from bayesdist.missions.wise.pairs.read import read_rvb, stream_rvb
from bayesdist.missions.wise.pairs.run_input import SelectedPairs, open_rvb
from bayesdist.missions.wise.pairs.rvb_pairs import RvbPairs, write_rvb
from bayesdist.missions.wise.pairs.section import RvbBlock
from tests.missions.wise.test_pairs import assert_same, rvb_table, write

SIZE = (1016.0, 1016.0)
ARRAYS = ("x", "y", "u", "v", "sigma_u", "sigma_v", "epoch", "mag")


def pairs_of(rng, n=400) -> RvbPairs:
    """With colours to 0.1 mag, some missing, in frames whose names come as they may."""
    x, y = rng.uniform(0.5, 1016.5, (2, n))
    u, v = x + rng.normal(size=n), y + rng.normal(size=n)
    frame = rng.integers(4, size=n)
    colour = np.where(rng.uniform(size=n) < 0.2, np.nan, np.round(rng.normal(0.3, 0.5, n), 1))
    names = ("d", "b", "a", "c")
    matches = Matches(
        x, y, u, v, np.full(n, 0.5), np.full(n, 0.4), exposure=frame, exposure_names=names
    )
    return RvbPairs(matches, colour)


def cut(pairs: RvbPairs, size: int) -> list[RvbPairs]:
    """Pieces, each with codes of its own for the frames."""
    out = []
    for start in range(0, len(pairs), size):
        one = pairs.select(np.arange(start, min(start + size, len(pairs))))
        m = one.matches
        used, code = np.unique(m.exposure, return_inverse=True)
        columns = {name: getattr(m, name) for name in ("x", "y", "u", "v", "sigma_u", "sigma_v")}
        names = tuple(m.exposure_names[k] for k in used)
        matches = Matches(**columns, exposure=code, exposure_names=names, row=m.row)
        out.append(RvbPairs(matches, one.colour))
    return out


@pytest.mark.parametrize("size", [1, 37, 400])
def test_pieces_pass_as_the_whole_does(rng, size):
    pairs = pairs_of(rng)
    selection = RvbBlock(
        colour=(-0.3, 0.6),
        bluest=40,
        accept_centre=0.8,
        accept_corner=2.5,
        accept_chi2_centre=6.0,
        accept_chi2_corner=12.0,
    )
    whole = SelectedPairs(lambda: [pairs], selection, SIZE).table()
    pieces = cut(pairs, size)
    table = SelectedPairs(lambda: pieces, selection, SIZE).table()
    np.testing.assert_array_equal(table.row, whole.row)
    assert table.rejected == whole.rejected and table.n_rows == 400
    assert len(table) + sum(table.rejected.values()) == 400


def test_without_limits_all_pass(rng):
    pairs = pairs_of(rng)
    assert RvbBlock().takes_all and not RvbBlock(bluest=3).takes_all
    found = SelectedPairs(lambda: [pairs], RvbBlock(), SIZE)
    assert list(found) == [pairs] and found.rejected == {}


def test_what_leaves_nothing_or_cannot_be_done_is_refused(rng):
    pairs = pairs_of(rng)

    def refused(match, selection, given=pairs):
        with pytest.raises(InputError, match=match):
            SelectedPairs(lambda: [given], selection, SIZE).table()

    unknown = int(np.isnan(pairs.colour).sum())
    refused(rf"none of the 400 pairs .* no colour \({unknown}\), colour \({400 - unknown}\)",
            RvbBlock(colour=(8.0, 9.0)))  # fmt: skip
    refused("therefore no colours", RvbBlock(bluest=3), RvbPairs(pairs.matches))
    m = pairs.matches
    nameless = RvbPairs(Matches(m.x, m.y, m.u, m.v), pairs.colour)
    refused("no column of frames", RvbBlock(bluest=3), nameless)
    with pytest.raises(ValueError, match=r"colour is from 1 to 0"):
        RvbBlock(colour=(1.0, 0.0))
    with pytest.raises(ValueError, match=r"bluest\n.*greater than 0"):
        RvbBlock(bluest=0)


def test_written_pairs_are_read_again(rng, tmp_path):
    path = write(rvb_table(rng), tmp_path / "a.parquet")
    expected = read_rvb(path, band="W2")
    batches = stream_rvb(path, band="W2", batch=41)
    assert write_rvb(batches, tmp_path / "out") == len(expected)
    found = read_rvb(tmp_path / "out")
    assert len(list((tmp_path / "out").iterdir())) > 3
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(found.matches, name), getattr(expected.matches, name))
    np.testing.assert_array_equal(found.colour, expected.colour)
    frames = [np.array(p.matches.exposure_names)[p.matches.exposure] for p in (found, expected)]
    np.testing.assert_array_equal(*frames)
    with pytest.raises(InputError, match="out: is in use"):
        write_rvb([expected], tmp_path / "out")


def test_a_folder_that_cannot_be_filled_is_not_left(rng, tmp_path):
    def pieces():
        yield pairs_of(rng)
        raise InputError("is damaged")

    with pytest.raises(InputError, match="is damaged"):
        write_rvb(pieces(), tmp_path / "out")
    with pytest.raises(InputError, match="no pairs to write"):
        write_rvb([], tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


OPTIONS = {"columns": None, "unit": "pix", "sigma": "columns", "pixel_origin": 1, "size": SIZE}


def test_pairs_that_stay_on_disk_are_the_same(rng, tmp_path):
    table = rvb_table(rng, bands=("W1",))
    table.rename_column("mjd", "epoch")
    table["epoch"] = 2010.0 + rng.uniform(size=len(table))
    table["mag"], table["chip"] = table["w1mag"], 7
    path = write(table, tmp_path / "a.parquet")
    options = OPTIONS | {"columns": {"color": ""}}
    opened = open_rvb(path, band="W1", **options)
    (piece,) = [piece.load() for piece in opened.readers()]
    expected = read_rvb(path, band="W1").matches
    for name in (*ARRAYS, "row"):
        np.testing.assert_array_equal(getattr(piece, name), getattr(expected, name))
    assert opened.filter_names == ("W1",) and opened.chip_numbers == (1,)
    assert sorted(opened.exposure_names) == sorted(expected.exposure_names)


def test_what_has_to_be_converted_is_not_opened_in_place(rng, tmp_path):
    several = write(rvb_table(rng), tmp_path / "bands.parquet")
    assert open_rvb(several, band="W1", **OPTIONS) is None
    dates = write(rvb_table(rng, bands=("W1",)), tmp_path / "mjd.parquet")
    assert open_rvb(dates, band="W1", **OPTIONS) is None
    text = write(rvb_table(rng, bands=("W1",)), tmp_path / "a.tbl")
    assert open_rvb(text, band="W1", **OPTIONS) is None


def test_pairs_in_place_are_checked_against_the_array(rng, tmp_path):
    table = rvb_table(rng, bands=("W1",))
    table.remove_columns(["mjd", "w1mag", "w2mag", "w3mag", "w4mag"])
    path = write(table, tmp_path / "a.parquet")
    assert pq.read_metadata(path).num_rows == 300
    assert len(open_rvb(path, band=None, **OPTIONS)) == 300
    with pytest.raises(InputError, match="outside the 508 pixels of W1's array"):
        open_rvb(path, band="W1", **(OPTIONS | {"size": (508.0, 508.0)}))
    with pytest.raises(InputError, match=r"are within x <= .* positions of a smaller array"):
        open_rvb(path, band="W1", **(OPTIONS | {"size": (4096.0, 4096.0)}))
    table["u"], table["v"] = table["v"].copy(), table["u"].copy()
    swapped = write(table, tmp_path / "swapped.parquet")
    with pytest.raises(InputError, match="more than 51 pixels from x, y"):
        open_rvb(swapped, band="W1", **OPTIONS)


def test_both_spellings_name_the_column_of_colours(rng, tmp_path):
    table = rvb_table(rng)
    table["tint"] = rng.normal(size=300)
    path = write(table, tmp_path / "a.ecsv")
    by_colour, by_color = (
        read_rvb(path, band="W1", columns={key: "tint"}) for key in ("colour", "color")
    )
    assert_same(by_colour, by_color)
    np.testing.assert_array_equal(by_color.colour, table["tint"][table["band"] == "W1"])
    with pytest.raises(InputError, match="'hue', which is not a known quantity"):
        read_rvb(path, band="W1", columns={"hue": "tint"})
