"""The functions of a run in Python: what a run finds and writes, without its folder."""

from __future__ import annotations

import numpy as np

from bayesdist.app.config import load_config
from bayesdist.app.pipeline import (
    diagnose,
    error_model,
    evaluate,
    export,
    fit,
    match,
    read,
    sample,
)
from bayesdist.app.results import open_results
from bayesdist.app.store.rundir import RunDirectory

from .support import snapshot, summary_of


def test_a_script_finds_what_a_run_finds(finished, tmp_path):
    before = snapshot(finished.path.parent)
    config, _ = load_config(finished.config)
    base = finished.config.parent
    data = fit(match(read(config, base), config), config, base)
    posterior = sample(data, config)
    found = diagnose(posterior, data, config, base)
    errors = error_model(posterior, found, data, config)
    evaluation = evaluate(errors, posterior, found, data, config, base)
    products = export(evaluation, posterior, found, data, config, base, tmp_path)
    data.reader.close()
    assert snapshot(finished.path.parent) == before
    with open_results(RunDirectory.open(finished.path)) as results:
        np.testing.assert_array_equal(posterior.theta, results.posterior.theta)
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
