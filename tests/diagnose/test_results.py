"""Verdicts, sentences, and which tests there are."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from bayesdist.diagnose import score_tests
from bayesdist.diagnose.checks import score_checks
from bayesdist.diagnose.score.questions import order_family
from bayesdist.diagnose.score.result import Family, Outcome, corrected, noncentrality
from bayesdist.diagnose.score.sample import SAMPLE, scored_sample
from bayesdist.errors import InputError
from bayesdist.infer.solution.transforms import without_frames

from ..infer.patterned import moved
from .support import TIME, Scene, by_name, polynomial

pytestmark = pytest.mark.usefixtures("one_thread")


def outcome(p: float, name: str = "a test") -> Outcome:
    family = Family(name, "x", "something", "none")
    return Outcome(family, 1.0, 2, None, p, 0.5, lambda level: level, "pix")


def test_holm_steps_down_and_stops_at_the_first_that_fails():
    p = [2e-4, 0.9, 4.9e-4, 3e-4, 1e-9]
    # sorted: 1e-9 <= 2e-4, 2e-4 <= 2.5e-4, 3e-4 <= 3.3e-4, 4.9e-4 <= 5e-4, 0.9 > 1e-3
    assert [t.significant for t in corrected([outcome(x) for x in p])] == [
        True, False, True, True, True
    ]  # fmt: skip
    p[3] = 3.4e-4  # fails, and all that are larger with it
    assert [t.significant for t in corrected([outcome(x) for x in p])] == [
        True, False, False, False, True
    ]  # fmt: skip
    # what alone is found has to pass the first step
    assert {t.smallest for t in corrected([outcome(x) for x in p])} == {1e-3 / 5}
    assert corrected([]) == ()


def test_sentences_say_what_was_found_or_could_have_been():
    found, absent = corrected([outcome(0.0), outcome(0.3)])
    assert found.finding == "something (0.5 pix rms, p < 1e-300)"
    assert absent.finding == "none (0.0005 pix rms would have been found)"


@pytest.mark.parametrize("dof_residual", [None, 7.5, 40.0, 3e4, 1e7])
@pytest.mark.parametrize("dof", [1, 6, 28.7])
def test_noncentrality_has_the_power(dof, dof_residual):
    level, size = 1e-4, 200_000
    shift = noncentrality(level, dof, dof_residual)
    rng = np.random.default_rng(1)
    T = rng.noncentral_chisquare(dof, shift, size)
    if dof_residual is None:
        found = stats.chi2.sf(T, dof) < level
    else:
        T = T / dof / (rng.chisquare(dof_residual, size) / dof_residual)
        found = stats.f.sf(T, dof, dof_residual) < level
    assert found.mean() == pytest.approx(0.9, abs=0.005)


def test_every_question_has_a_row_where_the_data_can_be_asked():
    one = Scene(1500, 2)
    always = {"order 3", "order 4", "magnitude", "colour", "truncation", "edges"}
    always |= {"pixel phase"}
    always |= {"repeating pattern"}
    always |= {"noise by position", "noise by magnitude", "noise by axis"}
    always |= {"skewness by position", "skewness of a patch", "correlation by position"}
    always |= {"shape by position", "displaced stars", "displaced group of stars"}
    always |= {"two cores", "jumps", "rings"}
    assert set(one.tests(1)) == always
    of_fields = {"second order of exposures", "fields of exposures"}
    several = {"exposures", "noise by exposure"} | of_fields
    assert set(Scene(1500, 2, "shift", 5).tests(1)) == always | several | {
        "drift",
        "magnitude in time",
    }
    timed = {"drift", "curvature in time", "magnitude in time"}
    dates = Scene(1500, 2, "shift", 10, time=TIME).tests(1)
    assert set(dates) == always | several | timed | {"exposures in time"}
    assert set(Scene(1500, 2, "shift", 5, time=TIME).tests(1)) == always | several | timed
    # frames that fit all linear terms leave no deviations, and no drift
    assert set(Scene(1500, 2, "affine", 5).tests(1)) == always | of_fields | {
        "noise by exposure",
        "magnitude in time",
    }
    model, table = one.data(1)
    fit = one.solve(model, table)
    bare = table.with_columns(mag=None, colour=np.ones(len(table)))
    assert set(by_name(score_tests(bare, fit))) == always - {
        "magnitude", "colour", "noise by magnitude"
    }  # fmt: skip


def test_too_few_stars_are_not_asked():
    assert "order 4" not in Scene(14, 2).tests(1)
    assert set(Scene(9, 1).tests(3)) <= {"order 2", "magnitude", "colour"}


def test_remedies_name_what_to_do():
    found = Scene(600, 11, n_exposures=3).with_pattern(1, polynomial(12, 0.05, 1))
    assert found["order 12"].significant and found["order 12"].remedy == "raise model.order to 12"
    assert found["order 13"].remedy == "fit a look-up table in a campaign"
    assert "terms of order 12" in found["order 12"].finding
    assert "hierarchy of deviations" in found["exposures"].remedy
    assert found["order 12"].unit == "pix"


def test_every_test_says_which_correlated_errors_hold_it():
    found = Scene(1500, 2, "shift", 5, time=TIME).tests(1)
    held = {name: one.held_by for name, one in found.items() if one.held_by}
    assert held == {
        "order 3": "structure", "order 4": "structure", "exposures": "exposures",
        "second order of exposures": "second order", "fields of exposures": "exposure fields",
        "curvature in time": "curvature", "noise by position": "noise",
        "noise by magnitude": "noise", "noise by exposure": "noise", "noise by axis": "noise",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("linear", "structure", "fields", "held"),
    [
        (None, (), {}, {"noise"}),
        (None, ("a field",), {}, {"noise", "structure"}),
        ({"scatter": {"shape": 0}}, (), {}, {"noise", "exposures"}),
        # half of what was found, 0.5 pixels, has to be in the budget
        ({"scatter": {"curvature": 0}, "bend": 0.26}, (), {}, {"noise", "curvature"}),
        ({"scatter": {"curvature": 0}, "bend": 0.24}, (), {}, {"noise"}),
        ({"scatter": {}, "correlation_time": 2.0}, (), {}, {"noise", "curvature", "time"}),
        (None, (), {"second_order": 0.26, "field": 0.24}, {"noise", "second order"}),
        (None, (), {"second_order": 0.24, "field": 0.26}, {"noise", "exposure fields"}),
    ],
)
def test_verdicts_stand_where_correlated_errors_hold_a_finding(linear, structure, fields, held):
    if linear is not None:
        linear = SimpleNamespace(**{"bend": 0.0, "correlation_time": 0.0} | linear)
    correlated = SimpleNamespace(
        linear=linear, structure=structure, facts={"exposure_fields": fields}
    )
    kinds = ("", "noise", "structure", "exposures", "curvature", "time")
    for kind in (*kinds, "second order", "exposure fields"):
        one = outcome(0.0)
        tests = corrected([replace(one, family=replace(one.family, held_by=kind))])
        [alone], [beside] = score_checks(tests), score_checks(tests, correlated)
        assert alone.doubt
        assert bool(beside.doubt) == (kind not in held)


def test_a_curvature_does_not_hold_deviations_that_wander():
    linear = SimpleNamespace(scatter={"curvature": 0}, bend=0.5, correlation_time=0.0)
    correlated = SimpleNamespace(linear=linear, structure=(), facts={})
    families = [Family(kind, kind, "", "", held_by=kind) for kind in ("curvature", "time")]
    tests = corrected([replace(outcome(0.0), family=family) for family in families])
    assert all(row.doubt for row in score_checks(tests, correlated))


def test_tests_that_find_nothing_are_one_row():
    rows = list(score_checks(corrected([outcome(0.5), outcome(0.7)])))
    assert [row.level for row in rows] == ["pass"] and not rows[0].doubt
    [found] = score_checks(corrected([outcome(0.5), outcome(0.0)]))
    assert found.level == "warn" and found.doubt


def test_findings_name_another_one_that_may_explain_them():
    first = replace(outcome(0.0), family=Family("a", "", "a", "", group="g", denial="it is not a"))
    second = replace(outcome(0.0), family=Family("b", "", "b", "", explained_by="g"))
    assert [one.finding.split(" (")[0] for one in corrected([second, first])] == [
        "b, if it is not a",
        "a",
    ]
    absent = replace(first, p_value=0.5)
    assert corrected([second, absent])[0].finding.startswith("b (")


def test_orders_that_are_missing_have_one_remedy():
    """Whoever raises the order to the highest that is missing has the others, too."""
    orders = [replace(outcome(0.0), family=order_family(total, 4)) for total in (5, 6)]
    [both] = score_checks(corrected(orders))
    assert both.sentence.endswith(": raise model.order to 6")
    assert "order 5" in both.sentence and "to 5" not in both.sentence
    [one] = score_checks(corrected([orders[0], replace(orders[1], p_value=0.5)]))
    assert one.sentence.endswith(": raise model.order to 5") and "order 6" not in one.sentence


def test_drift_of_exposures_that_deviate_is_doubtful():
    scene = Scene(1200, 1, "shift_rotation", 6)
    rng = np.random.default_rng(3)
    scale = 1e-4 * rng.standard_normal(6)

    def breathing(table):
        return scale[table.exposure][:, None] * np.stack([table.x - 500, table.y - 400], 1)

    found = scene.with_pattern(2, breathing)
    assert found["exposures"].significant and found["drift"].significant
    assert found["drift"].finding.startswith("linear terms drift with time")
    assert "if deviating exposures do not explain it" in found["drift"].finding


def test_large_tables_are_sampled_and_say_what_the_sample_sees():
    scene = Scene(4000, 2)
    table, fit = scene.fitted(1)
    assert SAMPLE == 200_000
    whole = by_name(score_tests(table, fit))
    part = by_name(score_tests(table, fit, sample_size=1000))
    assert len(scored_sample(table, fit, size=1000)) == 1000
    ratio = part["order 3"].smallest / whole["order 3"].smallest
    assert ratio == pytest.approx(2.0, rel=0.1)
    assert min(one.p_value for one in part.values()) > 1e-3


def test_a_transformed_solution_has_no_likelihood():
    table, fit = Scene(200, 1, "shift", 2).fitted(1)
    with pytest.raises(InputError, match="has no likelihood"):
        score_tests(table, without_frames(fit))


def test_rows_may_stand_in_any_order():
    scene = Scene(900, 2, "shift_rotation", 4)
    model, table = scene.data(3)
    table = moved(table, polynomial(3, 0.003, 1)(table))
    fit = scene.solve(model, table)
    mixed = table.select(np.random.default_rng(1).permutation(len(table)))
    other = by_name(score_tests(mixed, fit))
    for name, one in by_name(score_tests(table, fit)).items():
        assert other[name].statistic == pytest.approx(one.statistic, rel=1e-8), name


def test_magnitudes_that_stand_for_none_are_no_lever():
    """A code of 99 among magnitudes neither hides a dependence nor makes one."""
    scene = Scene(1500, 2)
    model, table = scene.data(4)
    table = moved(table, 0.005 * (table.mag - 14)[:, None] * [[0.0, 1.0]])
    mag = table.mag.copy()
    mag[::300] = 99.0
    fit = scene.solve(model, table)
    found = by_name(score_tests(table.with_columns(mag=mag), fit))
    assert found["magnitude"].p_value < 1e-20
