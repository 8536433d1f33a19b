"""Free directions: how many, what they are called, and what fixes them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.infer.equations.priors import Prior
from bayesdist.kinds.selfcal.infer import pointing_prior, tie
from bayesdist.kinds.selfcal.infer.elimination import Mixture, expand
from bayesdist.kinds.selfcal.infer.gauge import POINTS, find_gauge, functionals, moves
from bayesdist.kinds.selfcal.infer.mode import solve_in_gauge
from tests.kinds.selfcal.infer.fields import field, problem_of

ALWAYS = {*POINTS, "scale", "rotation"}
SKEW = {"skew_plus", "skew_cross"}


def _gauge(simulated, information=None):
    problem, stars = problem_of(simulated)
    found, _ = expand(problem, simulated.theta, Mixture(0.0, 0.01), stars, observed=False)
    information = information or Prior.none(simulated.theta)
    return find_gauge(problem, simulated.theta, found.curvature, information), found


@pytest.mark.parametrize(
    ("rolls", "free"),
    [
        ((0, 60, 130), ALWAYS),
        ((0, 0, 0), ALWAYS | SKEW),
        ((0, 180), ALWAYS | SKEW),  # half a turn brings a skew back onto itself
        ((0, 90), ALWAYS),
    ],
)
@pytest.mark.parametrize("n_chips", [1, 2])
def test_free_directions_by_roll(rolls, free, n_chips):
    gauge, found = _gauge(field(1, 9, 300, rolls=rolls, n_chips=n_chips))
    assert set(gauge.free_names) == free
    assert gauge.null.shape[1] == gauge.held.size == len(free)
    assert not gauge.unnamed
    # held parameters leave nothing free
    rest = np.setdiff1d(np.arange(len(found.gradient)), gauge.held)
    H = found.curvature[np.ix_(rest, rest)]
    scale = np.sqrt(np.diag(H))
    assert np.linalg.eigvalsh(H / np.outer(scale, scale))[0] > 1e-8
    told = " ".join(gauge.sentences)
    assert ("one roll angle" in told) == (free >= SKEW)
    # what is free in any self-calibration is no finding about these data
    findings = [text for text in gauge.sentences if text not in gauge.settled]
    assert len(findings) == (free >= SKEW)


def test_a_decision_of_other_detections_is_made_anew_where_it_fixes_too_little():
    simulated = field(5, 6, 200, rolls=(0, 60))
    problem, stars = problem_of(simulated)
    start = problem, simulated.theta, Prior.none
    usual = solve_in_gauge(*start, stars=stars)
    assert usual.decision.held.size
    fewer = replace(usual.decision, held=usual.decision.held[:-1])
    found = solve_in_gauge(*start, stars=stars, decision=fewer)
    assert np.array_equal(found.decision.held, usual.decision.held)
    assert found.theta == pytest.approx(usual.theta, abs=1e-9)


def test_moves_of_the_sky_change_no_residual():
    simulated = field(2, 9, 300)
    _, found = _gauge(simulated)
    known = moves(simulated.model, simulated.theta)
    for name in ALWAYS:
        row = known[name]
        power = row @ found.curvature @ row
        assert power < 1e-9 * (row**2 @ np.diag(found.curvature))
    for name in SKEW:  # the rolls tell
        row = known[name]
        assert row @ found.curvature @ row > 1e-4 * (row**2 @ np.diag(found.curvature))


def test_without_dithers_the_distortion_itself_is_free():
    from tests.kinds.selfcal.dithered_fields import simulate_dithers, smooth_distortion
    from tests.kinds.selfcal.infer.fields import chips

    rng = np.random.default_rng(3)
    simulated = simulate_dithers(
        chips(), smooth_distortion(3, chips(), 3.0, rng), np.zeros((5, 2)), np.zeros(5),
        n_stars=200, rng=rng, sigma=0.02,
    )  # fmt: skip
    gauge, _ = _gauge(simulated)
    assert gauge.null.shape[1] == 20  # all coefficients of both axes
    assert any(name[2:] not in ("0_0", "1_0", "0_1") for name in gauge.unnamed)
    assert "dither more" in " ".join(gauge.sentences)


def test_scale_from_commanded_offsets():
    """Offsets of known error fix the scale as a regression through their mean does."""
    simulated = field(4, 10, 300, sigma=0.001)
    model, theta = simulated.model, simulated.theta
    x, y = (np.full(10, c) for c in model.chips[0].reference_pixel)
    true = model.predict(theta, x, y, exposure=np.arange(10))
    sigma = 0.3
    information = pointing_prior(model, theta, true, np.full(10, sigma))
    gauge, _ = _gauge(simulated, information)
    scale = next(d for d in gauge.directions if d.name == "scale")
    rotation = next(d for d in gauge.directions if d.name == "rotation")
    assert scale.free
    lever = np.sqrt(((true - true.mean(axis=0)) ** 2).sum())
    for one in (scale, rotation):
        assert one.sigma_fixed == pytest.approx(sigma / lever, rel=1e-3)
    assert {model.names[k] for k in gauge.held} == {"u_0_0", "v_0_0"}
    assert "the constraints that are given determine it" in " ".join(gauge.sentences)


def test_a_tie_of_the_scale():
    simulated = field(5, 9, 300)
    row = functionals(simulated.model, simulated.theta)["scale"]
    gauge, _ = _gauge(simulated, tie(simulated.theta, row, 0.0, 3e-5))
    scale = next(d for d in gauge.directions if d.name == "scale")
    assert scale.sigma_fixed == pytest.approx(3e-5, rel=1e-6)
    assert gauge.open.shape[1] == 3


@pytest.mark.parametrize("tied", [False, True])
def test_nothing_that_is_not_given_is_said_to_fix(tied):
    """Rolls within half a degree, and nothing given: what is nearly free is so by detections.

    A skew that is tied as well as the edge of the detector is wide is fixed by that.
    """
    simulated = field(6, 9, 300, rolls=(0, 0.25, 0.5))
    row = functionals(simulated.model, simulated.theta)["skew_plus"]
    gauge, _ = _gauge(simulated, tie(simulated.theta, row, 0.0, 1e-7) if tied else None)
    weak = {d.name: d for d in gauge.directions if d.weak and not d.free}
    assert set(weak) >= SKEW
    said = [text for text in gauge.sentences if text.startswith("skew_plus: nearly free")]
    assert len(said) == 1
    assert said[0].endswith("nothing that is given fixes it better") != tied
    assert ("the constraints that are given determine it" in said[0]) == tied
    assert weak["skew_plus"].by_detections != tied and weak["skew_cross"].by_detections
