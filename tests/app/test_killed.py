"""A run that is killed again and again ends as if nothing had happened."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from multiprocessing import get_context
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import xarray as xr

from bayesdist.app.cli import main
from tests.app.selfcal.support import list_table, small, write_selfcal
from tests.app.support import edit, good
from tests.reduced import case_in_full

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:.*fork")]

CONFIG = """
[data]
matches = "stars.ecsv"

[detector]
size = [1016, 1016]

[model]
order = 4

[sampler]
seed = 3
target_ess = 1e9                # never reached: the run ends at max_steps
max_steps = {steps}
checkpoint_every = 25

[assess]
grid = [5, 5]
draws = 100

[products]
sip = {{}}
"""


def _draws(run: Path) -> dict[str, np.ndarray]:
    with xr.open_dataset(run / "posterior.nc", group="posterior", engine="h5netcdf") as data:
        return {name: data[name].values for name in data.data_vars}


def _assert_same(one: Path, other: Path) -> None:
    """Draws, and the files that follow from them, are the same to the last bit."""
    expected, got = _draws(one), _draws(other)
    assert expected.keys() == got.keys()
    for name, values in expected.items():
        assert values.tobytes() == got[name].tobytes(), name
    for name in TABLES:
        assert (one / name).read_bytes() == (other / name).read_bytes(), name
    for path in one.glob("*.hdr"):
        assert path.read_bytes() == (other / path.name).read_bytes(), path.name


class Forked:
    """A command in a fork of this process, without what takes longest.

    Imports, kernels that are loaded, and figures would be most of the time, and kills would find
    nothing else.
    """

    def __init__(self, arguments: list[str]) -> None:
        self._process = get_context("fork").Process(target=_exiting, args=(arguments,))
        self._process.start()

    def poll(self) -> int | None:
        """Exit code, or None while it runs; minus the signal that ended it."""
        return self._process.exitcode

    def kill(self) -> None:
        self._process.kill()

    def wait(self) -> int | None:
        self._process.join()
        return self._process.exitcode


def _in_short(arguments: list[str]) -> int:
    """Exit code of the command, without figures."""
    with patch("bayesdist.app.stages.report", lambda results, pdf: []):
        return main(arguments)


def _exiting(arguments: list[str]) -> None:
    """The end of the process with that exit code."""
    sys.exit(_in_short(arguments))


def _in_full(arguments: list[str]) -> subprocess.Popen[bytes]:
    """The command as it is."""
    return subprocess.Popen([sys.executable, "-m", "bayesdist", *arguments])


def _of_matches(folder: Path, full: bool) -> Path:
    """A run of matched stars whose sampler goes on to its last step."""
    steps, stars = (1500, 3000) if full else (100, 1000)
    good("simulate", "wise", "-o", folder, "--stars", stars, "-q")
    config = folder / "config.toml"
    config.write_text(CONFIG.format(steps=steps))
    return config


def _of_campaign(folder: Path, full: bool) -> Path:
    """Star lists of a few exposures, tables, and a drift.

    Series of linear terms take a third of the run, and begin at eight exposures.  Reduced, nothing
    is released and no requirement is followed through time: that takes another third, in stages
    that are not killed then.
    """
    exposures, stars = (8, 3000) if full else (6, 2000)
    options = ("--exposures", exposures, "--stars", stars, "--seed", 3, "-q")
    good("simulate", "acs", "-o", folder, *options)
    config = edit(
        folder / "campaign_f606w.toml",
        {
            'method = "field"': 'step = [512.0, 512.0]\nmethod = "field"',
            "[assess]": "[sampler]\nensembles = 2\ntarget_ess = 50\ntarget_rhat = 1.2\n\n[assess]",
            "grid = [33, 17]": f"grid = [5, 3]\ndraws = 100\nyears_ahead = {10 if full else 0}",
            "order = 5": f"order = {5 if full else 3}",
        },
    )
    if not full:
        text = config.read_text(encoding="utf-8")
        config.write_text(text.partition("[products.release]")[0], encoding="utf-8")
    return config


def _of_selfcal(folder: Path, full: bool) -> Path:
    """Dithered exposures without a catalogue."""
    given = {"sampler": {"target_ess": 100}, "assess": {"grid": (5, 5), "draws": 100}}
    return write_selfcal(folder, list_table(small()), products={"sip": {}}, **given)


JOBS = {"matches": _of_matches, "campaign": _of_campaign, "selfcal": _of_selfcal}
TABLES = ("coefficients.ecsv", "budget.ecsv", "margins.ecsv")


def _under_way(run: Path) -> str:
    """Stage that a run is in; empty between stages, and before the first one."""
    try:
        record = json.loads((run / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return ""
    return (record["under_way"] or {}).get("stage", "")


def _seconds(run: Path) -> dict[str, float]:
    """How long the stages took that have ended."""
    try:
        stages = json.loads((run / "run.json").read_text(encoding="utf-8"))["stages"]
    except (OSError, ValueError):
        return {}
    return {name: one["wall_s"] for name, one in stages.items()}


@pytest.mark.parametrize(
    "kind",
    [
        "matches",
        case_in_full("campaign", instead="stages of matched stars are killed"),
        case_in_full("selfcal", instead="stages of matched stars are killed"),
    ],
)
def test_sigkill_changes_nothing(kind, tmp_path, full, capsys):
    """Killed within each stage, by turns, at a random moment of it.

    Reduced, in the stages that write draws, tables and files; figures are drawn in full alone.
    """
    kills = int(os.environ.get("BAYESDIST_KILLS", 50 if full else 3))
    config = JOBS[kind](tmp_path / "input", full)
    whole, torn = tmp_path / "whole", tmp_path / "torn"
    begun = _in_full if full else Forked

    def command(run: Path) -> list[str]:
        flags = ["--resume"] if (run / "run.json").exists() else []
        return ["run", str(config), "-o", str(run), "-q", *flags]

    if full:
        assert begun(["--version"]).wait() == 0  # what is made once is no part of the duration
        assert begun(command(whole)).wait() == 0
    else:  # here: forks need not load anew what it has loaded
        assert _in_short(command(whole)) == 0
    seconds = _seconds(whole)

    moments, aimed, landed = random.Random(17), Counter(), Counter()
    while landed.total() < kills:
        wanted = min(seconds, key=lambda name: aimed[name])
        if wanted in _seconds(torn):  # has ended in spite of all kills: compare, and begin anew
            assert begun(command(torn)).wait() == 0
            _assert_same(whole, torn)
            shutil.rmtree(torn)
        aimed[wanted] += 1
        delay = moments.uniform(0.0, 0.7) * seconds[wanted]
        process = begun(command(torn))
        while process.poll() is None and _under_way(torn) != wanted:
            time.sleep(0.002)
        time.sleep(delay)
        within, alive = _under_way(torn), process.poll() is None
        if alive:
            process.kill()
        assert process.wait() == (-signal.SIGKILL if alive else 0)
        landed[within] += alive
    assert begun(command(torn)).wait() == 0

    with capsys.disabled():
        print(f"\n{kind}: {landed.total()} kills of a live run, in {dict(landed)}")
    _assert_same(whole, torn)
    # nothing half-written is left behind by the run that ended
    assert not [p.name for p in torn.rglob("*") if p.name.startswith(".")]
