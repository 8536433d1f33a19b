"""Several commands, one after another, in one process of their own: it starts once.

Runs are quick, unless in full.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from subprocess import CompletedProcess

from tests import sketches
from tests.app.support import Result, cli
from tests.reduced import FULL


def encoded(commands: Iterable[Sequence[object]]) -> list[str]:
    """Arguments of `python -m tests.app.several` for these commands."""
    return [json.dumps([str(word) for word in command]) for command in commands]


def results_of(done: CompletedProcess[str]) -> list[Result]:
    """What each of the commands did."""
    assert done.returncode == 0, done.stderr
    return [Result(**result) for result in json.loads(done.stdout)]


if __name__ == "__main__":
    with nullcontext() if FULL else sketches.quick():
        print(json.dumps([vars(cli(*json.loads(command))) for command in sys.argv[1:]]))
