"""A group of stars that is displaced as a whole: share, displacement, verdict and advice."""

from __future__ import annotations

import re

import numpy as np
import pytest
from astropy.table import Table
from scipy import stats

import bayesdist as bd
from bayesdist.data.matches import Matches
from bayesdist.diagnose.score.groups import MAX_STARS
from tests import seeds

from .shaped import (
    SIDE,
    SIGMA,
    described,
    examined,
    gaussian,
    in_circle,
    matches_of,
    student,
    student_by_axis,
    true_map,
    unequal,
)

pytestmark = pytest.mark.usefixtures("one_thread")

NAME = "displaced group of stars"
MISLEADING = ("radius", "order", "larger errors", "depend on", "too small")


def of_magnitude(mag: np.ndarray) -> np.ndarray:
    return SIGMA * np.maximum(1.0, mag - 16.0)


def stars(
    rng: np.random.Generator,
    n: int,
    share: float,
    shift: np.ndarray,
    *,
    false: float = 0.04,
    quoted: float = 1.0,
    own: float = 0.0,
    by_magnitude: bool = False,
) -> tuple[Table, float]:
    """Matched stars of which a share is displaced by `shift` (px), and the share that was drawn."""
    x, y = rng.uniform(0.5, SIDE + 0.5, (2, n))
    mag = rng.uniform(15.0, 20.0, n)
    sigma = of_magnitude(mag) if by_magnitude else np.full(n, SIGMA)
    moved = rng.uniform(size=n) < share
    uv = true_map(x, y) + sigma[:, None] * gaussian(rng, n)
    uv += moved[:, None] * (shift + own * gaussian(rng, n))
    uv += (rng.uniform(size=n) < false)[:, None] * 0.6 * gaussian(rng, n)
    table = Table({"x": x, "y": y, "u": uv[:, 0], "v": uv[:, 1]})
    if by_magnitude:
        table["mag"] = mag
    else:
        table["sigma_u"] = table["sigma_v"] = quoted * sigma
    return table, float(moved.mean())


# share, displacement in px, how the errors are given
RUNS = {
    "a third along u": (1 / 3, (4 * SIGMA, 0.0), {}),
    "a third along v, large": (1 / 3, (0.0, 8 * SIGMA), {}),
    "half along u": (0.5, (3 * SIGMA, 0.0), {}),
    "half along a diagonal": (0.5, (4 * SIGMA, 4 * SIGMA), {}),
    "a third, errors by magnitude": (1 / 3, (5 * SIGMA, 0.0), {"by_magnitude": True}),
    "half, errors by magnitude": (0.5, (5 * SIGMA, 0.0), {"by_magnitude": True}),
    "15 %": (0.15, (2 * SIGMA, 3 * SIGMA), {}),
    "15 %, errors twice as large": (0.15, (3 * SIGMA, 2 * SIGMA), {"quoted": 2.0}),
    "15 %, errors half as large": (0.15, (3 * SIGMA, 2 * SIGMA), {"quoted": 0.5}),
    "a third, with own motions": (1 / 3, (8 * SIGMA, 0.0), {"own": 2 * SIGMA}),
}


@pytest.mark.parametrize("name", RUNS)
def test_a_run_states_share_and_displacement_and_does_not_decide(name, full):
    """Each within four of its errors, which must not be larger than needed to be of use."""
    share, shift, options = RUNS[name]
    deviations = []
    for seed in range(8 if full else 1):
        rng = np.random.default_rng([71, seed, list(RUNS).index(name)])
        table, drawn = stars(rng, 1200, share, np.array(shift), **options)
        run = bd.calibrate(
            table,
            order=3,
            size=(SIDE, SIDE),
            sigma="by_magnitude" if options.get("by_magnitude") else None,
            requirements=bd.Requirement("field", "p95", 0.2),
            catalogue=bd.Catalogue("exact", sigma=0.0005, unit="pix", source="simulated"),
            settings={"data": {"unit": "pix"}, "sampler": {"target_ess": 400}},
        )
        test = next(test for test in run.diagnostics.score_tests if test.name == NAME)
        assert test.significant
        group = described(test)
        assert group.share_sigma < 0.04 and group.shift_sigma.max() < 0.5 * SIGMA
        # two halves are equivalent: either may be the displaced one
        sign = np.sign(group.shift @ shift) if share == 0.5 else 1.0
        if sign < 0:
            drawn = 1.0 - drawn
        off = [group.share - drawn, *(sign * group.shift - shift)]
        deviations.append(np.array(off) / [group.share_sigma, *group.shift_sigma])
        [margin] = run.check()
        assert margin.verdict == "undecided"
        warnings = run.diagnostics.checks
        [check] = [check for check in warnings if "displaced from the others" in check.sentence]
        advice = check.sentence.rsplit(": ", 1)[1]
        assert "proper motions" in advice and "exposure of each star" in advice
        assert check.doubt and check.sentence.startswith("a part of the stars is displaced")
        # what the group accounts for is named, and has no warning of its own
        warned = [one for one in warnings if one.level == "warn" and one.group == "Score tests"]
        assert warned == [check]
        texts = " ".join(one.sentence for one in warnings)
        for words in ("are lopsided", "have two cores", "too abruptly", "in a patch"):
            assert words not in texts
        others = [one for one in run.diagnostics.score_tests if one.cause == NAME]
        assert all(one.name in check.sentence for one in others)
        for other in (*run.diagnostics.checks_of_input, *warnings):
            for word in ("raise model.order", "wider radius", "match radius has cut"):
                assert word not in other.sentence
        assert not any(word in advice for word in MISLEADING)
    assert np.abs(deviations).max() < (4.5 if full else 4.0)


