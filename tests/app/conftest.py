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
def sketched(full) -> Iterator[None]:
    """Figures of reports are neither made nor drawn, unless run in full."""
    with nullcontext() if full else sketches.sketched(made=False):
        yield


@pytest.fixture(scope="package", autouse=True)
def few_likelihoods(full) -> Iterator[None]:
    """Posteriors leave out what those of large runs do: the likelihood of each star at each draw.

    Unless run in full; it takes a fifth of a small run, and tests/infer/test_files looks at it.
    """
    with pytest.MonkeyPatch.context() as patch:
        if not full:
            patch.setattr("bayesdist.infer.files.LARGEST", 0)
        yield


@pytest.fixture(scope="package", autouse=True)
def coarse_structure(full) -> Iterator[None]:
    """The structure that a fit leaves out is integrated over a coarse grid of its sizes.

    Unless run in full; it takes a tenth of a small run, and tests/diagnose looks at it.
    """
    with pytest.MonkeyPatch.context() as patch:
        if not full:
            structure = "bayesdist.diagnose.correlated.structure"
            patch.setattr(f"{structure}.LENGTHS", np.geomspace(0.02, 0.6, 3))
            patch.setattr(f"{structure}.HALVINGS", 2)
        yield


@pytest.fixture(scope="module")
def figures_made(sketched, full) -> Iterator[None]:
    """Figures of reports are made and have their words; they are drawn if run in full."""
    with nullcontext() if full else sketches.sketched():
        yield


@pytest.fixture(scope="package")
def finished(sketched, few_likelihoods, coarse_structure, tmp_path_factory) -> Finished:
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
    monkeypatch.setattr("bayesdist.app.run.report", lambda results, pdf: [])
