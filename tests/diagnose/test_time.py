"""Chips that drift against each other, and stars that move: found, of what size, and when not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from bayesdist.diagnose.score.motions import visit_codes
from bayesdist.model import TimeDependence
from bayesdist.utils.checks import SCORE_TESTS
from tests.reduced import case_in_full

from .. import seeds
from .dated import DRIFT, Dated
from .support import assert_even, assert_no_smaller_than_chance, student, unequal

pytestmark = pytest.mark.usefixtures("one_thread")

FEW = range(3)
OPENING, TURNING = 0.006, 0.01  # pixels a year
NULL = {
    "usual": Dated(),
    "drift": Dated(frames="shift", time=DRIFT),
    "affine": Dated(frames="affine"),
    "student": Dated(noise=student),
    "unequal": Dated(noise=unequal),
    "motions of the catalogue": Dated(motion=0.004),
    "one chip for each star": Dated(motion=0.01, wander=0.0),
    "few visits": Dated(exposures=6, stars=110),
}
RESTLESS = Dated(restless=0.02)


@pytest.mark.parametrize("frames", ["shift_rotation", "affine"])
def test_a_gap_that_opens_is_found(frames):
    scene = Dated(frames=frames, gap=OPENING)
    found = [scene.tests(k) for k in FEW]
    gap = [one["gap"] for one in found]
    assert all(one.significant for one in gap)
    assert np.median([one.size for one in gap]) == pytest.approx(OPENING, rel=0.15)
    assert all(one.unit == "pix/yr" for one in gap)
    assert "chip B drifts along y against chip A" in gap[0].finding and "pix/yr" in gap[0].finding
    assert "model.tdd.terms" in gap[0].remedy
    assert not any(one["motions"].significant for one in found)


def test_a_chip_that_turns_is_found():
    gap = [Dated(turn=TURNING).of_time(k)["gap"] for k in FEW]
    assert all("in rotation" in one.family.present for one in gap)
    assert np.median([one.p_value for one in gap]) < 1e-4
    assert np.median([one.size for one in gap]) == pytest.approx(TURNING, rel=0.15)


def test_a_drift_that_is_fitted_is_no_finding():
    """What is left to be asked is the rotation."""
    constants = TimeDependence((("u", 0, 0), ("v", 0, 0)), (2007.0,))
    held, free = (
        Dated(frames="none", gap=OPENING),
        Dated(frames="none", gap=OPENING, time=constants),
    )
    assert held.of_time(0)["gap"].p_value < 1e-5
    assert free.of_time(0)["gap"].p_value > 1e-3


def test_a_gap_that_is_restless_does_not_drift():
    """Exposures deviate by as much as a drift would move in three years: that is noise here."""
    p = np.array([RESTLESS.of_time(k)["gap"].p_value for k in range(12)])
    assert p.min() > 1e-3 and 0.2 < p.mean() < 0.8


def test_stars_that_move_are_found():
    """A fifth of them, by as much in a year as an exposure's error."""
    found = [Dated(moving=0.2, speed=0.02).tests(k) for k in FEW]
    motions = [one["motions"] for one in found]
    assert all(one.significant for one in motions)
    assert "the catalogue does not have" in motions[0].finding
    assert "proper motions" in motions[0].remedy
    assert not any(one["gap"].significant for one in found)


def test_the_size_of_motions_is_theirs():
    """Of all stars, small enough that none is rejected."""
    size = [Dated(moving=1.0, speed=0.005).of_time(k)["motions"].size for k in range(6)]
    assert np.mean(size) == pytest.approx(0.005 * np.sqrt(2), rel=0.1)


def test_motions_within_the_errors_of_the_catalogue_are_no_finding():
    stated = Dated(motion=0.005)
    unstated = replace(stated, stated=False)
    p = np.array([[one.of_time(k)["motions"].p_value for one in (stated, unstated)] for k in FEW])
    assert (p[:, 0] > 1e-3).all() and (p[:, 1] < 1e-6).all()


def test_what_cannot_be_asked_is_left_out():
    assert set(Dated().of_time(0)) == {"gap", "motions"}
    # a line through three visits has no scatter; three detections of a star say nothing
    assert Dated(exposures=3).of_time(0) == {}


def test_exposures_of_one_day_are_one_visit():
    epoch = np.array([2005.0, 2003.001, 2003.0, 2005.002, 2008.0])
    assert visit_codes(epoch).tolist() == [1, 0, 0, 1, 2]
    apart = np.array([2003.0, 2003.1])
    assert visit_codes(apart).tolist() == [0, 1]


def probabilities(name: str, seed: int) -> dict[str, float]:
    return {key: one.p_value for key, one in NULL[name].of_time(seed).items()}


@pytest.mark.slow
def test_probabilities_are_even(full):
    """Where nothing drifts and nothing moves: of 1 % at most 1 %, and evenly."""
    runs = 400 if full else 3
    jobs = [(name, seed) for name in NULL for seed in range(runs)]
    found = seeds.over(probabilities, jobs, lot=20) if full else [probabilities(*j) for j in jobs]
    pooled: dict[str, list[float]] = {}
    for (scene, _), values in zip(jobs, found, strict=True):
        for test, p in values.items():
            pooled.setdefault(test, []).append(p)
            if full:
                pooled.setdefault(f"{scene}: {test}", []).append(p)
    for test, values in pooled.items():
        assert_no_smaller_than_chance(test, np.array(values))
        assert_even(test, np.array(values))


def is_found(name: str, seed: int) -> bool:
    """An effect as large as the data without it say, at the level at which it is alone."""
    level = SCORE_TESTS.value / 20
    scene = Dated()
    smallest = scene.of_time(seed)[name].smallest(level)
    with_it = {
        "gap": replace(scene, turn=smallest),  # rotation is what is known least
        "motions": replace(scene, moving=1.0, speed=smallest / np.sqrt(2)),
    }[name]
    return with_it.of_time(seed)[name].p_value < level


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gap", case_in_full("motions", instead="the gap is run")])
def test_smallest_is_found_nine_times_in_ten(name, full):
    runs = 400 if full else 12
    jobs = [(name, seed) for seed in range(runs)]
    found = sum(seeds.over(is_found, jobs, lot=20) if full else [is_found(*job) for job in jobs])
    assert stats.binom.cdf(found, runs, 0.88) > 1e-3, found / runs