def test_visits_merged_without_a_label_are_a_group_whose_share_varies(full):
    """The second of two visits has more stars at one side, and the solution follows the mean."""
    n, found = 2000, []
    for seed in range(12 if full else 3):
        rng = np.random.default_rng([75, seed])
        x, y = rng.uniform(0.5, SIDE + 0.5, (2, n))
        angle = rng.uniform(0, 2 * np.pi)
        shift = 2.5 * SIGMA * np.array([np.cos(angle), np.sin(angle)])
        second = rng.uniform(size=n) < 0.1 + 0.8 * x / SIDE
        uv = true_map(x, y) + SIGMA * gaussian(rng, n) + second[:, None] * shift
        uv += (rng.uniform(size=n) < 0.04)[:, None] * 0.6 * gaussian(rng, n)
        test = examined(matches_of(x, y, uv))[NAME]
        assert test.significant
        group = described(test)
        low, high = (
            float(share) for share in re.findall(r"from (\d+) to (\d+) %", test.finding)[0]
        )
        # 5 % and 95 % of the stars: 0.14 and 0.86
        assert 5 < low < 30 and 70 < high < 95
        sign = np.sign(group.shift @ shift)  # either visit may be the displaced one
        drawn = second.mean() if sign > 0 else 1 - second.mean()
        off = [group.share - drawn, *(sign * group.shift - shift)]
        found.append(np.array(off) / [group.share_sigma, *group.shift_sigma])
        assert group.share_sigma < 0.04 and group.shift_sigma.max() < 0.25 * SIGMA
    assert np.abs(found).max() < 4.5


def test_errors_that_are_tilted_and_very_unequal(full):
    """Each star has its own ellipse, three to one, of any direction; displacements are in u, v."""
    shift = np.array([0.0, 6 * SIGMA])
    for seed in range(8 if full else 2):
        rng = np.random.default_rng([72, seed])
        n = 1500
        x, y = rng.uniform(0.5, SIDE + 0.5, (2, n))
        angle, size = rng.uniform(0, np.pi, n), SIGMA * np.exp(0.4 * rng.standard_normal(n))
        along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        a, b = 2.0 * size, 0.67 * size
        noise = (a * rng.standard_normal(n))[:, None] * along
        noise += (b * rng.standard_normal(n))[:, None] * across
        covariance = (a**2)[:, None, None] * along[:, :, None] * along[:, None]
        covariance += (b**2)[:, None, None] * across[:, :, None] * across[:, None]
        moved = rng.uniform(size=n) < 0.3
        table = matches_of(x, y, true_map(x, y) + noise + moved[:, None] * shift)
        test = examined(table.with_covariances(covariance))[NAME]
        assert test.significant
        group = described(test)
        assert np.abs(group.share - moved.mean()) < 4 * group.share_sigma < 0.15
        assert np.all(np.abs(group.shift - shift) < 4 * group.shift_sigma)
        assert group.shift_sigma.max() < 0.5 * SIGMA


def cross(rng: np.random.Generator, n: int) -> np.ndarray:
    """Of half of the stars the error is three times as large along u, of the others along v."""
    e = gaussian(rng, n)
    along_u = rng.uniform(size=n) < 0.5
    e[np.arange(n), np.where(along_u, 0, 1)] *= 3
    return e


# noise, fraction of false matches, radius of their circle, how quoted errors follow: of one star
# relative to its true error
NULL = {
    "normal": (gaussian, 0.04, None, lambda _, n: np.ones(n)),
    "jitter": (gaussian, 0.04, None, lambda rng, n: np.exp(0.5 * rng.standard_normal(n))),
    "t4": (student, 0.0, None, lambda _, n: np.ones(n)),
    "t5 by axis": (student_by_axis, 0.2, None, lambda _, n: np.ones(n)),
    "35 % false": (gaussian, 0.35, None, lambda _, n: np.ones(n)),
    "35 % false, in a circle": (gaussian, 0.35, 1.0, lambda _, n: np.ones(n)),
    "errors twice as large": (gaussian, 0.04, None, lambda _, n: np.full(n, 2.0)),
    "errors half as large": (gaussian, 0.04, None, lambda _, n: np.full(n, 0.5)),
    "errors that differ, alike in the table": (unequal, 0.04, None, lambda _, n: np.ones(n)),
    "cross": (cross, 0.04, None, lambda _, n: np.ones(n)),
}
# what matching or writing did to normal errors
TREATED = (
    *("two classes of errors", "cut at a radius", "cut at a radius, unequal errors"),
    *("rounded", "by magnitude"),
)


