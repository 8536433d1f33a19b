"""Positions of which some have fewer digits than others."""

from __future__ import annotations

import numpy as np
import pytest

from tests.diagnose.support import assert_no_smaller_than_chance

from .shaped import SIDE, SIGMA, examined, gaussian, matches_of, student, true_map

pytestmark = pytest.mark.usefixtures("one_thread")

NAME = "cut-off positions"
STEP = 0.04  # pixels


def listed(rng, digits, *, n=2500, noise=gaussian, false=0.0, part=lambda x: x > 2 * SIDE / 3):
    """Stars whose columns went through `digits` in a part of the detector."""
    x, y = rng.uniform(1.0, SIDE, (2, n))
    uv = true_map(x, y) + SIGMA * noise(rng, n)
    uv += (rng.uniform(size=n) < false)[:, None] * 0.6 * gaussian(rng, n)
    return matches_of(np.where(part(x), digits(x), x), y, uv)


def cut(x):
    return np.round(np.floor(x / STEP) * STEP, 2)


def rounded(x):
    return np.round(np.round(x / STEP) * STEP, 2)


def test_positions_that_were_cut_off_are_found():
    """Half a step is 0.02 px, of which cubic polynomials leave a part in a third of the field."""
    found = examined(listed(np.random.default_rng(1), cut))
    test = found[NAME]
    assert test.significant and test.p_value < 1e-6 and not test.held_by
    assert "add half a step" in test.remedy
    assert found["jumps"].remedy == test.remedy or not found["jumps"].significant


def test_the_remedy_that_is_followed_helps():
    """Half a step is added to the positions that were cut off."""
    matches = listed(np.random.default_rng(1), cut)
    few = np.abs(matches.x * 100 - np.round(matches.x * 100)) < 1e-6
    assert few.mean() == pytest.approx(1 / 3, abs=0.05)
    after = examined(matches.with_columns(x=matches.x + few * STEP / 2))
    assert not any(test.significant for test in after.values())


def test_digits_that_all_positions_lack_are_not_asked():
    rng = np.random.default_rng(2)
    everywhere = np.isfinite
    for digits in (1, 2, 4):
        # a tenth of all, or more where they are few, ends in 0
        matches = listed(rng, lambda x, d=digits: np.round(x, d), n=600, part=everywhere)
        assert NAME not in examined(matches)


@pytest.mark.parametrize("noise", ["even", "false", "tails"])
def test_rounded_positions_are_not_displaced(noise, full):
    """Rounded to 0.04 px star by star and in a part of the field, which is noise of 0.012 px."""
    kinds = {"even": {}, "false": {"false": 0.35}, "tails": {"noise": student}}
    p = []
    for seed in range(150 if full else 2):
        rng = np.random.default_rng([19, seed])
        found = examined(listed(rng, rounded, n=500, **kinds[noise]))
        p.append(found[NAME].p_value)
    assert_no_smaller_than_chance(NAME, np.array(p))
