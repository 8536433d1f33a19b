"""Stars that are set aside: which ones, and that nothing else decides about it."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.stats import binomtest, kstest

from bayesdist.data import Matches, open_matches, write_partitioned
from bayesdist.data.preparing import HELD_OUT, HoldoutSpec, exposures_drawn, split_matches
from bayesdist.errors import InputError

NAMES = ("a", "b", "c", "d")


def table_of(n: int = 4000, seed: int = 1, **columns) -> Matches:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(1, 1000, (2, n))
    given = {"exposure": np.arange(n) * 4 // n, "exposure_names": NAMES}
    return Matches(x=x, y=y, u=x, v=y, sigma_u=x * 0 + 1, sigma_v=x * 0 + 1, **given | columns)


def places(matches) -> set[tuple[float, float, str]]:
    out = set()
    for t in matches.batches():
        names = np.array(t.exposure_names)[t.exposure]
        out |= set(zip(t.x.tolist(), t.y.tolist(), names.tolist(), strict=True))
    return out


def test_the_share_is_the_fraction_and_places_are_even():
    table = table_of(20_000)
    which = HoldoutSpec(0.1, (), 3).which(table)
    assert binomtest(int(which.sum()), len(which), 0.1).pvalue > 1e-3
    for values in (table.x, table.y):
        assert kstest(values[which], "uniform", args=(1, 999)).pvalue > 1e-3
    other = HoldoutSpec(0.1, (), 4).which(table)
    # two seeds choose independently
    assert binomtest(int((which & other).sum()), len(which), 0.01).pvalue > 1e-3


def test_a_star_goes_with_all_its_matches():
    star = np.random.default_rng(2).integers(500, size=4000)
    which = HoldoutSpec(0.3, (), 1).which(table_of(star=star))
    n_held, n = np.bincount(star, which), np.bincount(star)
    assert ((n_held == 0) | (n_held == n)).all() and 0 < n_held.sum() < n.sum()


def test_the_order_of_rows_does_not_matter():
    table, order = table_of(), np.random.default_rng(3).permutation(4000)
    which = HoldoutSpec(0.2, (), 1).which(table)
    assert np.array_equal(HoldoutSpec(0.2, (), 1).which(table.select(order)), which[order])


def test_parts_are_disjoint_and_whole():
    table = table_of()
    split = split_matches(table, HoldoutSpec(0.1, ("c",), 1))
    assert split.kept.exposure_names == ("a", "b", "d")
    assert places(split.kept) | places(split.held) == places(table)
    assert not places(split.kept) & places(split.held)
    assert split.kept.rejected == {HELD_OUT: len(split.held)}
    assert split.kept.n_rows == len(table)


def test_data_on_disk_split_alike_whatever_their_pieces(tmp_path):
    table, aside = table_of(), HoldoutSpec(0.15, ("b",), 7)
    here = split_matches(table, aside)
    write_partitioned(
        [table.select(np.arange(1500)), table.select(np.arange(1500, 4000))], tmp_path / "m"
    )
    for size in (2**20, 700):
        there = split_matches(open_matches(tmp_path / "m", batch_rows=size), aside)
        for part in ("kept", "held"):
            mine, theirs = getattr(here, part), getattr(there, part)
            assert len(mine) == len(theirs) == sum(len(p) for p in theirs.readers())
            # errors multiplied before and after
            scaled = open_matches(tmp_path / "m", batch_rows=size).with_scaled_errors(2.0)
            twice = getattr(split_matches(scaled, aside), part).with_scaled_errors(3.0)
            assert all((p.load().sigma_u == 6.0).all() for p in twice.readers())
            assert places(mine) == places(theirs)
            assert mine.exposure_names == theirs.exposure_names
            assert places(pickle.loads(pickle.dumps(theirs))) == places(mine)
            assert len(theirs.sample(100)) <= 100
        assert there.kept.n_rows == len(table)
        assert there.kept.rejected == {HELD_OUT: len(there.held)}


def test_exposures_are_drawn_whatever_their_order():
    names = [f"e{k}" for k in range(30)]
    drawn = exposures_drawn(names, 5, 1)
    assert len(drawn) == 5
    assert set(exposures_drawn(names[::-1], 5, 1)) == set(drawn)
    assert set(exposures_drawn(names, 5, 2)) != set(drawn)


@pytest.mark.parametrize(
    ("aside", "words"),
    [
        (HoldoutSpec(0.1, ("z",)), "no exposure 'z'"),
        (HoldoutSpec(0.0), "no star is held out"),
        (HoldoutSpec(0.0, NAMES), "none is left"),
    ],
)
def test_what_makes_no_sense_is_refused(aside, words):
    with pytest.raises(InputError, match=words):
        split_matches(table_of(), aside)


def test_not_all_exposures_can_be_drawn():
    with pytest.raises(InputError, match="4 exposures are to be held out, but there are only 4"):
        exposures_drawn(NAMES, 4, 1)
