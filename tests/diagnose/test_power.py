"""What the tests find, how large they say it is, and what they would have found."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.diagnose import score_tests
from bayesdist.utils.checks import SCORE_TESTS
from tests.reduced import only_in_full

from .. import seeds
from ..infer.patterned import moved
from .support import SIGMA, TIME, Scene, by_name, polynomial, student, unequal

pytestmark = pytest.mark.usefixtures("one_thread")

FEW = range(3)


def median_p(found, name: str) -> float:
    return float(np.median([one[name].p_value for one in found]))


def sizes(found, name: str) -> float:
    """Median size of a test."""
    return float(np.median([one[name].size for one in found]))


@pytest.mark.parametrize(
    "scene",
    [
        Scene(1500, 1), Scene(1500, 3), Scene(1500, 5), Scene(1500, 3, noise=student),
        Scene(1500, 3, fraction=0.05), Scene(1500, 3, fraction=0.05, mixture=True),
        Scene(1500, 2, "shift_rotation", 5),
    ],
)  # fmt: skip
def test_terms_of_the_next_order_are_found(scene):
    """0.003 pixels along each axis, with noise of 0.02: a seventh of the scatter of one star."""
    rms = 0.003 * np.sqrt(2)
    found = [scene.with_pattern(k, polynomial(scene.order + 1, rms, k)) for k in FEW]
    name = f"order {scene.order + 1}"
    assert median_p(found, name) < 1e-6
    assert sizes(found, name) == pytest.approx(rms, rel=0.25)
    # and no other test speaks for it, but that of the edges, where such terms are largest
    others = [t for one in found for t in one.values() if t.name not in (name, "edges")]
    assert not any(one.significant for one in others)


def test_an_order_too_few_is_seen_at_once():
    """Also with terms of the order after it, which have a row of their own."""
    scene = Scene(1500, 3)
    found = scene.with_pattern(1, polynomial(5, 0.01, 1))
    assert found["order 5"].significant and not found["order 4"].significant
    assert found["order 5"].remedy == "raise model.order to 5"


def test_trails_of_charge_transfer_are_found():
    """0.005 pixels for each magnitude at the far edge, nothing at the amplifier."""

    def trails(table):
        far = table.y / 800.0
        return (0.005 * (table.mag - 14) * far)[:, None] * [[0.0, 1.0]]

    found = [Scene(1500, 3).with_pattern(k, trails) for k in FEW]
    assert median_p(found, "magnitude") < 1e-15
    # magnitudes spread evenly over 8, and far with mean square 1/3
    assert sizes(found, "magnitude") == pytest.approx(0.005 * 8 / np.sqrt(36), rel=0.2)
    # of the noise of v alone there is more, which is true
    rest = {t.name for one in found for t in one.values() if t.significant}
    assert rest <= {"magnitude", "noise by axis"}


def test_trails_that_grow_with_time_are_found():
    """Nothing at the first date, 0.015 pixels for each magnitude at the far edge at the last."""

    def trails(table):
        grown = (table.epoch - table.epoch.min()) / np.ptp(table.epoch)
        return (0.015 * (table.mag - 14) * grown * table.y / 800.0)[:, None] * [[0.0, 1.0]]

    scene = Scene(2000, 2, "shift_rotation", 10)
    found = [scene.with_pattern(k, trails) for k in FEW]
    assert median_p(found, "magnitude in time") < 1e-6
    assert median_p(found, "magnitude") < 1e-6  # there is some on the mean, too


def test_trails_that_stay_do_not_grow():
    scene = Scene(2000, 2, "shift_rotation", 10)

    def trails(table):
        return (0.005 * (table.mag - 14) * table.y / 800.0)[:, None] * [[0.0, 1.0]]

    found = [scene.with_pattern(k, trails) for k in FEW]
    assert not any(one["magnitude in time"].significant for one in found)


@pytest.mark.parametrize("scene", [Scene(1500, 3), Scene(3000, 2, "shift_rotation", 5)])
def test_the_phase_of_the_pixel_is_found(scene):
    """A wave of one pixel, 0.006 pixels high along u: a fourth of the scatter of one star."""

    def wave(table):
        return 0.006 * np.sin(2 * np.pi * table.x + 0.7)[:, None] * [[1.0, 0.0]]

    found = [scene.with_pattern(k, wave) for k in FEW]
    assert median_p(found, "pixel phase") < 1e-6
    assert sizes(found, "pixel phase") == pytest.approx(0.006 / np.sqrt(2), rel=0.25)
    others = [t for one in found for t in one.values() if t.name != "pixel phase"]
    assert not any(one.significant for one in others)
    assert found[0]["pixel phase"].held_by == ""


def test_pixels_without_phases_are_not_asked():
    """Positions that were rounded to whole pixels have one phase."""
    model, table = Scene(1500, 2).data(1)
    whole = table.with_columns(x=np.round(table.x), y=np.round(table.y))
    fit = Scene(1500, 2).solve(model, whole)
    assert "pixel phase" not in by_name(score_tests(whole, fit))


def test_refraction_by_colour_is_found():
    def refraction(table):
        return (0.01 * (table.colour - 1))[:, None] * [[1.0, 0.5]]

    found = [Scene(1500, 3).with_pattern(k, refraction) for k in FEW]
    assert median_p(found, "colour") < 1e-5
    assert sizes(found, "colour") == pytest.approx(0.01 * 0.3 * np.sqrt(1.25), rel=0.25)


def breathing_scales(scale: float, seed: int) -> np.ndarray:
    """Scales of the exposures, in pixels at the edge."""
    return scale * np.random.default_rng([8, seed]).standard_normal(50)


def breathing(scale: float, seed: int):
    each = breathing_scales(scale, seed)

    def pattern(table):
        w = np.stack([table.x - 500, table.y - 400], 1) / 500
        return each[table.exposure][:, None] * w

    return pattern


@pytest.mark.parametrize("frames", ["none", "shift_rotation"])
def test_breathing_of_exposures_is_found(frames):
    scene = Scene(2000, 2, frames, 10)
    found = [scene.with_pattern(k, breathing(0.015, k)) for k in FEW]
    assert median_p(found, "exposures") < 1e-8
    true = []
    for k in FEW:
        each = breathing_scales(0.015, k)[:10]
        # about their mean, which is a scale of the polynomials; the detector is 1000 x 800
        true.append(each.std() * np.sqrt((1 + 0.8**2) / 3))
    assert sizes(found, "exposures") == pytest.approx(np.median(true), rel=0.25)
    fitted = Scene(2000, 2, "shift_rotation_scale", 10)
    found = [fitted.with_pattern(k, breathing(0.015, k)) for k in FEW]
    assert median_p(found, "exposures") > 0.01


def drifting(rate: float, power: int):
    """A skew that goes with time; in pixels at the edge."""

    def pattern(table):
        t = (table.epoch - 2005) / 3
        return (rate * t**power * (table.x - 500) / 500)[:, None] * [[0.0, 1.0]]

    return pattern


def test_drift_and_its_curvature_are_found():
    still, moving = Scene(2000, 2, "shift", 12), Scene(2000, 2, "shift", 12, time=TIME)
    found = [still.with_pattern(k, drifting(0.01, 1)) for k in FEW]
    assert median_p(found, "drift") < 1e-6
    assert found[0]["drift"].remedy == "add time-dependent terms to model.tdd"
    # TIME has no skew
    found = [moving.with_pattern(k, drifting(0.01, 1)) for k in FEW]
    assert median_p(found, "drift") < 1e-6
    found = [moving.with_pattern(k, drifting(0.01, 2)) for k in FEW]
    assert median_p(found, "curvature in time") < 1e-6


@pytest.mark.parametrize(
    ("name", "factor"),
    [
        ("position", lambda t: np.where((t.x < 300) & (t.y < 300), 1.5, 1.0)),
        ("magnitude", lambda t: np.where(t.mag > 16.5, 1.3, 1.0)),
        ("exposure", lambda t: np.where(t.exposure == 2, 1.4, 1.0)),
        ("axis", lambda t: np.stack([np.full(len(t), 1.2), np.ones(len(t))], 1)),
    ],
)
@pytest.mark.parametrize("mixture", [False, True])
def test_noise_that_its_errors_do_not_describe_is_found(name, factor, mixture, full):
    if mixture and name != "position" and not full:
        pytest.skip("a mixture, and this noise without one, are run: set BAYESDIST_FULL=1")
    scene = Scene(2500, 1, n_exposures=8, mixture=mixture, fraction=0.03 * mixture)
    found, sigmas = [], []
    for seed in FEW:
        model, table = scene.data(seed)
        by = factor(table).reshape(len(table), -1)
        rng = np.random.default_rng([5, seed])
        more = SIGMA * np.sqrt(by**2 - 1) * rng.standard_normal((len(table), 2))
        table = moved(table, more)
        found.append(by_name(score_tests(table, scene.solve(model, table))))
        sigma = SIGMA * np.broadcast_to(by, (len(table), 2))
        sigmas.append(sigma.std())
        # quoted rightly, it is no finding
        right = table.with_errors(tuple(sigma.T))
        good = by_name(score_tests(right, scene.solve(model, right)))
        assert not good[f"noise by {name}"].significant
    assert median_p(found, f"noise by {name}") < 1e-6
    assert sizes(found, f"noise by {name}") == pytest.approx(np.median(sigmas), rel=0.35)
    quiet = {"position", "magnitude", "exposure", "axis"} - {name}
    assert not any(one[f"noise by {other}"].significant for one in found for other in quiet)


def test_noise_of_any_shape_leaves_the_other_tests_alone():
    """Noise that is three times as large at the edges, quoted alike."""
    for seed in FEW:
        scene = Scene(1500, 3)
        model, table = scene.data(seed)
        edge = np.abs(table.x - 500) / 500
        rng = np.random.default_rng([6, seed])
        table = moved(table, 3 * SIGMA * edge[:, None] * rng.standard_normal((1500, 2)))
        found = by_name(score_tests(table, scene.solve(model, table)))
        assert found["noise by position"].p_value < 1e-20
        rest = [one for one in found.values() if not one.name.startswith("noise")]
        assert min(one.p_value for one in rest) > 1e-3


# -- what would have been found --------------------------------------------------------------------


def is_found(scene: Scene, name: str, pattern, seed: int) -> bool:
    """A pattern as large as the data without it say, at the level at which it is alone."""
    smallest = scene.tests(seed)[name].smallest
    found = scene.with_pattern(seed, pattern(smallest, seed))
    return found[name].p_value < SCORE_TESTS.value / len(found)


def next_order(order):
    return lambda size, seed: polynomial(order + 1, size, seed)


def of_magnitude(size, seed):
    c = np.random.default_rng([2, seed]).standard_normal((3, 2))
    c *= size / np.sqrt((c**2).sum(axis=1) @ [1, 1 / 3, 1 / 3]) / (8 / np.sqrt(12))

    def pattern(table):
        X, Y = (table.x - 500) / 500, (table.y - 400) / 400
        return (table.mag - 14)[:, None] * (np.stack([np.ones_like(X), X, Y], 1) @ c)

    return pattern


def of_exposures(size, seed):
    """Deviations of all linear terms but shift and rotation, of this rms."""
    c = np.random.default_rng([2, seed]).standard_normal((8, 3))
    c -= c.mean(axis=0)

    def pattern(table):
        x, y = (table.x - 500) / 500, (table.y - 400) / 500
        shapes = np.stack([[x, y], [x, -y], [y, x]])  # (3, 2, N)
        field = np.einsum("nk,kan->na", c[table.exposure], shapes)
        return field * size / np.sqrt((field**2).sum(axis=1).mean())

    return pattern


SMALLEST = {
    "order": (Scene(1500, 3), "order 4", next_order(3)),
    "order of few": (Scene(60, 1), "order 2", next_order(1)),
    "order with long tails": (Scene(400, 2, noise=unequal), "order 3", next_order(2)),
    "order in a mixture": (Scene(500, 2, fraction=0.05, mixture=True), "order 3", next_order(2)),
    "magnitude": (Scene(500, 2), "magnitude", of_magnitude),
    "exposures": (Scene(800, 1, "shift_rotation", 8), "exposures", of_exposures),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", SMALLEST)
def test_smallest_is_found_nine_times_in_ten(case, full):
    if not full and case not in ("order", "order of few"):
        pytest.skip("two of them are run: set BAYESDIST_FULL=1")
    runs = 400 if full else 16
    found = sum(seeds.over(_is_found, [(case, k) for k in range(runs)], lot=20) if full
                else [_is_found(case, k) for k in range(runs)])  # fmt: skip
    # the noise that it is computed from is itself an estimate: two per cent either way
    assert stats.binom.cdf(found, runs, 0.88) > 1e-3, found / runs
    if full:  # all of a few may be found
        assert stats.binom.sf(found - 1, runs, 0.95) > 1e-3, found / runs


def _is_found(case: str, seed: int) -> bool:
    return is_found(*SMALLEST[case], seed)


@only_in_full("the smallest of others are run")
@pytest.mark.slow
def test_smallest_of_the_noise_is_found_nine_times_in_ten(full):
    """Parts of the data of unequal noise, of both signs."""
    runs = 400 if full else 8
    found = sum(seeds.over(noise_is_found, [(k,) for k in range(runs)], lot=20) if full
                else [noise_is_found(k) for k in range(runs)])  # fmt: skip
    assert stats.binom.cdf(found, runs, 0.88) > 1e-3, found / runs
    if full:  # all of a few may be found
        assert stats.binom.sf(found - 1, runs, 0.96) > 1e-3, found / runs


def noise_is_found(seed: int) -> bool:
    scene = Scene(3000, 1, n_exposures=6)
    model, table = scene.data(seed)
    fit = scene.solve(model, table)
    before = by_name(score_tests(table, fit))["noise by exposure"]
    each = np.random.default_rng([4, seed]).standard_normal(6)
    each -= each.mean()
    each *= before.smallest / SIGMA / each.std()
    uv = model.predict(fit.mean, table.x, table.y)
    stretch = 1 + each[table.exposure]
    truth = table.with_columns(
        u=uv[:, 0] + (table.u - uv[:, 0]) * stretch, v=uv[:, 1] + (table.v - uv[:, 1]) * stretch
    )
    found = by_name(score_tests(truth, scene.solve(model, truth)))
    return found["noise by exposure"].p_value < SCORE_TESTS.value / len(found)
