"""Residuals that are lopsided or have two cores, and those that only scatter."""

from __future__ import annotations

from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from bayesdist.diagnose import score_tests
from bayesdist.diagnose.checks import score_checks, structure_checks
from bayesdist.diagnose.residuals.misfit import Misfit
from bayesdist.infer import OutlierMixture, Rejection, fit_linear
from tests import seeds
from tests.diagnose.support import assert_even, assert_no_smaller_than_chance

from .shaped import (
    SHAPE,
    SIDE,
    SIGMA,
    described,
    examined,
    gaussian,
    halo,
    matches_of,
    model_of,
    nominal_within,
    scaled,
    scene,
    student,
    student_by_axis,
    tail,
    third,
    true_map,
    two_visits,
    unequal,
)

pytestmark = pytest.mark.usefixtures("one_thread")

# what displaces the stars, how many there are, and which test has to find it
DISPLACED = {
    "visits overlap": (two_visits(0.1, lambda X: np.where(X > 0.1, 0.6, 0.05)), 3000, SHAPE[0]),
    "visits in turn": (two_visits(0.1, lambda X: 0.5 + 0.4 * X), 3000, SHAPE[0]),
    "visits in part": (two_visits(0.2, lambda X: 0.1 + 0.12 * (1 + X)), 3000, SHAPE[0]),
    "visits turned": (two_visits(0.0, lambda X: 0.5 + 0 * X, 0.2), 3000, SHAPE[2]),
    "visits alike": (two_visits(0.1, lambda X: 0.5 + 0 * X), 3000, SHAPE[3]),
    "one-sided tail": (tail(0.06, 0.3), 4000, SHAPE[0]),
    "rare long tail": (tail(0.12, 0.3), 5000, SHAPE[0]),
}


@pytest.mark.parametrize("name", DISPLACED)
def test_displaced_stars_are_found(name):
    displaced, n, test = DISPLACED[name]
    found = examined(scene(np.random.default_rng(1), n, displaced))
    assert found[test].significant and found[test].p_value < 1e-17
    assert found[test].group == "shape" and "without a label" in found[test].remedy


# displacement and own motions of a third of the stars in errors, number of stars, and the least
# fraction of 20 truths that is found, after the correction for the number of tests; 32 mas are
# eight errors of 0.02 px of 200 mas
POWER = {
    "three errors, few": (3.0, 0.0, 300, 0.4),
    "three errors": (3.0, 0.0, 1000, 1.0),
    "32 mas, few": (8.0, 0.0, 300, 1.0),
    "32 mas, own motions": (8.0, 2.0, 1000, 1.0),
    "own motions alone": (0.0, 3.0, 1000, None),
}


@pytest.mark.parametrize("name", POWER)
def test_a_third_of_the_stars_without_motions_is_found_if_it_is_displaced(name, full, capsys):
    """With its share and its distance, and with advice on motions; not if nothing has moved."""
    apart, own, n, least = POWER[name]
    found = [
        examined(scene(np.random.default_rng([46, k]), n, third(apart * SIGMA, own * SIGMA)))
        for k in range(20 if full else 5)
    ]
    tests = [one["displaced stars"] for one in found]
    share = np.mean([test.significant for test in tests])
    with capsys.disabled():
        print(f"\n{name}: {share:.2f} found, median p {np.median([t.p_value for t in tests]):.1g}")
    if least is None:
        assert not share and min(one[test].p_value for one in found for test in SHAPE) > 1e-4
        return
    assert share >= least - (0.0 if full or least == 1.0 else 0.2)
    significant = [test for test in tests if test.significant]
    assert all("give proper motions with their errors" in test.remedy for test in significant)
    if apart == 8.0:
        groups = [described(one["displaced group of stars"]) for one in found]
        assert np.mean([group.share for group in groups]) == pytest.approx(1 / 3, abs=0.04)
        distances = [np.hypot(*group.shift) for group in groups]
        assert np.mean(distances) == pytest.approx(8.0 * SIGMA, rel=0.12)


