"""Diagnostics and evaluation of a run, read back from its folder."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.app.pipeline import evaluate
from bayesdist.app.results import open_results
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.tables.result_files import load_diagnostics, load_evaluation
from bayesdist.errors import InputError

from .support import summary_of


@pytest.fixture(scope="module")
def results(finished):
    with open_results(RunDirectory.open(finished.path)) as opened:
        yield opened


def test_what_is_read_is_what_would_be_made_again(results):
    kept = load_evaluation(results.run, results.fit, results.posterior)
    made = evaluate(
        results.errors,
        results.posterior,
        results.diagnostics,
        results.data,
        results.config,
        results.base,
    )
    assert kept.budget.rows() == made.budget.rows()
    assert kept.checks == made.checks and kept.verdict == made.verdict
    for a, b in zip(kept.margins, made.margins, strict=True):
        assert (a.requirement, a.verdict, a.reason) == (b.requirement, b.verdict, b.reason)
        np.testing.assert_array_equal(a.draws, b.draws)
    for a, b in zip((*kept.maps, *kept.formal), (*made.maps, *made.formal), strict=True):
        np.testing.assert_array_equal(a.radius, b.radius)


def test_the_verdict_is_the_worst_of_all(results):
    kept = load_evaluation(results.run, results.fit, results.posterior)
    level, reasons = kept.verdict
    assert level == "fail"
    assert any(text.startswith("Too tight: missed") for text in reasons)
    assert replace(kept, margins=(), checks=()).verdict == ("pass", ())


def test_diagnostics_are_those_of_the_summary(results):
    found, summary = results.stored, summary_of(results.run.path)
    assert [one.name for one in found.score_tests] == [r["name"] for r in summary["score_tests"]]
    assert found.misfit.p_value == summary["misfit"]["p_value"]
    assert found.sample.n_total == len(results.data.stars)


def test_they_belong_to_one_posterior(results):
    other = replace(results.posterior, theta=results.posterior.theta + 1e-6)
    assert load_diagnostics(results.run, results.fit, other) is None
    with pytest.raises(InputError, match="other data or settings"):
        load_evaluation(results.run, results.fit, other)
