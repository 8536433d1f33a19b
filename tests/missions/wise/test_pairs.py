"""RvB files give the pairs of one band, whatever the kind of file; what is dropped is counted."""

from __future__ import annotations

import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.table import MaskedColumn, Table
from astropy.time import Time

from bayesdist.data import Matches, open_matches, write_partitioned
from bayesdist.errors import InputError
from bayesdist.missions.wise.pairs.read import read_rvb, rvb_bands, stream_rvb
from bayesdist.missions.wise.pairs.run_input import SelectedPairs
from bayesdist.missions.wise.pairs.rvb_pairs import RvbPairs, colour_of
from bayesdist.missions.wise.pairs.section import RadialLimit, RvbBlock

SIZE = (1016.0, 1016.0)
BANDS = ("W1", "W2", "W4")


def rvb_table(rng, n=300, bands=BANDS) -> Table:
    """Pairs of several bands, of five frames, with magnitudes that may be missing."""
    band = np.array(bands)[rng.integers(len(bands), size=n)]
    extent = np.where(band == "W4", 508.0, 1016.0)
    table = Table({"band": band, "frame": [f"0{k}a-{k}" for k in rng.integers(5, size=n)]})
    for name in "xy":
        table[name] = rng.uniform(0.5, extent + 0.5)
    table["u"], table["v"] = table["x"] + rng.normal(size=n), table["y"] + rng.normal(size=n)
    table["sigma_u"], table["sigma_v"] = rng.uniform(0.05, 0.2, (2, n))
    table["mjd"] = 55200.0 + rng.integers(100, size=n)
    for k in (1, 2, 3, 4):
        detected = (rng.uniform(size=n) < 0.5) | (band == f"W{k}")
        values = 14.0 - 0.5 * k + rng.normal(0, 0.5, n)
        table[f"w{k}mag"] = MaskedColumn(values, mask=~detected)
    return table


def write(table: Table, path):
    """As the end of the name says."""
    if path.suffix == ".parquet":
        arrays = {
            name: pa.array(
                np.ma.filled(np.ma.asarray(table[name]), 0).tolist(),
                mask=np.broadcast_to(getattr(table[name], "mask", False), len(table)),
            )
            for name in table.colnames
        }
        pq.write_table(pa.table(arrays), path, row_group_size=70)
    else:
        table.write(path, format="ascii.ipac" if path.suffix == ".tbl" else "ascii.ecsv")
    return path


def assert_same(found: RvbPairs, expected: RvbPairs) -> None:
    for name in ("x", "y", "u", "v", "sigma_u", "sigma_v", "epoch", "mag", "row"):
        np.testing.assert_array_equal(getattr(found.matches, name), getattr(expected.matches, name))
    np.testing.assert_array_equal(found.colour, expected.colour)
    for one in (found.matches, expected.matches):
        assert one.filter_names == found.matches.filter_names and one.unit == "pix"
    frames = [np.array(p.matches.exposure_names)[p.matches.exposure] for p in (found, expected)]
    np.testing.assert_array_equal(*frames)


@pytest.mark.parametrize("suffix", [".tbl", ".ecsv", ".parquet"])
def test_the_pairs_of_a_band_are_its_rows(rng, tmp_path, suffix):
    table = rvb_table(rng)
    path = write(table, tmp_path / f"a{suffix}")
    assert rvb_bands(path) == {band: int((table["band"] == band).sum()) for band in BANDS}
    for band in BANDS:
        rows = np.flatnonzero(table["band"] == band)
        pairs = read_rvb(path, band=band)
        matches = pairs.matches
        assert pairs.band == band and matches.n_rows == len(matches) == len(rows)
        np.testing.assert_array_equal(matches.row, rows)
        for name in ("x", "y", "u", "v", "sigma_u", "sigma_v"):
            np.testing.assert_array_equal(getattr(matches, name), table[name][rows])
        np.testing.assert_array_equal(matches.mag, table[f"w{band[1]}mag"][rows])
        np.testing.assert_allclose(
            matches.epoch, Time(table["mjd"][rows], format="mjd", scale="tt").decimalyear
        )
        named = np.array(matches.exposure_names)[matches.exposure]
        np.testing.assert_array_equal(named, table["frame"][rows])
        assert len(set(matches.exposure_names)) == len(np.unique(named))