def test_two_tests_together_find_what_each_alone_would_miss():
    """Visits that differ by 2.5 errors, in so few stars that half of the cases are found."""
    displaced = two_visits(0.05, lambda X: 0.5 + 0.4 * X)
    found = [examined(scene(np.random.default_rng([12, k]), 1200, displaced)) for k in range(20)]
    alone = sum(one[SHAPE[0]].significant or one[SHAPE[2]].significant for one in found)
    assert sum(one[SHAPE[4]].significant for one in found) >= alone + 2


def test_a_halo_of_false_matches_is_found_where_it_is():
    rng = np.random.default_rng(4)
    found = examined(scene(rng, 5000, halo(0.4)))["skewness of a patch"]
    # some 300 stars lie in it: what is found by their signs alone is no less probable
    assert found.significant and found.p_value < 1e-6
    # a displacement of half the stars by 3 sigma at most, in 7 % of the field
    assert 0 < found.size < 1.5 * SIGMA * np.sqrt(0.07)
    middle = np.random.default_rng(4)
    _x, _y = middle.uniform(0.5, SIDE + 0.5, (2, 5000))
    gaussian(middle, 5000)
    expected = middle.uniform(400, SIDE - 400, 2)
    named = found.finding.split("pixel (")[1].split(")")[0].split(", ")
    assert np.hypot(*(np.array(named, float) - expected)) < 300


EVEN = (*SHAPE[:6:2], "displaced stars")  # the others are larger than chance
# noise, fraction of false matches, their circle, stars, order
INSIDE = {
    "few": (gaussian, 0.04, None, 200, 3),
    "false": (gaussian, 0.35, None, 200, 3),
    "false, even": (gaussian, 0.35, 1.0, 1000, 4),
    "t4": (student, 0.0, None, 600, 3),
    "t5 by axis": (student_by_axis, 0.2, None, 500, 5),
    "unequal": (unequal, 0.04, None, 500, 3),
    "order 7": (gaussian, 0.04, None, 500, 7),
    "many": (student, 0.35, None, 20_000, 3),
}


def p_values(name: str, seed: int) -> dict[str, float]:
    noise, false, radius, n, order = INSIDE[name]
    rng = np.random.default_rng([3, seed, list(INSIDE).index(name)])
    found = examined(scene(rng, n, noise=noise, false=false, radius=radius), order)
    return {test: found[test].p_value for test in SHAPE}


