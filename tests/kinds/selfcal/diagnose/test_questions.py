"""Self-calibrations are asked the questions to matched stars."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.diagnose.score import questions as regressors
from bayesdist.diagnose.score.questions import LINEAR, Products, Question
from bayesdist.diagnose.score.result import Family
from bayesdist.infer.equations.priors import Prior
from bayesdist.kinds.selfcal.diagnose.tests import selfcal_score_tests
from bayesdist.kinds.selfcal.infer.mode import SelfCalibrationMode, gauge_of, solve
from bayesdist.kinds.selfcal.infer.problem import prepare
from tests.diagnose.score.shaped import SHAPE
from tests.diagnose.support import by_name
from tests.kinds.selfcal.infer.fields import field

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def solution() -> SelfCalibrationMode:
    return solution_of(field(20, 8, 500, n_chips=2, order=2))


def solution_of(simulated) -> SelfCalibrationMode:
    theta = simulated.theta
    problem = prepare(simulated.model, simulated.detections, theta, match_radius=1.0)
    prior = Prior.none(theta)
    held = gauge_of(problem, theta, prior).held
    free = np.setdiff1d(np.arange(problem.model.n_params), held)
    return solve(problem, theta, free, prior)


def known(solution) -> dict[str, np.ndarray]:
    rng, p = np.random.default_rng(1), solution.problem
    names = ("mag", "colour")
    of_stars = {name: rng.normal(15, 1, p.n_stars)[p.star] for name in names}
    return of_stars | {"epoch": 2000.0 + p.groups.exposure[p.groups.index]}


def test_every_question_has_a_row_where_the_data_can_be_asked(solution):
    found = by_name(selfcal_score_tests(solution, **known(solution)))
    always = {"order 3", "order 4", "pointing", "exposures", "noise by position"}
    always |= {"noise by exposure", "noise by axis", "second order of exposures", *SHAPE}
    # bins of magnitude need more stars
    assert set(found) - {"noise by magnitude"} == always | {"magnitude", "motions"}
    assert set(by_name(selfcal_score_tests(solution))) == always
    # the model of a self-calibration has no magnitude terms
    assert found["magnitude"].remedy.startswith("cut the faint stars")


def test_displaced_detections_and_exposures_of_second_order_are_told_apart():
    """Both resemble a curved sky and noise that depends on position; other remedies help."""
    simulated, rng = field(21, 12, 1000), np.random.default_rng(2)
    d = simulated.detections
    X, Y = d.x / 512 - 1, d.y / 512 - 1
    tailed = (rng.uniform(size=len(X)) < 0.3 * (1 + X)) * rng.exponential(0.1, len(X))
    bent = 0.05 * (-1.0) ** d.exposure * X * Y
    found = {}
    for name, dx in (("tail", tailed), ("bent", bent)):
        moved = replace(simulated, detections=replace(d, x=d.x + dx))
        found[name] = by_name(selfcal_score_tests(solution_of(moved)))
    tail, bent = found["tail"], found["bent"]
    assert tail["skewness by position"].significant
    assert "cut the detections" in tail["skewness by position"].remedy
    assert not tail["second order of exposures"].significant
    assert bent["second order of exposures"].p_value < 1e-9
    assert not any(bent[test].significant for test in SHAPE)
    for test in bent.values():
        assert not test.significant or "scale_mas" not in test.remedy, test.name


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_two_directions_are_both_axes(solution, monkeypatch, angle):
    """Functions along two directions at right angles are those that move both axes freely."""
    c, s = np.cos(angle), np.sin(angle)

    def asked(sample):
        values = sample.mag - sample.mag.mean()
        for name, directions in (("free", [None]), ("turned", [(c, s), (-s, c)])):
            products = [Products(LINEAR, values, d and np.array(d)) for d in directions]
            yield Question(Family(name, "", "", ""), tuple(products))
        yield Question(Family("one", "", "", ""), (Products(LINEAR, values, np.array([c, s])),))

    monkeypatch.setattr(regressors, "questions", asked)
    found = by_name(selfcal_score_tests(solution, **known(solution)))
    free, turned, one = (found[name] for name in ("free", "turned", "one"))
    assert free.dof == turned.dof == 2 * one.dof == 12
    assert turned.statistic == pytest.approx(free.statistic, rel=1e-6)
    assert turned.size == pytest.approx(free.size, rel=1e-6, abs=1e-9)
    assert one.statistic < free.statistic
