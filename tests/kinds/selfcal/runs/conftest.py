"""Finished self-calibrations of one simulated field each, which tests read and never change."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests import sketches
from tests.app.conftest import no_report, quick_runs
from tests.app.support import Result, good
from tests.kinds.selfcal.dithered_fields import DitheredField
from tests.kinds.selfcal.runs.support import list_table, small, write_selfcal

__all__ = ["no_report", "quick_runs"]  # fixtures of runs, for the files of this folder

PRODUCTS = {"sip": {}, "idctab": {"instrument": "ACS", "detector": "SBC"}}
ROLLS = {"three rolls": (0, 60, 130), "one roll": (0, 0, 0)}


@dataclass(frozen=True)
class Finished:
    """A run, and what it was made from."""

    path: Path
    config: Path
    truth: DitheredField
    result: Result


def _finished(folder: Path, rolls: tuple[float, ...], *, report: bool) -> Finished:
    truth = small(rolls=rolls)
    config = write_selfcal(folder / "input", list_table(truth), products=PRODUCTS)
    with pytest.MonkeyPatch.context() as patch:
        if not report:
            patch.setattr("bayesdist.app.stages.report", lambda run, pdf: [])
        result = good("run", config, "-o", folder / "run")
    return Finished(folder / "run", config, truth, result)


@pytest.fixture(scope="package")
def three_rolls(quick_runs, full, tmp_path_factory) -> Finished:
    """With its report and the words of its figures."""
    with nullcontext() if full else sketches.sketched():
        return _finished(tmp_path_factory.mktemp("three"), ROLLS["three rolls"], report=True)


@pytest.fixture(scope="package")
def one_roll(tmp_path_factory) -> Finished:
    """Without."""
    return _finished(tmp_path_factory.mktemp("one"), ROLLS["one roll"], report=False)
