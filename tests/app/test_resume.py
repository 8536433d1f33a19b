"""A run that is killed again and again ends as if nothing had happened."""

from __future__ import annotations

import random
import shutil
import signal
import subprocess
import sys
import time
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


# without the figures, which would take most of the time and which kills seldom reach
NO_REPORT = """
import sys
from bayesdist.app import cli, run
run.report = lambda results: []
sys.exit(cli.main())
"""


def test_sigkill_changes_nothing(tmp_path, full, capsys):
    """Reduced, kills are seen while it starts, samples, and assesses, but not while it draws."""
    kills, steps, stars = (10, 1500, 3000) if full else (2, 500, 2000)
    assert main(["simulate", "wise", "-o", str(tmp_path), "--stars", str(stars), "-q"]) == 0
    config = tmp_path / "config.toml"
    config.write_text(CONFIG.format(steps=steps))
    whole, torn = tmp_path / "whole", tmp_path / "torn"

    program = ["-m", "bayesdist"] if full else ["-c", NO_REPORT]

    def command(run: Path, *flags: str) -> list[str]:
        return [sys.executable, *program, "run", str(config), "-o", str(run), *flags]

    started = time.monotonic()
    subprocess.run(command(whole), check=True, capture_output=True)
    duration = time.monotonic() - started

    moments = random.Random(17)
    landed, progress = 0, []
    while landed < kills:
        flags = ["--resume"] if (torn / "run.json").exists() else []
        process = subprocess.Popen(
            command(torn, *flags), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        time.sleep(moments.uniform(0.1, 0.4) * duration)
        alive = process.poll() is None
        if alive:
            process.kill()
        _, errors = process.communicate()
        assert process.returncode == (-signal.SIGKILL if alive else 0), errors.decode()
        progress.append(len(list(torn.glob("chain-*.h5"))))
        landed += alive
        if not alive:  # it came to its end in spite of all kills: compare, and begin anew
            _assert_same(whole, torn)
            shutil.rmtree(torn)
    flags = ["--resume"] if (torn / "run.json").exists() else []
    subprocess.run(command(torn, *flags), check=True, capture_output=True)

    with capsys.disabled():
        print(f"\n{landed} kills of a live run; checkpoints after each: {progress}")
    _assert_same(whole, torn)
    # nothing half-written is left behind by the run that ended
    assert not [p.name for p in torn.iterdir() if p.name.startswith(".")]
