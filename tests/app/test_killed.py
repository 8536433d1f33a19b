"""A run that is killed again and again ends as if nothing had happened."""

from __future__ import annotations

import random
import shutil
import signal
import subprocess
import sys
import time
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from bayesdist.app.cli import main

pytestmark = pytest.mark.slow

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
"""


def _draws(run: Path) -> dict[str, np.ndarray]:
    with xr.open_dataset(run / "posterior.nc", group="posterior", engine="h5netcdf") as data:
        return {name: data[name].values for name in data.data_vars}


def _assert_same(one: Path, other: Path) -> None:
    expected, got = _draws(one), _draws(other)
    assert expected.keys() == got.keys()
    for name, values in expected.items():
        assert np.array_equal(values, got[name]), name


class Forked:
    """A command in a process whose modules are imported already, and without the figures.

    Both would take most of the time, and kills would find nothing else.
    """

    context = get_context("forkserver")
    context.set_forkserver_preload(["tests.app.test_killed", "bayesdist.app.run"])

    def __init__(self, arguments: list[str]) -> None:
        self._process = self.context.Process(target=_without_figures, args=(arguments,))
        self._process.start()

    def poll(self) -> int | None:
        """Exit code, or None while it runs; minus the signal that ended it."""
        return self._process.exitcode

    def kill(self) -> None:
        self._process.kill()

    def wait(self) -> int | None:
        self._process.join()
        return self._process.exitcode


def _without_figures(arguments: list[str]) -> None:
    from bayesdist.app import run

    run.report = lambda results, pdf: []
    sys.exit(main(arguments))


def _in_full(arguments: list[str]) -> subprocess.Popen[bytes]:
    """The command as it is."""
    return subprocess.Popen([sys.executable, "-m", "bayesdist", *arguments])


def test_sigkill_changes_nothing(tmp_path, full, capsys):
    """Reduced, kills are seen while it samples and assesses, but not while it draws."""
    kills, steps, stars = (10, 1500, 3000) if full else (2, 300, 1000)
    assert main(["simulate", "wise", "-o", str(tmp_path), "--stars", str(stars), "-q"]) == 0
    config = tmp_path / "config.toml"
    config.write_text(CONFIG.format(steps=steps))
    whole, torn = tmp_path / "whole", tmp_path / "torn"
    begun = _in_full if full else Forked

    def command(run: Path) -> list[str]:
        flags = ["--resume"] if (run / "run.json").exists() else []
        return ["run", str(config), "-o", str(run), "-q", *flags]

    assert begun(["--version"]).wait() == 0  # what is made once is no part of the duration
    started = time.monotonic()
    assert begun(command(whole)).wait() == 0
    duration = time.monotonic() - started

    moments = random.Random(17)
    landed, progress = 0, []
    while landed < kills:
        process = begun(command(torn))
        time.sleep(moments.uniform(0.1, 0.4) * duration)
        alive = process.poll() is None
        if alive:
            process.kill()
        assert process.wait() == (-signal.SIGKILL if alive else 0)
        progress.append(len(list(torn.glob("chain-*.h5"))))
        landed += alive
        if not alive:  # it came to its end in spite of all kills: compare, and begin anew
            _assert_same(whole, torn)
            shutil.rmtree(torn)
    assert begun(command(torn)).wait() == 0

    with capsys.disabled():
        print(f"\n{landed} kills of a live run; checkpoints after each: {progress}")
    _assert_same(whole, torn)
    # nothing half-written is left behind by the run that ended
    assert not [p.name for p in torn.iterdir() if p.name.startswith(".")]
