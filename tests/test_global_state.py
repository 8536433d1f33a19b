"""Other programs import bayesdist: that is quick, and changes nothing of theirs."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SECONDS = 0.15  # of the processor, at most, for `import bayesdist`


def _python(*arguments: str, text: str = "") -> str:
    run = subprocess.run(
        [sys.executable, *arguments], input=text, capture_output=True, text=True, cwd=ROOT
    )
    assert run.returncode == 0, run.stderr
    return run.stdout.splitlines()[-1]


def test_importing_and_using_the_package_changes_no_global_state():
    """What its libraries do when they are imported is theirs, and done before."""
    libraries = _python("-m", "tests.global_state", "libraries")
    assert {"numba", "matplotlib", "astropy"} <= set(json.loads(libraries))
    assert json.loads(_python("-m", "tests.global_state", "changes", text=libraries)) == []


def test_a_change_would_be_seen():
    code = (
        "import gc, os, numba; from tests import global_state as g; before = g.snapshot(); "
        "gc.set_threshold(1); os.environ['A'] = 'B'; numba.config.CACHE_DIR = 'C'; "
        "after = g.snapshot(); print(*sorted(k for k in before if before[k] != after[k]), sep=',')"
    )
    assert _python("-c", code) == "environment,garbage collector,numba.config"


def test_the_import_takes_little_time():
    code = "import time; t = time.process_time(); import bayesdist; print(time.process_time() - t)"
    assert min(float(_python("-c", code)) for _ in range(4)) <= SECONDS


def test_messages_go_to_a_logger_without_handlers():
    """The root logger is not touched, and nothing is printed where nobody asks for it."""
    code = (
        "import logging, bayesdist; log = logging.getLogger('bayesdist'); log.warning('unasked'); "
        "print([type(h).__name__ for h in log.handlers], log.level, log.propagate, "
        "logging.root.handlers)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert run.stdout.strip() == "['NullHandler'] 0 True []" and run.stderr == ""
