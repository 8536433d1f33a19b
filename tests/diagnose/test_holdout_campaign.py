"""Held-out stars and exposures of campaigns: right predictions pass as often as they should.

Every star has one error of the catalogue in all of its exposures, and these scatter in scale, shear
and in where their chips lie.
"""

from __future__ import annotations

import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import binom, kstest

from bayesdist.data.preparing import HoldoutSpec, split_matches
from bayesdist.diagnose.holdout.predictive import frames_for
from bayesdist.diagnose.holdout.validation import holdout_validation
from bayesdist.errors import InputError
from bayesdist.infer.catalogue.star_covariance import star_covariance, star_influence
from bayesdist.report.sections.residuals import holdout_coverage, holdout_table
from tests.diagnose.held_campaign import field, judged, solved
from tests.reduced import only_in_full

RUNS = 60 if os.environ.get("BAYESDIST_FULL") else 4
WHOLE = ("j004", "j007")


def aside(seed: int) -> HoldoutSpec:
    return HoldoutSpec(0.25, WHOLE, seed)


def assert_calibrated(results) -> None:
    """Probabilities of each kind of test are uniform, or, of counts and few draws, larger."""
    found: dict = {}
    for one in results:
        for t in one.tests:
            key = (t.name, t.part if t.index >= 0 else f"{t.part} together")
            found.setdefault((*key, t.index) if t.name == "distribution" else key, []).append(
                t.p_value
            )
    for key, several in found.items():
        p = np.array(several)
        # the scatter of eight exposures is not well known, and its draws are wide; tails are counts
        larger = key[0] in ("tails", "deviation")
        side = "greater" if larger else "two-sided"
        assert kstest(p, "uniform", alternative=side).pvalue > 1e-4 or (
            larger and (p < 0.05).sum() <= binom.ppf(0.999, p.size, 0.05)
        ), (key, p.mean(), (p < 0.05).mean())
    alarms = sum(one.p_value < 0.05 for one in results)
    assert alarms <= binom.ppf(0.999, len(results), 0.05)


@only_in_full("matched stars are run")
@pytest.mark.slow
def test_right_predictions_have_uniform_probabilities() -> None:
    assert_calibrated([judged(field(seed), aside(seed)) for seed in range(RUNS)])


