"""Diagnostics and evaluation of a run, read back from its folder."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from bayesdist.app.diagnostics_files import load_diagnostics
from bayesdist.app.evaluation_files import load_evaluation
from bayesdist.app.judging import evaluated
from bayesdist.app.rundir import RunDirectory
from bayesdist.app.sessions import session_of
from bayesdist.errors import InputError

from .support import summary_of


@pytest.fixture(scope="module")
def session(finished):
    with closing(session_of(RunDirectory.open(finished.path))) as session:
        yield session


def test_what_is_read_is_what_would_be_made_again(session):
    kept = load_evaluation(session.run, session.fit, session.posterior)
    made = evaluated(session, session.config.requirements())
    assert kept.budget.rows() == made.budget.rows()
    assert kept.checks == made.checks and kept.verdict == made.verdict
    for a, b in zip(kept.margins, made.margins, strict=True):
        assert (a.requirement, a.verdict, a.reason) == (b.requirement, b.verdict, b.reason)
        np.testing.assert_array_equal(a.draws, b.draws)
    for a, b in zip((*kept.maps, *kept.formal), (*made.maps, *made.formal), strict=True):
        np.testing.assert_array_equal(a.radius, b.radius)


def test_the_verdict_is_the_worst_of_all(session):
    kept = load_evaluation(session.run, session.fit, session.posterior)
    level, reasons = kept.verdict
    assert level == "fail"
    assert any(text.startswith("Too tight: missed") for text in reasons)
    assert replace(kept, margins=(), checks=()).verdict == ("pass", ())


def test_diagnostics_are_those_of_the_summary(session):
    found, summary = session.stored, summary_of(session.run.path)
    assert [one.name for one in found.score_tests] == [r["name"] for r in summary["score_tests"]]
    assert found.misfit.p_value == summary["misfit"]["p_value"]
    assert found.sample.n_total == len(session.matches)


def test_they_belong_to_one_posterior(session):
    other = replace(session.posterior, theta=session.posterior.theta + 1e-6)
    assert load_diagnostics(session.run, session.fit, other) is None
    with pytest.raises(InputError, match="other data or settings"):
        load_evaluation(session.run, session.fit, other)
