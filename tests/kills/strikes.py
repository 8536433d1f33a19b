"""Processes of `bayesdist run`, and what is done to them."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from bayesdist.app.cli import program
from bayesdist.app.store.made_from import STAGES
from tests.sketches import quick

POLL = 0.002  # seconds between two looks at a run
LONGEST = 600.0  # seconds until a process is given up
GONE = 10.0  # seconds within which the processes that a run has started must have ended


@dataclass(frozen=True)
class Strike:
    """Signals to a process, one after another, and how it must end.

    Parameters
    ----------
    signals : sequence of Signals
    pause : float
        Seconds between two of them.
    code : int
        Exit code, or minus the signal that ends the process; 0 if it continues.
    says : str
        Last line on stderr.
    group : bool
        True if the processes that it has started receive the signals, too, as from a terminal.
    """

    signals: Sequence[signal.Signals]
    code: int
    says: str = ""
    pause: float = 0.0
    group: bool = False

    def at(self, process: RunProcess) -> None:
        """Send the signals."""
        for k, number in enumerate(self.signals):
            if k:
                time.sleep(self.pause)
            process.send(number, group=self.group)


_INTERRUPTED = "bayesdist: interrupted; resume with --resume"
STRIKES: Mapping[str, Strike] = {
    "SIGKILL": Strike([signal.SIGKILL], -signal.SIGKILL),
    "SIGSTOP": Strike([signal.SIGSTOP, signal.SIGCONT], 0, pause=0.3),
    "SIGTERM": Strike([signal.SIGTERM], 143, "bayesdist: terminated; resume with --resume"),
    "SIGINT": Strike([signal.SIGINT], 130, _INTERRUPTED, group=True),
    "SIGINT twice": Strike([signal.SIGINT] * 2, 130, _INTERRUPTED, pause=0.1, group=True),
}


class RunProcess:
    """`bayesdist run` of a configuration in a session of its own, or its resumption.

    Parameters
    ----------
    config, run : Path
        Configuration and folder of the run.
    real : bool
        True for a new process with figures; False for a fork of this process without figures.
        Imports, kernels and figures take most of the time of a small run.
    """

    def __init__(self, config: Path, run: Path, *, real: bool = False) -> None:
        flags = ["--resume"] if (run / "run.json").exists() else []
        arguments = ["run", str(config), "-o", str(run), "-q", *flags]
        self._stderr = run.with_suffix(".stderr")
        self._code: int | None = None
        with self._stderr.open("wb") as stderr:
            self.pid = os.fork()
            if not self.pid:
                _child(arguments, stderr.fileno(), real=real)

    def poll(self) -> int | None:
        """Exit code, minus the signal that ended the process, or None while it runs."""
        if self._code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self._code = os.waitstatus_to_exitcode(status)
        return self._code

    def wait(self) -> int:
        """Exit code at the end."""
        begun = time.monotonic()
        while (code := self.poll()) is None:
            if time.monotonic() - begun > LONGEST:
                self.send(signal.SIGKILL, group=True)
                raise AssertionError(f"does not end: {self.errors}")
            time.sleep(POLL)
        return code

    def send(self, number: signal.Signals, *, group: bool) -> None:
        """Send a signal, unless the process has ended."""
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                (os.killpg if group else os.kill)(self.pid, number)

    def survivors(self) -> list[str]:
        """Command lines of processes that the run has started and that outlive it."""
        begun = time.monotonic()
        while (lines := _session(self.pid)) and time.monotonic() - begun < GONE:
            time.sleep(0.05)
        return lines

    @property
    def errors(self) -> str:
        return self._stderr.read_text(encoding="utf-8")


def _child(arguments: list[str], stderr: int, *, real: bool) -> NoReturn:
    """Run a command in a session of its own; the process ends with its exit code."""
    code = 99
    try:
        os.setsid()
        os.dup2(os.open(os.devnull, os.O_RDWR), 1)
        os.dup2(stderr, 2)
        # shells tell jobs in the background to ignore it
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if real:
            os.execv(sys.executable, [sys.executable, "-m", "bayesdist", *arguments])
        sys.argv = ["bayesdist", *arguments]
        with quick():
            code = program()
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def _session(leader: int) -> list[str]:
    """Command lines of the processes of a session."""
    lines = []
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            state, _, _, session = (path / "stat").read_text().rpartition(")")[2].split()[:4]
            if int(session) == leader and state != "Z":
                lines.append((path / "cmdline").read_text().replace("\0", " "))
    return lines


def stage_of(run: Path) -> str:
    """Stage that a run is in; 'start' before the first one, otherwise '' between two stages."""
    record = _record(run)
    return (record["under_way"] or {}).get("stage", "") if record else "start"


def seconds_of(run: Path) -> dict[str, float]:
    """Duration in seconds of each stage that has ended, in the order of the stages."""
    stages = _record(run).get("stages", {})
    return {name: stages[name]["wall_s"] for name in STAGES if name in stages}


def _record(run: Path) -> dict:
    """Content of run.json; empty if there is none yet."""
    try:
        return json.loads((run / "run.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
