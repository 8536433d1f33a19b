"""One finished run, which the tests read and copy but never change."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from bayesdist.simulate import Truth
from tests import sketches
from tests.app.support import Result, as_table, cli, simulated, write_job

REQUIREMENTS = [
    {"name": "loose", "statistic": "p95", "limit": 1.0, "unit": "pix", "probability": 0.95},
    {"name": "in mas", "statistic": "rms", "limit": 50.0, "unit": "mas", "probability": 0.9},
    {"name": "too tight", "statistic": "max", "limit": 1e-4, "probability": 0.5},
]
BUDGET = [
    {"name": "catalogue", "kind": "systematic", "sigma_u": 0.003, "sigma_v": 0.004},
    {"name": "centroid", "kind": "random", "sigma_u": 0.1, "sigma_v": 0.2, "unit": "mas"},
]


@dataclass(frozen=True)
class Finished:
    """A run, and what it was made from."""

    path: Path
    config: Path
    truth: Truth
    result: Result


@pytest.fixture(scope="package", autouse=True)
def quick_runs(full) -> Iterator[None]:
    """Runs leave out what takes long and is not looked at here, unless in full."""
    with nullcontext() if full else sketches.quick():
        yield


@pytest.fixture(scope="module")
def figures_made(quick_runs, full) -> Iterator[None]:
    """Figures of reports are made and have their words; they are drawn if run in full."""
    with nullcontext() if full else sketches.sketched():
        yield


@pytest.fixture(scope="package")
def finished(quick_runs, tmp_path_factory) -> Finished:
    folder = tmp_path_factory.mktemp("finished")
    matches, truth = simulated(mag=np.linspace(12.0, 18.0, 400))
    config = write_job(
        folder / "input",
        as_table(matches),
        detector={"name": "A", "size": (1000, 800), "scale_mas": 50.0},
        requirement=REQUIREMENTS,
        budget=BUDGET,
        products={"sip": {"inverse_order": 4}},
    )
    result = cli("run", config, "-o", folder / "run")
    assert result.code == 0, result.err
    return Finished(folder / "run", config, truth, result)


@pytest.fixture
def no_report(monkeypatch):
    """Runs without the figures, which take seconds and are not the subject here."""
    monkeypatch.setattr("bayesdist.app.stages.report", lambda run, pdf: [])