def test_probabilities_are_even_inside_the_family(full):
    """Those of patches, two cores and groups are larger than chance, by construction."""
    runs = dict.fromkeys(INSIDE, 300 if full else 3) | {"many": 60 if full else 0}
    jobs = [(name, seed) for name, n in runs.items() for seed in range(n)]
    found = seeds.over(p_values, jobs, lot=10) if full else [p_values(*job) for job in jobs]
    for test in SHAPE:
        p = np.array([values[test] for values in found])
        assert_no_smaller_than_chance(test, p)
        assert p.min() > 1e-3 / len(p)
        if test in EVEN:
            assert_even(test, p)
            if full:
                assert stats.kstest(p, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("kind", ["corner", "axis", "rising", "rising along v", "exponential"])
def test_noise_that_is_symmetric_is_not_lopsided(kind):
    """However much it differs over the field or between the axes."""
    rng = np.random.default_rng(6)
    x, y = rng.uniform(0.5, SIDE + 0.5, (2, 3000))
    factor = {
        "corner": np.where((x > 1500) & (y > 1500), 5.0, 1.0)[:, None],
        "axis": np.array([1.0, 2.0]),
        "rising": 2.0 + scaled(x)[:, None],
        "rising along v": np.column_stack([np.ones(3000), 2.0 + scaled(y)]),
        "exponential": np.exp(1.2 * scaled(x))[:, None],
    }[kind]
    found = examined(matches_of(x, y, true_map(x, y) + SIGMA * factor * gaussian(rng, 3000)))
    assert min(found[test].p_value for test in SHAPE) > 1e-3


@pytest.mark.parametrize("order", [1, 2])
def test_what_the_model_lacks_is_not_taken_for_a_shape(order):
    """Terms of the next orders, of some pixels and of a hundredth of a pixel."""
    rng = np.random.default_rng(7)
    found = examined(scene(rng, 2000), order)
    assert not any(test in found for test in SHAPE)
    small = scene(rng, 2000, lambda _, x, y: 0.1 * scaled(x)[:, None] ** 4 * [[1.0, 1.0]])
    found = examined(small, 3)
    assert found["order 4"].significant and "raise model.order" in found["order 4"].remedy
    assert min(found[test].p_value for test in SHAPE) > 1e-3


@pytest.mark.parametrize("size", [1.0, 2.0])
def test_rings_of_the_size_of_the_errors_are_no_displaced_stars(size):
    """They have two cores and correlate the residuals, which are not lopsided."""

    def rings(rng, x, y):
        away = np.stack([x, y], axis=1) - rng.uniform(-500, 2500, 2)
        r = np.hypot(*away.T)[:, None]
        wave = np.cos(2 * np.pi * r / rng.uniform(150, 400))
        return size * SIGMA * np.sqrt(2) * wave * away / r

    found = examined(scene(np.random.default_rng(13), 3000, rings))
    assert found[SHAPE[2]].significant and not found[SHAPE[0]].significant
    remedies = {test.remedy for test in found.values() if test.significant}
    assert len(remedies) == 1 and "without a label" not in remedies.pop()


@pytest.mark.parametrize("size", [1.5, 3.0])
def test_a_sine_of_the_size_of_the_errors_is_no_displaced_group(size):
    """It has two centres, like half of the stars if displaced, but follows the position."""

    def sine(rng, x, y):
        wave = np.sin(2 * np.pi * x / rng.uniform(60, 300) + rng.uniform(0, 6))
        return size * SIGMA * np.sqrt(2) * wave[:, None] * np.array([1.0, 0.3])

    found = examined(scene(np.random.default_rng(15), 3000, sine))
    assert found["displaced group of stars"].significant
    remedies = {test.remedy for test in found.values() if test.significant}
    assert remedies == {found["repeating pattern"].remedy}


def test_a_star_counts_once():
    """Rows that stand three times with the code of their star say no more than once."""
    rng = np.random.default_rng(8)
    once = scene(rng, 800, tail(0.06, 0.3), false=0.0)
    model = model_of(3)
    three = matches_of(
        # the same row thrice is refused
        np.tile(once.x, 3) + 1e-6 * rng.standard_normal(2400),
        np.tile(once.y, 3),
        np.tile(np.stack([once.u, once.v], 1), (3, 1)),
        star=np.tile(np.arange(800), 3),
    )
    found = []
    for table in (once, three):
        fit = fit_linear(table, model, rejection=Rejection(np.inf, None))
        found.append({test.name: test for test in score_tests(table, fit)})
    for name in SHAPE[:2]:
        assert found[1][name].p_value == pytest.approx(found[0][name].p_value, rel=0.2)
    assert found[0][SHAPE[0]].p_value < 1e-3


def test_a_match_circle_that_is_known_is_no_skewness():
    """About nominal positions that are off it cuts one side; the solution is right all the same."""
    matches, n_cut = nominal_within(np.random.default_rng(9), 6000, 0.14, sigma=0.04)
    assert n_cut > 150
    mixture = OutlierMixture("uniform", match_radius=0.14)
    found = examined(matches, 3, mixture, 0.14)
    for name in SHAPE:
        assert name not in found or found[name].p_value > 1e-3
    blind = matches.with_columns(u_nominal=None, v_nominal=None)
    found = examined(blind, 3, mixture, 0.14)
    assert found["skewness by position"].significant
    assert "u_nominal" in found["skewness by position"].remedy


def test_visits_without_a_label_are_a_displaced_group():
    found = examined(scene(np.random.default_rng(1), 3000, DISPLACED["visits overlap"][0]))
    [check] = score_checks(list(found.values()))
    assert check.doubt and check.sentence.startswith("a part of the stars is displaced")
    assert "exposures and visits without a label" in check.sentence


def test_what_displaced_stars_do_has_their_remedy(monkeypatch):
    """Where no single displacement describes them."""
    module = import_module("bayesdist.diagnose.score.shape")  # its package has a function `score`
    monkeypatch.setattr(module, "displaced_group", lambda *_: None)
    found = examined(scene(np.random.default_rng(1), 3000, DISPLACED["visits overlap"][0]))
    assert found["noise by position"].significant and found["noise by axis"].significant
    correlated = SimpleNamespace(facts={}, linear=None, structure=("a field",), structure_rms=1.0)
    [check] = score_checks(list(found.values()), correlated)
    assert check.doubt and "exposures or visits without a label" in check.sentence
    for wrong in ("raise model.order", "errors that depend on position", "separate errors"):
        assert wrong not in check.sentence
    assert "which may come from the shape of the residuals" in check.sentence
    misfit = Misfit(1e-9, "cells", 0.01, "pix")
    [structure] = structure_checks([misfit], None, list(found.values()))
    assert "it may come from residuals that are lopsided" in structure.sentence
    [untested] = structure_checks([misfit])
    assert "displaced as a whole" in untested.sentence


def test_structure_is_not_warned_of_beside_a_displaced_group():
    """It stays in the table, and the group doubts the verdict."""
    rng = np.random.default_rng(3)
    x, y = rng.uniform(0.5, SIDE + 0.5, (2, 2000))
    uv = true_map(x, y) + SIGMA * gaussian(rng, 2000)
    uv[rng.uniform(size=2000) < 0.35] += [4 * SIGMA, 0.0]
    found = list(examined(matches_of(x, y, uv)).values())
    [check] = score_checks(found)
    assert check.doubt and check.sentence.startswith("a part of the stars is displaced")
    [structure] = structure_checks([Misfit(1e-9, "cells", 0.01, "pix")], None, found)
    assert (structure.level, structure.sentence, structure.doubt) == ("warn", "", "")
    assert "0.01" in structure.value


def test_noise_is_held_only_where_the_residuals_are_symmetric():
    rng = np.random.default_rng(2)
    x, y = rng.uniform(0.5, SIDE + 0.5, (2, 3000))
    by_field = SIGMA * (2.0 + scaled(x)[:, None])
    correlated = SimpleNamespace(facts={}, linear=None, structure=(), structure_rms=None)
    found = examined(matches_of(x, y, true_map(x, y) + by_field * gaussian(rng, 3000)))
    [check] = score_checks(list(found.values()), correlated)
    assert "Noise" in check.name or "noise" in check.name
    assert not check.doubt and "errors that depend on position" in check.sentence


@pytest.mark.parametrize("share", [0.15, 0.2])
@pytest.mark.parametrize("angle", [0, 45])
def test_stars_that_moved_the_least_squares_solution_are_found(share, angle):
    """Displaced by ten errors they move the solution by more than the scatter of the others."""
    way = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])

    def displaced(rng, x, y):
        return (rng.uniform(size=len(x)) < share)[:, None] * 10 * SIGMA * way

    for seed in range(5):
        table = scene(np.random.default_rng([47, seed]), 900, displaced, false=0.0)
        fit = fit_linear(table, model_of(3), rejection=Rejection(np.inf, None))
        found = {test.name: test for test in score_tests(table, fit)}
        assert found["displaced stars"].significant