@pytest.mark.slow
@only_in_full("exposures that point elsewhere are judged")
def test_one_pointing_has_uniform_probabilities() -> None:
    """All exposures see the same stars in the same places: what these do to the fit is shared."""
    runs = range(200, 200 + RUNS // 2)
    assert_calibrated([judged(field(seed, one_pointing=True), aside(seed)) for seed in runs])


@pytest.mark.slow
@only_in_full("test_holdout has false matches")
def test_false_matches_raise_no_alarm() -> None:
    runs = range(400, 400 + RUNS // 2)
    assert_calibrated(
        [judged(field(seed, fraction=0.04), aside(seed), mixture=True) for seed in runs]
    )


def test_errors_of_stars_that_are_taken_for_independent_would_be_alarms() -> None:
    """The same stars, each match with an error of its own: what exposures share is not known."""
    one = field(1, one_pointing=True, centroid=0.004)
    split = split_matches(one.matches, HoldoutSpec(0.25, (), 1))
    _, right = solved(one, split, ())
    wrong = replace(right, stars=None)
    found = [holdout_validation(p, split.held) for p in (right, wrong)]
    assert not found[0].doubtful and found[1].doubtful


# -- what went wrong in one exposure is caught ----------------------------------------------------


def of(exposure: int, shift):
    """A displacement (N, 2) of the detector's positions in one exposure."""

    def bent(x, y, codes, chip):
        return np.stack(shift(x, y, chip), axis=1) * (codes == exposure)[:, None]

    return bent


def test_a_chip_that_is_displaced_is_named() -> None:
    """0.08 pixels, ten times the scatter: the frame takes it up, and residuals do not show it."""
    wrong = of(3, lambda x, y, chip: (0.08 * (chip == 1), 0 * x))
    found = judged(field(2, bent=wrong), aside(2))
    assert found.level == "fail"
    assert found.tests[0].name == "deviation"
    assert found.verdict.startswith("the WFC1.shift u of exposure j004, held out whole, deviates")
    assert abs(found.tests[0].value) == pytest.approx(0.08, abs=0.03)
    shown = SimpleNamespace(diagnostics=SimpleNamespace(holdout=found))
    coverage, table = holdout_coverage(shown), holdout_table(shown)
    assert [row[:2] for row in coverage.rows] == [(a, f"{k} σ") for a in "uv" for k in (1, 2)]
    assert table.rows[0][0] == "deviation from other exposures"


def test_a_scale_that_is_off_is_named() -> None:
    """By 1e-4, what velocity aberration does where it is not corrected."""
    found = judged(field(3, n_exposures=16, wrong={"j007.scale": 1e-4}), aside(3))
    assert found.level == "fail"
    assert abs(found.tests[0].value) == pytest.approx(1e-4, abs=3e-5)
    assert found.verdict.startswith("the scale of exposure j007, held out whole, deviates by ")


def test_a_defocused_exposure_is_named() -> None:
    """Centroids that are 1.5 times as bad."""
    one = field(4, n_stars=1200)
    m, rng = one.matches, np.random.default_rng(1)
    there = (m.exposure == 3)[:, None]
    blur = np.sqrt(1.5**2 - 1) * m.sigma_u[:, None] * rng.standard_normal((len(m), 2)) * there
    moved = replace(m, u=m.u + blur[:, 0], v=m.v + blur[:, 1])
    found = judged(replace(one, matches=moved), aside(4))
    assert found.level == "fail"
    assert found.verdict.startswith("in exposure j004, held out whole")
    assert "times as large as predicted" in found.verdict


def test_another_distortion_is_named_by_its_place() -> None:
    """0.1 pixels of the second order, which leave the exposure's mean where it was."""
    wave = of(3, lambda x, y, chip: (0.1 * (((x - 2048) / 2048) ** 2 - 1 / 3), 0 * y))
    found = judged(field(5, bent=wave, n_stars=2400), aside(5))
    assert found.level == "fail"
    assert "in exposure j004, held out whole" in found.verdict
    means = [t for t in found.tests if (t.name, t.part) == ("offset", "exposure")]
    places = [t for t in found.tests if (t.name, t.part) == ("offset", "place in exposure")]
    assert min(t.p_value for t in places) < 1e-6 < min(t.p_value for t in means)


def test_displaced_pointings_are_no_misfit() -> None:
    """Where the telescope pointed, and its roll, are anything."""
    wrong = {"j004.shift_u": 500.0, "j004.shift_v": -300.0, "j004.rotation": 2.0}
    found = judged(field(6, wrong=wrong), aside(6))
    assert found.level == "pass" and found.n_left_out == 0


def test_a_pattern_of_the_detector_shows_whatever_the_rolls() -> None:
    """Along the sky's axes exposures of many roll angles would average it away."""

    def bump(x, y, codes, chip):
        size = 0.06 * np.exp(-0.5 * ((x - 3000) ** 2 + (y - 500) ** 2) / 250**2) * (chip == 2)
        return np.stack([size, size], axis=1)

    found = judged(field(7, bent=bump, n_stars=3000, n_exposures=12), aside(7))
    assert found.level == "fail"
    worst = next(t for t in found.tests if (t.name, t.part) == ("offset", "region"))
    assert "WFC2" in worst.where


# -- pieces ---------------------------------------------------------------------------------------


def test_frames_of_whole_exposures_are_the_true_ones() -> None:
    one = field(8)
    split = split_matches(one.matches, HoldoutSpec(0.0, WHOLE))
    _, predictive = solved(one, split, WHOLE)
    frames = frames_for(predictive, split.held, split.held.exposure_names)
    assert set(frames) == set(WHOLE)
    pulls = []
    for name, frame in frames.items():
        code = one.model.exposures.index(name)
        true = one.theta[one.model.frame_slice(code)]
        sigma = np.sqrt(np.diag(frame.spent))
        assert frame.names == one.model.free_frame_names(code)
        # what belongs to the solution's own error: three sigma more are allowed
        n = predictive.model.n_distortion
        by = frame.spent @ frame.shared
        sigma = np.sqrt(sigma**2 + np.einsum("qn,nm,qm->q", by, predictive.cov[:n, :n], by))
        pulls += [(frame.values - true) / sigma]
    # shift and rotation of the release itself are those of its first exposure
    assert np.abs(np.array(pulls)).max() < 5


def test_influence_of_stars_is_what_the_fit_does_with_their_errors() -> None:
    """Moved stars move the parameters so; and summed up over all they are `star_covariance`."""
    one = field(9, n_exposures=6, n_stars=300)
    joint, _ = solved(one, split_matches(one.matches, HoldoutSpec(0.1, ())), ())
    kept = split_matches(one.matches, HoldoutSpec(0.1, ())).kept
    codes = np.unique(kept.star)
    found = star_influence(joint.fit, kept, one.errors, codes)
    n = joint.model.n_distortion
    variance = one.errors.variances[:, codes]
    total = np.einsum("lasd,lsa,lase->de", found.by, variance, found.by)
    expected = star_covariance(joint.fit, kept, one.errors).total[:n, :n]
    np.testing.assert_allclose(total, expected, rtol=1e-8, atol=1e-12 * np.abs(expected).max())
    assert not found.with_solution(np.array([10**6]), np.array([2004.0])).any()


def test_a_posterior_without_its_scatter_is_refused() -> None:
    one = field(1, n_exposures=6, n_stars=200)
    split = split_matches(one.matches, HoldoutSpec(0.3, ()))
    _, predictive = solved(one, split, ())
    with pytest.raises(InputError, match="how exposures scatter"):
        holdout_validation(replace(predictive, deviations=None), split.held)
