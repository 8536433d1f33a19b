"""Sums over stars: any cut of the data, in any order, gives the same sums."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from bayesdist.infer.stars.stars import Sums
from bayesdist.model import Groups

NOBODY = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Moments(Sums):
    groups: Groups
    about: np.ndarray  # (G,)
    total: np.ndarray  # (G, 2)
    side: int
    n: int
    parts: tuple[int, ...]
    by_name: dict[str, int]
    squares: Moments | None = None

    BY_GROUP = ("total",)
    OF_GROUP = ("about",)
    SAME = ("side",)


def moments(chips, exposures, *, about=None, side=8):
    """Sums of groups that are told apart by their totals."""
    chips, exposures = np.array(chips, np.int64), np.array(exposures, np.int64)
    groups = Groups(NOBODY, chips, exposures, np.zeros(len(chips)))
    total = np.stack([10.0 * chips, 1.0 + exposures], axis=1)
    at = 0.5 * chips if about is None else np.array(about)
    return Moments(groups, at, total, side, len(chips), (1, len(chips)), {"all": len(chips)})


def test_groups_of_both_are_in_the_sum():
    a, b, c = moments([0, 0], [1, 3]), moments([0, 1], [3, 0]), moments([0], [2])
    for found in ((a + b) + c, a + (b + c), c + b + a):
        np.testing.assert_array_equal(found.groups.chip, [0, 0, 0, 1])
        np.testing.assert_array_equal(found.groups.exposure, [1, 2, 3, 0])
        np.testing.assert_array_equal(found.total, [[0, 2], [0, 3], [0, 8], [10, 1]])
        np.testing.assert_array_equal(found.about, [0, 0, 0, 0.5])
        assert (found.n, found.parts, found.by_name) == (5, (3, 5), {"all": 5})
        assert found.side == 8 and found.squares is None


def test_chunks_without_stars_add_nothing():
    none, some = moments([], []), moments([0, 1], [1, 2])
    for found in (none + some, some + none):
        np.testing.assert_array_equal(found.total, some.total)
        np.testing.assert_array_equal(found.about, some.about)
    assert len((none + none).groups) == 0


def test_sums_of_other_things_do_not_add():
    with pytest.raises(ValueError, match="about"):
        moments([0], [1]) + moments([0], [1], about=[0.1])
    with pytest.raises(ValueError, match="side"):
        moments([0], [1]) + moments([0], [1], side=4)
