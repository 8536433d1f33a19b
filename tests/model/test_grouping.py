"""Groups against a plain dictionary of keys."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bayesdist.model.effective import Groups, group_by, merge_groups

Key = tuple[int, int, float]
EPOCHS = [2001.5, 2003.0, 0.0, -1.0, 2001.5000000001]
keys = st.lists(
    st.tuples(st.integers(0, 2), st.integers(0, 3), st.sampled_from(EPOCHS)), max_size=12
)


def groups_of(members: list[Key]) -> Groups:
    chip, exposure, epoch = zip(*members, strict=True) if members else ((), (), ())
    return group_by(np.array(chip, int), np.array(exposure, int), np.array(epoch, float))


def keys_of(groups: Groups) -> list[Key]:
    return list(zip(groups.chip, groups.exposure, groups.epoch, strict=True))


@pytest.mark.parametrize("kinds", [1, 3])
def test_groups_are_those_of_equal_keys(kinds):
    rng = np.random.default_rng(kinds)
    chip, exposure = rng.integers(kinds, size=(2, 200))
    epoch = rng.choice(2000.0 + np.arange(kinds), 200)
    groups = group_by(chip, exposure, epoch)
    expected: dict[tuple, list[int]] = {}
    for n, key in enumerate(zip(chip, exposure, epoch, strict=True)):
        expected.setdefault(key, []).append(n)
    assert len(groups) == len(expected)
    for g, rows in enumerate(groups.members()):
        key = (groups.chip[g], groups.exposure[g], groups.epoch[g])
        assert rows.tolist() == expected[key]
        assert (groups.index[rows] == g).all()


@given(keys)
def test_groups_are_numbered_in_the_order_of_their_keys(members):
    """Chip before exposure before epoch, however the stars stand: as numpy sorts whole keys."""
    groups = groups_of(members)
    kind = [("chip", "i8"), ("exposure", "i8"), ("epoch", "f8")]
    unique, index = np.unique(np.array(members, dtype=kind), return_inverse=True)
    assert keys_of(groups) == unique.tolist()
    np.testing.assert_array_equal(groups.index, index)


@given(keys, keys)
def test_merged_groups_are_the_union_in_the_order_of_the_whole(a, b):
    one, two = groups_of(a), groups_of(b)
    merged, of_one, of_two = merge_groups(one, two)
    assert keys_of(merged) == sorted(set(a) | set(b))
    assert merged.same(groups_of(a + b))  # as if the stars had been grouped together
    assert len(merged.index) == 0
    # where the groups of either stand: what is summed there belongs to the same key
    assert [keys_of(merged)[k] for k in of_one] == keys_of(one)
    assert [keys_of(merged)[k] for k in of_two] == keys_of(two)


@given(keys, keys, keys)
def test_merging_may_be_done_in_any_order(a, b, c):
    one, two, three = groups_of(a), groups_of(b), groups_of(c)
    left = merge_groups(merge_groups(one, two)[0], three)[0]
    right = merge_groups(one, merge_groups(two, three)[0])[0]
    assert left.same(right) and left.same(merge_groups(three, merge_groups(two, one)[0])[0])
    assert merge_groups(left, left)[0].same(left)


@given(keys, keys)
def test_same_groups_are_those_of_equal_keys(a, b):
    assert groups_of(a).same(groups_of(b)) == (sorted(set(a)) == sorted(set(b)))


def test_merging_changes_neither():
    one, two = groups_of([(0, 1, 3.0), (0, 0, 3.0)]), groups_of([(1, 0, 2.0)])
    before = keys_of(one), keys_of(two), one.index.copy()
    merge_groups(one, two)
    assert (keys_of(one), keys_of(two)) == before[:2]
    np.testing.assert_array_equal(one.index, before[2])
