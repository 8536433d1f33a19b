"""Groups against a plain dictionary of keys."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.model.grouping import group_by


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