def null_stars(name: str, rng: np.random.Generator, n: int) -> Matches:
    x, y = rng.uniform(0.5, SIDE + 0.5, (2, n))
    true, noise = true_map(x, y), SIGMA * gaussian(rng, n)
    sigma = np.full(n, SIGMA)
    if name in NULL:
        errors, false, radius, quoted = NULL[name]
        noise = SIGMA * errors(rng, n)
        far = 0.6 * gaussian(rng, n) if radius is None else in_circle(rng, n, radius)
        noise = noise + (rng.uniform(size=n) < false)[:, None] * far
        sigma = SIGMA * quoted(rng, n)
        if name == "jitter":  # in addition to the quoted errors
            noise = noise + sigma[:, None] * gaussian(rng, n)
    elif name == "rounded":
        noise = np.round((true + noise) / 0.1) * 0.1 - true
    elif name == "two classes of errors":  # the larger ones are quoted larger than they are
        sigma = SIGMA * np.where(rng.uniform(size=n) < 0.3, 5.0, 1.0)
        noise = noise + 0.5 * sigma[:, None] * gaussian(rng, n)
    elif name == "by magnitude":
        mag = rng.uniform(15.0, 20.0, n)
        sigma = of_magnitude(mag)
        noise = sigma[:, None] * gaussian(rng, n)
    else:
        if "unequal" in name:
            sigma = SIGMA * np.exp(0.5 * rng.standard_normal(n))
            noise = sigma[:, None] * gaussian(rng, n)
        kept = np.hypot(*noise.T) < 2 * SIGMA
        x, y, true, noise, sigma = x[kept], y[kept], true[kept], noise[kept], sigma[kept]
    u, v = (true + noise).T
    return Matches(x, y, u, v, sigma_u=sigma, sigma_v=sigma.copy())


def p_of_null(name: str, seed: int) -> float:
    rng = np.random.default_rng([73, seed])
    n = (300, 700, 2500)[seed % 3]
    return examined(null_stars(name, rng, n))[NAME].p_value


KINDS_OF_NULL = (*NULL, *TREATED)


def test_noise_about_one_centre_has_no_displaced_group(full):
    """Over all kinds together, and of each kind: probabilities are larger than chance."""
    jobs = [(name, seed) for name in KINDS_OF_NULL for seed in range(90 if full else 3)]
    found = seeds.over(p_of_null, jobs, lot=15) if full else [p_of_null(*job) for job in jobs]
    by_kind: dict[str, list[float]] = {}
    for (name, _), p in zip(jobs, found, strict=True):
        by_kind.setdefault(name, []).append(p)
    for values in (*by_kind.values(), found):
        p = np.array(values)
        for level in (0.1, 0.01, 1e-3):
            beyond = int((p <= level).sum())
            assert stats.binom.sf(beyond - 1, len(p), level) > 1e-4


def test_stars_in_a_periodic_order_are_thinned_at_random():
    """Of twice as many stars as are examined, every second one is displaced."""
    rng = np.random.default_rng(76)
    n = 2 * MAX_STARS
    x, y = rng.uniform(0.5, SIDE + 0.5, (2, n))
    uv = true_map(x, y) + SIGMA * gaussian(rng, n)
    uv[::2] += [4 * SIGMA, 0.0]
    test = examined(matches_of(x, y, uv))[NAME]
    assert test.significant
    group = described(test)
    assert abs(group.share - 0.5) < 4 * group.share_sigma < 0.1


def test_a_run_of_normal_stars_is_decided():
    table, _ = stars(np.random.default_rng(74), 1200, 0.0, np.zeros(2))
    run = bd.calibrate(
        table,
        order=3,
        size=(SIDE, SIDE),
        requirements=bd.Requirement("field", "p95", 0.2),
        catalogue=bd.Catalogue("exact", sigma=0.0005, unit="pix", source="simulated"),
        settings={"data": {"unit": "pix"}, "sampler": {"target_ess": 400}},
    )
    assert run.check()[0].verdict == "met"


def found(share: float, sigmas: float, n: int, seed: int) -> bool:
    rng = np.random.default_rng([75, seed])
    angle = rng.uniform(0, 2 * np.pi)
    shift = sigmas * SIGMA * np.array([np.cos(angle), np.sin(angle)])
    table, _ = stars(rng, n, share, shift)
    x, y, u, v = (np.asarray(table[name]) for name in "xyuv")
    return bool(examined(matches_of(x, y, np.stack([u, v], axis=1)))[NAME].significant)


# share, displacement in errors, stars: fraction found, of 40 truths in docs/validation.md
POWER = {(0.5, 3.0, 1000): 0.8, (0.33, 3.0, 1000): 0.9, (0.15, 5.0, 300): 0.8}


@pytest.mark.parametrize("case", POWER)
def test_power(case, full):
    jobs = [(*case, seed) for seed in range(40 if full else 4)]
    hits = seeds.over(found, jobs, lot=10) if full else [found(*job) for job in jobs]
    assert np.mean(hits) >= POWER[case] - (0.0 if full else 0.25)
