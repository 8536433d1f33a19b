"""A function in a process of its own: its peak memory is its own, and it can be stopped."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from typing import Any

from tests.benchmarks.machine import ROOT

__all__ = ["call"]


def call(module: str, function: str, seconds: float, **arguments: Any) -> dict[str, Any] | None:
    """What a function of this folder returns, or None when the time limit stops it.

    Parameters
    ----------
    module : str
        Name in this folder.
    function : str
    seconds : float
    **arguments
        Numbers and strings.

    Returns
    -------
    dict or None

    Raises
    ------
    RuntimeError
        With the end of its error output, when it fails.
    """
    command = [sys.executable, "-m", "tests.benchmarks.child", module, function]
    try:
        run = subprocess.run(
            [*command, json.dumps(arguments)],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=seconds,
        )
    except subprocess.TimeoutExpired:
        return None
    if run.returncode:
        raise RuntimeError(f"{module}.{function} failed:\n{run.stderr[-2000:]}")
    out: dict[str, Any] = json.loads(run.stdout.splitlines()[-1])
    return out


if __name__ == "__main__":
    name, function, arguments = sys.argv[1:]
    home = importlib.import_module(f"tests.benchmarks.{name}")
    print(json.dumps(getattr(home, function)(**json.loads(arguments))))
