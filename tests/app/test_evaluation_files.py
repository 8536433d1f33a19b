"""Diagnostics and evaluation of a run, read back from its folder."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.app.config.section import RunDetector
from bayesdist.app.pipeline import evaluate
from bayesdist.app.result_files import load_diagnostics, load_evaluation
from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.errors import InputError
from bayesdist.kinds.matches.config import MatchesConfig

from .support import summary_of


@pytest.fixture(scope="module")
def run(finished):
    with Run.of(RunDirectory.open(finished.path)) as opened:
        yield opened


def test_what_is_read_is_what_would_be_made_again(run):
    kept = load_evaluation(run.directory, run.fit, run.posterior)
    made = evaluate(run).evaluation
    assert kept.budget.rows() == made.budget.rows()
    assert kept.checks == made.checks and kept.verdict == made.verdict
    for a, b in zip(kept.margins, made.margins, strict=True):
        assert (a.requirement, a.verdict, a.reason) == (b.requirement, b.verdict, b.reason)
        np.testing.assert_array_equal(a.draws, b.draws)
    for a, b in zip((*kept.maps, *kept.formal), (*made.maps, *made.formal), strict=True):
        np.testing.assert_array_equal(a.radius, b.radius)


def test_the_verdict_is_the_worst_of_all(run):
    kept = load_evaluation(run.directory, run.fit, run.posterior)
    level, reasons = kept.verdict
    assert level == "fail"
    assert any(text.startswith("Too tight: missed") for text in reasons)
    assert replace(kept, margins=(), checks=()).verdict == ("pass", ())


def test_diagnostics_are_those_of_the_summary(run):
    found, summary = run.stored_diagnostics, summary_of(run.directory.path)
    assert [one.name for one in found.score_tests] == [r["name"] for r in summary["score_tests"]]
    assert found.misfit.p_value == summary["misfit"]["p_value"]
    assert found.sample.n_total == len(run.matches)


def test_they_belong_to_one_posterior(run):
    other = replace(run.posterior, theta=run.posterior.theta + 1e-6)
    assert load_diagnostics(run.directory, run.fit, other) is None
    with pytest.raises(InputError, match="other data or settings"):
        load_evaluation(run.directory, run.fit, other)


@pytest.mark.parametrize(
    "field",
    [
        {"centre": (480.0, 410.0), "radius": 310.0},
        [(200.0, 100.0), (800.0, 100.0), (800.0, 700.0), (200.0, 700.0)],
    ],
)
def test_maps_budget_and_requirements_are_of_the_field_of_the_detector(run, field):
    """The same errors as over the whole detector, at the positions that see the sky alone."""
    detector = RunDetector(**run.config.detector.model_dump() | {"field": field})
    config = run.config.model_copy(update={"detector": detector})
    whole = load_evaluation(run.directory, run.fit, run.posterior)
    made = evaluate(run.with_config(config)).evaluation
    found, every = made.maps[0], whole.maps[0]
    X, Y = np.meshgrid(every.x, every.y)
    inside = (X > 200) & (X < 800) & (Y > 100) & (Y < 700)
    if isinstance(field, dict):
        inside = np.hypot(X - 480, Y - 410) <= 310
    assert 0 < inside.sum() < inside.size
    np.testing.assert_array_equal(found.radius, np.where(inside, every.radius, np.nan))
    assert found.radius_max == every.radius[inside].max() < every.radius_max
    x, y = found.position_of_max
    assert inside[every.y.tolist().index(y), every.x.tolist().index(x)]
    [row] = [r for r in made.budget.rows() if r["name"] == "coefficients"]
    [term] = [t for t in whole.budget.terms if t.name == "coefficients"]
    on_grid = whole.budget.on_grid(term.u)
    assert row["u"] == pytest.approx(np.sqrt(np.mean(on_grid[inside] ** 2)), rel=1e-12)
    again = made.budget.on_grid(made.budget.terms[0].u)
    np.testing.assert_allclose(again, np.where(inside, on_grid, np.nan), rtol=1e-12)
    for margin, before in zip(made.margins, whole.margins, strict=True):
        assert margin.requirement.region == config.field
        assert margin.value <= before.value


def test_a_field_is_of_a_detector_of_one_chip():
    chips = [
        {"number": n, "name": f"C{n}", "size": (9, 9), "reference_pixel": (5, 5)} for n in (1, 2)
    ]
    settings = {"data": {"matches": "a.csv"}, "model": {"order": 1}, "chip": chips}
    with pytest.raises(
        ValueError, match=r"detector\.field applies to a detector with a single chip"
    ):
        MatchesConfig(**settings, detector={"field": {"centre": (5, 5), "radius": 3}})


@pytest.mark.parametrize(
    "field",
    [{"centre": (1500, 400), "radius": 300}, [(1200, 1), (1300, 1), (1300, 90)]],
)
def test_a_field_off_the_detector_is_refused_by_its_name(field):
    settings = {"data": {"matches": "a.csv"}, "model": {"order": 1}, "assess": {"grid": (9, 9)}}
    with pytest.raises(ValueError, match=r"detector\.field holds 0 points of the grid of 9 x 9"):
        MatchesConfig(**settings, detector={"size": (1000, 800), "field": field})