def test_parquet_in_small_pieces_is_the_ipac_table(rng, tmp_path):
    table = rvb_table(rng)
    whole = read_rvb(write(table, tmp_path / "a.tbl"), band="w2")
    path = write(table, tmp_path / "a.parquet")
    pieces = list(stream_rvb(path, band="2", batch=41))
    assert len(pieces) == 8 and sum(len(p) for p in pieces) == len(whole)
    assert_same(RvbPairs.concatenate(pieces), whole)
    # what is written from the pieces is what a fit opens
    write_partitioned((p.matches for p in pieces), tmp_path / "W2")
    opened = open_matches(tmp_path / "W2")
    joined = Matches.concatenate([piece.load() for piece in opened.readers()])
    for name in ("x", "y", "u", "v", "sigma_u", "epoch", "mag"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(whole.matches, name))
    assert opened.filter_names == ("W2",)
    assert sorted(opened.exposure_names) == sorted(whole.matches.exposure_names)


def test_names_of_bands_and_columns(rng, tmp_path):
    table = rvb_table(rng)
    expected = read_rvb(write(table, tmp_path / "a.ecsv"), band="W1")
    table["band"] = [int(str(one)[1]) for one in table["band"]]
    table.rename_columns(["x", "frame", "w3mag"], ["xpos", "field", "m3"])
    path = write(table, tmp_path / "b.parquet")
    names = {"x": "xpos", "exposure": "field", "mag_w3": "m3"}
    assert_same(read_rvb(path, band="w1", columns=names), expected)
    pairs = read_rvb(path, band="W1", columns={**names, "mag_w3": "", "mjd": ""}, sigma=0.1)
    assert pairs.matches.epoch is None and (pairs.matches.sigma_u == 0.1).all()
    assert not np.array_equal(pairs.colour, expected.colour, equal_nan=True)


def test_a_column_of_colours_stands_for_the_magnitudes(rng, tmp_path):
    table = rvb_table(rng)
    expected = read_rvb(write(table, tmp_path / "a.ecsv"), band="W1")
    table["color"] = MaskedColumn(rng.normal(size=300), mask=rng.uniform(size=300) < 0.3)
    path = write(table, tmp_path / "b.parquet")
    own = np.ma.filled(table["color"][table["band"] == "W1"], np.nan)
    np.testing.assert_array_equal(read_rvb(path, band="W1").colour, own)
    assert_same(read_rvb(path, band="W1", columns={"colour": ""}), expected)


def test_one_band_needs_no_name_and_no_column(rng, tmp_path):
    table = rvb_table(rng, bands=("W3",))
    expected = read_rvb(write(table, tmp_path / "a.tbl"))
    assert expected.band == "W3"
    table.remove_column("band")
    assert_same(read_rvb(write(table, tmp_path / "b.tbl"), band="W3"), expected)


def refused(match, path, **options):
    with pytest.raises(InputError, match=match) as error:
        read_rvb(path, **options)
    return error.value.sentence


def test_what_a_file_lacks_is_said(rng, tmp_path):
    table = rvb_table(rng)
    path = write(table, tmp_path / "a.tbl")
    counts = re.escape(", ".join(f"{b} ({n} pairs)" for b, n in rvb_bands(path).items()))
    refused(f"a.tbl: contains several bands: {counts}; choose one", path)
    refused(f"does not contain W3, but {counts}", path, band="W3")
    refused("'W7' is not a band; give one of W1, W2, W3, W4", path, band="W7")
    refused("column 'xx' is missing; name 'x' if that is meant", path, columns={"x": "xx"})
    refused(
        "columns has the key 'chip', which is not a known quantity", path, columns={"chip": "band"}
    )
    table["band"][7] = "K"
    refused("b.tbl, row 8, column 'band': 'K' is not a band", write(table, tmp_path / "b.tbl"))
    table.remove_column("band")
    refused("c.tbl: has no column with the band", write(table, tmp_path / "c.tbl"))
    table.remove_column("u")
    refused("d.tbl: no column for 'u' among frame, x, y, v", write(table, tmp_path / "d.tbl"))
    table = rvb_table(rng)
    table.remove_column("sigma_v")
    refused("column 'sigma_v' is given without its partner",
            write(table, tmp_path / "e.tbl"), band="W1")  # fmt: skip
    refused("no errors", write(table[["band", "x", "y", "u", "v"]], tmp_path / "f.tbl"), band="W1")


