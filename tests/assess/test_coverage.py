"""The area that stars cover: known gaps are found; chance, clusters and strays do not alarm."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.assess import Requirement
from bayesdist.diagnose.residuals.binned import binned_sums, coverage_of
from bayesdist.diagnose.residuals.misfit import partitions_for
from bayesdist.infer.stars.shards import _hull
from bayesdist.model import Chip
from bayesdist.utils.checks import UNCOVERED_BY_CHANCE

SIZE = (1016.0, 508.0)
CHIP = Chip(3, "A", SIZE, (508.5, 254.5))


def covered(x, y, **options):
    zero = np.zeros(len(x))
    one = binned_sums(x, y, zero, zero, bins=partitions_for(len(x))["cells"], size=SIZE)
    return coverage_of(one, _hull(np.column_stack([x, y])), CHIP, **options)


def even(rng, n, half=1.0):
    return tuple(s / 2 + 0.5 + half * s / 2 * rng.uniform(-1, 1, n) for s in SIZE)


@pytest.mark.parametrize("n", [30, 100, 400, 6000])
def test_even_stars_never_alarm(rng, n):
    found = [covered(*even(rng, n)) for _ in range(200)]
    assert not any(one.significant for one in found)
    if n == 400:  # the mean of Renyi and Sulanke, where the mesh resolves it
        gaps = np.array([one.gap for one in found])
        error = gaps.std() / np.sqrt(len(gaps))
        assert abs(gaps.mean() - found[0].by_chance) < 0.15 * found[0].by_chance + 5 * error


@pytest.mark.parametrize("n", [300, 6000, 100_000])
@pytest.mark.parametrize("half", [0.6, 0.85])
def test_a_gap_of_known_area_is_found(rng, n, half):
    one = covered(*even(rng, n, half))
    assert abs(one.gap - (1 - half**2)) < UNCOVERED_BY_CHANCE.value * one.by_chance + 0.02
    assert one.significant
    assert f"{100 * one.gap:.0f} % of the detector" in one.sentence
    assert "chip A" in covered(*even(rng, n, half), several=True).sentence


def test_the_sentence_states_where_stars_reach(rng):
    """To the pixel, not to a point of some grid."""
    x, y = even(rng, 2000)
    inside = (x > 90.0) & (x < 950.0) & (y > 70.0)
    x, y = x[inside], y[inside]
    text = covered(x, y).sentence
    assert f"within x {x.min():.0f} to {x.max():.0f}, y {y.min():.0f} to {y.max():.0f})" in text


def test_missing_corners_are_a_gap(rng):
    """Within a circle through the middles of the sides: 1 - pi / 4 of the area is missing."""
    x, y = even(rng, 20_000)
    inside = np.hypot((x - 508.5) / 508, (y - 254.5) / 254) < 1
    one = covered(x[inside], y[inside])
    assert abs(one.gap - (1 - np.pi / 4)) < 0.03 and one.significant


def test_strays_cover_nothing(rng):
    x, y = even(rng, 6000, 0.6)
    x[:30], y[:30] = even(rng, 30)
    one = covered(x, y)
    # to the next border of a cell
    assert one.gap > 1 - (0.6 + 4 / 15) ** 2 and one.significant


def test_a_cluster_of_stars_covers_its_outskirts(rng):
    """The density is 45 times lower in the corners than in the middle."""
    x, y = even(rng, 200_000)
    r2 = ((x - 508.5) ** 2 + (y - 254.5) ** 2) / (508**2 + 254**2)
    kept = rng.uniform(size=len(x)) < 1 / (1 + 44 * r2)
    assert not covered(x[kept], y[kept]).significant


def test_a_requirement_within_the_stars_is_judged(rng):
    one = covered(*even(rng, 6000, 0.6))

    def misses(**options):
        return Requirement("r", "max", 1.0, **options).reaches_beyond(one, (33, 17))

    assert misses() and misses(chip=3) and misses(region="lower left")
    assert not misses(region="inner 50 %") and not misses(chip=1)
    corner = ((10.0, 10.0), (200.0, 10.0), (10.0, 150.0))
    assert misses(region=corner)
    whole = covered(*even(rng, 6000))
    assert not Requirement("r", "max", 1.0).reaches_beyond(whole, (33, 17))


def test_stars_on_a_line_leave_the_detector_to_others():
    """Such data are refused elsewhere; here they must not fail."""
    x = np.linspace(1.0, 1016.0, 200)
    assert covered(x, 0.5 * x).gap >= 0.0


def test_a_gap_is_no_alarm_where_an_earlier_calibration_has_the_rest(rng):
    x, y = even(rng, 400, 0.5)
    assert covered(x, y).significant and not covered(x, y, known=True).significant
    assert covered(x, y, known=True).gap == covered(x, y).gap
