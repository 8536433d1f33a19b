"""Processor seconds of commands, each a process of its own, as someone types them."""

from __future__ import annotations

import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.benchmarks.timing import say

__all__ = ["FULL", "QUICK", "Sizes", "run"]


@dataclass(frozen=True)
class Sizes:
    """What is run."""

    stars: int
    order: int
    repeats: int


FULL = Sizes(stars=5_000, order=5, repeats=2)
QUICK = Sizes(stars=300, order=2, repeats=1)


def _seconds(*arguments: str, cache: Path) -> tuple[float, float]:
    """Processor seconds and seconds by the clock of a command; RuntimeError where it fails."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # modules are compiled once, as for users
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "bayesdist", *arguments],
        env=environment,
        capture_output=True,
        text=True,
    )
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, 4, 5, 6):  # 4 to 6: a requirement is not met
        raise RuntimeError(f"bayesdist {arguments[0]} failed:\n{done.stderr[-2000:]}")
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return used, wall


def run(sizes: Sizes) -> dict[str, Any]:
    """Medians for `--help`, a run without and with compiled kernels, `report` and `inspect`.

    Parameters
    ----------
    sizes : Sizes

    Returns
    -------
    dict
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        data, cache = folder / "data", folder / "kernels"
        small = ["--band", "W2", "--stars", str(sizes.stars)]
        _seconds("simulate", "wise", "-o", str(data), *small, cache=folder / "others")
        config = data / "config.toml"
        text = config.read_text(encoding="utf-8")
        config.write_text(re.sub(r"(?m)^order = \d+", f"order = {sizes.order}", text), "utf-8")
        made = folder / "run"
        calibrate = ["run", str(config), "-o", str(made), "--force"]
        commands = {
            "--help": ["--help"],
            "run, warm": calibrate,
            "report": ["report", str(made)],
            "inspect of a SIP header": ["inspect", str(made / "sip.hdr")],
        }
        rows = [{"what": "run, first of all", **_row([_seconds(*calibrate, cache=cache)])}]
        for what, arguments in commands.items():
            say(f"commands: {what}")
            times = [_seconds(*arguments, cache=cache) for _ in range(sizes.repeats)]
            rows.append({"what": what, **_row(times)})
    return {"n_stars": sizes.stars, "order": sizes.order, "rows": rows}


def _row(times: list[tuple[float, float]]) -> dict[str, float]:
    used, wall = zip(*times, strict=True)
    return {"cpu_s": statistics.median(used), "seconds": statistics.median(wall)}
