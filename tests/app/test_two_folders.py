"""A run does not depend on the folder that it is in, and does not say where that is."""

from __future__ import annotations

import re
import shutil

import pytest
from astropy.table import Table

from tests.app.support import good
from tests.kills.compare import assert_same
from tests.kills.jobs import JOBS
from tests.reduced import case_in_full
from tests.sketches import quick


def _without_an_exposure_time(folder) -> None:
    """Remove one, of which a warning names the file."""
    path = folder / "exposures.ecsv"
    exposures = Table.read(path)
    exposures["exptime"][1] = float("nan")
    exposures.write(path, overwrite=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    "job", ["matches", "campaign", case_in_full("selfcal", instead="two other kinds")]
)
def test_run_in_two_folders(job, tmp_path):
    first, second = tmp_path / "one", tmp_path / "another" / "and_longer"
    config = JOBS[job](first).relative_to(first)
    if job == "campaign":
        _without_an_exposure_time(first)
    shutil.copytree(first, second)
    for folder in (first, second):
        with quick():
            good("run", folder / config, "-o", folder / "run", "-q")
    assert_same(first / "run", second / "run")
    for path in (first / "run").rglob("*"):
        if path.is_file() and not re.fullmatch(r"bayesdist\.log|run\.json", path.name):
            assert str(tmp_path).encode() not in path.read_bytes(), path
    if job == "campaign":
        summary = (first / "run" / "summary.json").read_text(encoding="utf-8")
        assert "exptime is missing of 1 of 6 exposures in exposures.ecsv" in summary