@pytest.mark.parametrize("cut", [3, 60, 170, 205])
def test_a_truncated_table_is_refused(rng, tmp_path, cut):
    """Wherever in the last row it ends: astropy drops such rows, or cuts their numbers."""
    path = write(rvb_table(rng, n=20, bands=("W1",)), tmp_path / "a.tbl")
    whole = path.read_text().rstrip("\n")
    path.write_text(whole)  # as far as the header goes: all is there
    assert len(read_rvb(path)) == 20
    last = whole.rindex("\n") + 1
    path.write_text(whole[: last + cut])
    refused("a.tbl, row 20: ends after", path)


@pytest.mark.parametrize("suffix", [".tbl", ".parquet"])
def test_bands_mixed_up_are_seen_by_the_array(rng, tmp_path, suffix):
    table = rvb_table(rng, n=400, bands=("W1", "W4"))
    table["band"] = np.where(table["band"] == "W1", "W4", "W1")
    path = write(table, tmp_path / f"a{suffix}")
    sentence = refused(r"outside the 508 pixels of W4's array, as are \d+ of \d+ rows", path,
                       band="W4")  # fmt: skip
    first = np.flatnonzero((table["band"] == "W4") & (table["x"] > 509.0))[0]
    assert f"row {first + 1}, column 'x'" in sentence
    refused("pairs of W1 are within x <= 50., y <= 50. of an array of 1016 x 1016", path, band="W1")
    # a smaller array that is meant is none of another band
    assert len(read_rvb(path, band="W1", size=(508.0, 508.0)))


def test_colour_is_shortest_minus_longest_detected(rng):
    magnitudes = np.where(rng.uniform(size=(4, 400)) < 0.5, rng.normal(12, 1, (4, 400)), np.nan)
    for column, colour in zip(magnitudes.T, colour_of(magnitudes), strict=True):
        there = [m for m in column if not np.isnan(m)]
        assert np.isnan(colour) if len(there) < 2 else colour == there[0] - there[-1]


def pairs_with(colour, frame) -> RvbPairs:
    n = len(colour)
    k = np.arange(1.0, n + 1)
    matches = Matches(k, k, k, k, exposure=frame, exposure_names=("a", "b", "c"))
    return RvbPairs(matches, np.asarray(colour, float))


def taken(
    pairs: RvbPairs,
    *,
    offset: RadialLimit | None = None,
    chi2: RadialLimit | None = None,
    **limits,
) -> Matches:
    for name, limit in (("accept", offset), ("accept_chi2", chi2)):
        if limit is not None:
            limits |= {f"{name}_centre": limit.centre, f"{name}_corner": limit.corner}
    return SelectedPairs(lambda: [pairs], RvbBlock(**limits), SIZE).table()


def test_selection_by_colour_against_a_loop_over_the_frames(rng):
    colour = np.where(rng.uniform(size=200) < 0.2, np.nan, np.round(rng.normal(0.3, 0.5, 200), 1))
    frame = rng.integers(3, size=200)
    pairs = pairs_with(colour, frame)
    kept = taken(pairs, bluest=20)
    expected = []
    for f in range(3):
        known = [k for k in range(200) if frame[k] == f and not np.isnan(colour[k])]
        expected += sorted(known, key=lambda k: colour[k])[:20]
    assert kept.row.tolist() == sorted(expected)
    between = taken(pairs, colour=(-0.2, 0.5))
    inside = [k for k in range(200) if -0.2 <= colour[k] <= 0.5]
    assert between.row.tolist() == inside
    both = taken(pairs, colour=(-0.2, 0.5), bluest=20)
    first = []
    for f in range(3):
        first += sorted((k for k in inside if frame[k] == f), key=lambda k: colour[k])[:20]
    assert both.row.tolist() == sorted(first)
    for one in (kept, between, both):
        assert one.rejected["no colour"] == np.isnan(colour).sum()
        assert sum(one.rejected.values()) + len(one) == 200


