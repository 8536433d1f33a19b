"""The functions of a run in Python: what a run finds and writes, without its folder."""

from __future__ import annotations

import numpy as np

from bayesdist.app.pipeline import diagnose, evaluate, export, fit, match, sample
from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory

from .support import in_memory, snapshot, summary_of


def test_a_script_finds_what_a_run_finds(finished, tmp_path):
    before = snapshot(finished.path.parent)
    with in_memory(finished.config) as run:
        run = evaluate(diagnose(sample(fit(match(run)))))
        products = export(run, tmp_path, source=str(finished.path))
        evaluation = run.evaluation
    assert snapshot(finished.path.parent) == before
    with Run.of(RunDirectory.open(finished.path)) as results:
        np.testing.assert_array_equal(run.posterior.theta, results.posterior.theta)
        known = results.evaluation
    assert evaluation.budget.rows() == known.budget.rows()
    assert evaluation.checks == known.checks
    for made, stored in zip(evaluation.margins, known.margins, strict=True):
        assert made.verdict == stored.verdict and made.rests_on == stored.rests_on
        np.testing.assert_array_equal(made.draws, stored.draws)
    for made, stored in zip(evaluation.maps, known.maps, strict=True):
        np.testing.assert_array_equal(made.radius, stored.radius)
    written = summary_of(finished.path)["products"]
    assert [one["path"] for one in products] == [one["path"] for one in written] != []
    for one, other in zip(products, written, strict=True):
        assert one["findings"] == other["findings"]
        name = one["path"]
        assert (tmp_path / name).read_bytes() == (finished.path / name).read_bytes()
