"""A run that is killed, stopped or interrupted ends as if nothing had happened."""

from __future__ import annotations

import re
import subprocess
import sys

import h5py
import numpy as np
import pytest

from tests.kills.compare import assert_same, assert_whole
from tests.kills.jobs import JOBS
from tests.kills.strikes import STRIKES

ALL = ["--moments", "20"]
FEW = ["--moments", "1", "--jobs", "matches", "--strikes", "SIGKILL", "SIGTERM", "SIGINT twice"]


@pytest.mark.slow
@pytest.mark.timeout(0)
@pytest.mark.parametrize("how", ["forks", "real"])
def test_runs_that_are_struck_end_with_the_same_results(full, capsys, how):
    """Reduced, a few strikes at matched stars, without figures."""
    if how == "real" and not full:
        pytest.skip("forks are struck: set BAYESDIST_FULL=1")
    given = [*(ALL if full else FEW), *(["--real", "--moments", "5"] if how == "real" else [])]
    ended = subprocess.run(
        [sys.executable, "-m", "tests.kills", *given], capture_output=True, text=True, check=False
    )
    with capsys.disabled():
        print(f"\n{ended.stdout}")
    assert ended.returncode == 0, ended.stdout + ended.stderr
    n_lines = len(JOBS) * len(STRIKES) if full else 3
    assert len(re.findall(r"[1-9]\d* struck, 0 failed", ended.stdout)) == n_lines


def _run_folder(folder, values=(1.0, 2.0), wall_s=1.0):
    folder.mkdir()
    (folder / "summary.json").write_text(f'{{"rms": 0.5, "wall_s": {wall_s}}}', encoding="utf-8")
    with h5py.File(folder / "posterior.nc", "w") as file:
        file["posterior/theta"] = np.array(values)
        file["sample_stats/wall_s"] = wall_s
    return folder


def test_comparison_ignores_durations_and_sees_the_last_bit(tmp_path):
    expected = _run_folder(tmp_path / "a")
    assert_same(expected, _run_folder(tmp_path / "b", wall_s=7.0))
    with pytest.raises(AssertionError, match=r"posterior\.nc"):
        assert_same(expected, _run_folder(tmp_path / "c", (1.0, np.nextafter(2.0, 3.0))))


def test_files_that_are_half_written_are_seen(tmp_path):
    run = _run_folder(tmp_path / "a")
    assert_whole(run, handled=True)
    (run / ".bayesdist-0a1b2c3d-fit.nc").touch()
    assert_whole(run, handled=False)
    with pytest.raises(AssertionError):
        assert_whole(run, handled=True)
    raw = (run / "posterior.nc").read_bytes()
    (run / "posterior.nc").write_bytes(raw[: len(raw) // 2])
    with pytest.raises(OSError, match="truncated"):
        assert_whole(run, handled=False)
