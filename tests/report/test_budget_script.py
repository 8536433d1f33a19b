"""The script of the page computes the budget from the numbers of the page: run by Node alone."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import bayesdist.report
from bayesdist.assess.budget import budget_of, place_budget
from bayesdist.assess.budget_surface import budget_surface
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.model import error_model
from bayesdist.report.sections.explorer import budget_data
from tests.budgets import Curvature

from .runs import report_run

NODE = shutil.which("node")
SCRIPT = Path(bayesdist.report.__file__).parent / "templates" / "budget.js"
GRID, EPOCHS = (9, 7), (2009.5, 2010.3, 2012.0, 2016.4, 2020.5)
A, B = (100.0, 200.0), (3000.5, 1500.0)
ASK = """
const fs = require("fs");
const [script, file] = process.argv.slice(1);
const data = JSON.parse(fs.readFileSync(file)), { epochs, a, b } = data.asked;
const budget = eval(fs.readFileSync(script, "utf8") + "; new Budget(data)");
console.log(JSON.stringify(epochs.map(t => {
  budget.at(t);
  return [[], [a], [a, b]].map(places => budget.terms(0, places, null));
})));
"""


@pytest.mark.skipif(NODE is None, reason="there is no Node")
def test_three_errors_at_five_epochs_are_those_of_the_budget(tmp_path):
    """Over a chip, at a position, of a difference: where the drift of the run is curved."""
    run = report_run(size=(4096.0, 2048.0), names=("WFC2", "WFC1"))
    terms = (Curvature(run.solution, 1e-4),)
    errors = error_model(run.solution, terms=terms).drawn(400, np.random.default_rng(9))
    surface = budget_surface(errors, GRID, epoch=2010.3, years=(EPOCHS[0], EPOCHS[-1]))
    data = budget_data(run.having(surface=surface))
    data |= {"asked": {"epochs": EPOCHS, "a": A, "b": B}}
    (tmp_path / "data.json").write_text(json.dumps(data))
    command = [str(NODE), "-e", ASK, str(SCRIPT), str(tmp_path / "data.json")]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    (x, y), pixels = A, tuple(zip(A, B, strict=True))
    model = run.solution.model
    for epoch, (rms, one, two) in zip(EPOCHS, json.loads(told), strict=True):
        chip = [c for c in model.chips if c.number == 1]
        domain = EvaluationDomain.of_chips(replace(model, chips=tuple(chip)), GRID, epoch=epoch)
        over = budget_of(errors, replace(domain, model=model)).rows()
        truth = {row["name"]: (row["u"], row["v"]) for row in over}
        _same(rms, truth)
        at = place_budget(errors, x, y, chip=1, epoch=epoch)
        _same(one, {t.name: (t.u[0], t.v[0]) for t in at.every})
        between = place_budget(errors, *pixels, chip=1, epoch=epoch, relative=True)
        _same(two, {t.name: (t.u[0], t.v[0]) for t in between.every})


def _same(told, truth):
    found = {row["name"]: row["variance"] for row in told}
    largest = max(max(values) for values in truth.values())
    for name, values in truth.items():
        if name not in found:
            assert max(values) == 0
            continue
        assert min(found[name]) >= 0
        np.testing.assert_allclose(
            np.sqrt(found[name]), values, rtol=1e-4, atol=1e-4 * largest, err_msg=name
        )