def test_the_radial_limit_at_centre_edge_and_corner():
    limit = RadialLimit(1.0, 3.0)
    x, y = np.array([508.5, 0.5, 1016.5, 1016.5, 508.5]), np.array([508.5, 0.5, 1016.5, 508.5, 0.5])
    # the middle of an edge is 1/sqrt(2) of the way to the corner
    np.testing.assert_allclose(limit.at(x, y, SIZE), [1.0, 3.0, 3.0, 2.0, 2.0], rtol=1e-12)
    np.testing.assert_allclose(RadialLimit(2.0, 2.0).at(x, y, SIZE), 2.0)


def test_false_matches_pass_in_proportion_to_the_area_within_the_limit(rng):
    """Uniform in a circle of 4 px: the share within the limit is its square over 16."""
    n = 200_000
    x, y = rng.uniform(0.5, 1016.5, (2, n))
    r, phi = 4.0 * np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
    matches = Matches(x, y, x + r * np.cos(phi), y + r * np.sin(phi))
    kept = taken(RvbPairs(matches), offset=RadialLimit(0.5, 3.0))
    # <(a + b s)^2> over a square, s = r^2 / r_corner^2: <s> = 1/3, <s^2> = 7/45
    share = (0.5**2 + 2 * 0.5 * 2.5 / 3 + 2.5**2 * 7 / 45) / 16
    assert abs(len(kept) / n - share) < 4 * np.sqrt(share * (1 - share) / n)
    assert kept.rejected == {"offset beyond the radial limit": n - len(kept)}


def test_both_limits_are_judged(rng):
    n = 5000
    x, y = rng.uniform(0.5, 1016.5, (2, n))
    distorted = np.column_stack([x + 3e-6 * (x - 508.5) ** 2, y])
    noise = rng.normal(0, 0.1, (n, 2))
    u, v = (distorted + noise).T
    matches = Matches(x, y, u, v, sigma_u=np.full(n, 0.1), sigma_v=np.full(n, 0.1))
    tight = RadialLimit(0.6, 0.6)
    # what distortion moves beyond 0.6 px is lost towards the edges
    lost = taken(RvbPairs(matches), offset=tight)
    assert np.abs(lost.x - 508.5).max() < np.sqrt((0.6 + 0.5) / 3e-6) and len(lost) < 0.95 * n
    # chi-square of two axes: exp(-q / 2) lies beyond q
    limit = RadialLimit(4.0, 4.0)
    still = Matches(x, y, *(np.column_stack([x, y]) + noise).T, *[np.full(n, 0.1)] * 2)
    unlikely = taken(RvbPairs(still), offset=tight, chi2=limit).rejected
    assert set(unlikely) == {"chi-square beyond the radial limit"}
    share = unlikely["chi-square beyond the radial limit"] / n
    assert abs(share - np.exp(-2)) < 4 * np.sqrt(np.exp(-2) / n)
    both = taken(RvbPairs(matches), offset=tight, chi2=limit)
    assert sum(both.rejected.values()) + len(both) == n
    assert both.rejected["offset beyond the radial limit"] == n - len(lost)


def test_acceptance_refuses_what_it_cannot_judge():
    one = np.array([1.0, 2.0])
    matches = Matches(one, one, one + 5, one)
    beyond = r"none of the 2 pairs are selected: .*offset beyond the radial limit \(2\)"
    with pytest.raises(InputError, match=beyond):
        taken(RvbPairs(matches), offset=RadialLimit(1.0, 2.0))
    with pytest.raises(InputError, match="needs errors"):
        taken(RvbPairs(matches), chi2=RadialLimit(1.0, 2.0))
    in_mas = RvbPairs(Matches(one, one, one, one, unit="mas"))
    with pytest.raises(InputError, match="u, v are in mas"):
        taken(in_mas, offset=RadialLimit(1, 2))
    with pytest.raises(InputError, match="corner is -1"):
        RadialLimit(1.0, -1.0)
