"""Strike runs at random moments, resume them, compare the results and count."""

from __future__ import annotations

import argparse
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

from bayesdist.app.store.store import LOCK, ArtefactStore
from tests.app.support import good
from tests.kills.compare import assert_same, assert_whole
from tests.kills.jobs import JOBS
from tests.kills.strikes import STRIKES, RunProcess, seconds_of, stage_of
from tests.sketches import quick

ATTEMPTS = 4  # per moment: some runs end before they are struck
START = 1.5  # seconds within which a fork reads its input, or a process imports the package


@dataclass
class Outcome:
    """What became of the strikes of one kind at runs of one kind."""

    job: str
    strike: str
    struck: Counter[str] = field(default_factory=Counter)  # by stage, of runs that were under way
    failures: list[str] = field(default_factory=list)

    @property
    def line(self) -> str:
        stages = ", ".join(f"{name or 'between'} {n}" for name, n in self.struck.items())
        n, bad = self.struck.total(), len(self.failures)
        return f"{self.job:9} {self.strike:13} {n:3} struck, {bad} failed  ({stages})"


def outcomes(
    jobs: Sequence[str],
    strikes: Sequence[str],
    folder: Path,
    *,
    moments: int,
    seed: int = 1,
    real: bool = False,
) -> Iterator[Outcome]:
    """Outcomes of strikes at a number of random moments each, spread over the stages."""
    for job in jobs:
        config = JOBS[job](folder / job / "input")
        torn, expected = (folder / job / name / "run" for name in ("torn", "expected"))
        expected.parent.mkdir()
        if real:
            process = RunProcess(config, expected, real=True)
            assert process.wait() == 0, process.errors
        else:  # forks of this process need not load again what it has loaded
            with quick(), _copied_at_each_stage(folder / job):
                good("run", config, "-o", expected, "-q")
        for strike in strikes:
            rng = random.Random(f"{seed} {job} {strike}")
            outcome = Outcome(job, strike)
            stages = ["start", *seconds_of(expected)]
            rng.shuffle(stages)
            for k in range(ATTEMPTS * moments):
                if outcome.struck.total() + len(outcome.failures) >= moments:
                    break
                torn.parent.mkdir()
                stage = stages[k % len(stages)]
                if (begun := folder / job / stage / "run").exists():
                    shutil.copytree(begun, torn)
                try:
                    _strike(config, torn, strike, stage, rng, outcome, expected, real=real)
                except AssertionError as error:
                    outcome.failures.append(f"{job}, {strike}, {stage}: {error}")
                    shutil.move(torn.parent, folder / job / f"failed-{time.time_ns()}")
                shutil.rmtree(torn.parent, ignore_errors=True)
            yield outcome


@contextmanager
def _copied_at_each_stage(folder: Path) -> Iterator[None]:
    """Context in which a run is copied whenever a stage begins, to a folder of that name.

    Runs that are struck begin with such a copy, and need not repeat earlier stages.
    """
    begin = ArtefactStore._begin

    def copying(self: ArtefactStore, record: Any, name: str, *arguments: Any) -> None:
        begin(self, record, name, *arguments)
        without_lock = shutil.ignore_patterns(LOCK)
        shutil.copytree(self.path, folder / name / "run", ignore=without_lock)

    with patch.object(ArtefactStore, "_begin", copying):
        yield


def _strike(
    config: Path,
    torn: Path,
    strike: str,
    stage: str,
    rng: random.Random,
    outcome: Outcome,
    expected: Path,
    *,
    real: bool,
) -> None:
    """Strike a run within a stage, look at what is left, resume the run and compare it.

    Raises AssertionError if something is wrong.
    """
    blow = STRIKES[strike]
    delay = rng.random() * ({"start": START} | seconds_of(expected))[stage]
    process = RunProcess(config, torn, real=real)
    if not real and torn.exists():  # it is in that stage already
        delay += rng.random() * START
    while process.poll() is None and stage_of(torn) != stage:
        time.sleep(0.002)
    time.sleep(delay)
    within = stage_of(torn)
    alive = process.poll() is None
    blow.at(process)
    code = process.wait()
    late = blow.code != 0 == code and "report" in seconds_of(torn)  # all had been done
    if alive and not late:
        outcome.struck[within] += 1
        assert code == blow.code, (code, process.errors)
        said = process.errors.splitlines()
        assert not blow.says or said[-1:] == [blow.says], process.errors
    assert "Traceback" not in process.errors, process.errors
    if real:
        assert "Warning" not in process.errors, process.errors
        assert not process.survivors()
    if torn.exists():
        assert_whole(torn, handled=code >= 0)
    process = RunProcess(config, torn, real=real)
    assert process.wait() == 0, process.errors
    assert "Traceback" not in process.errors, process.errors
    assert_same(expected, torn)


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code: 1 if a run failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--moments", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", nargs="+", default=list(JOBS), choices=JOBS)
    parser.add_argument("--strikes", nargs="+", default=list(STRIKES), choices=STRIKES)
    parser.add_argument("--real", action="store_true", help="new processes, with figures")
    parser.add_argument("--keep", metavar="FOLDER", help="keep runs that failed here")
    given = parser.parse_args(arguments)
    failed = False
    with tempfile.TemporaryDirectory(prefix="bayesdist-kills-") as temporary:
        folder = Path(given.keep or temporary)
        done = outcomes(
            given.jobs,
            given.strikes,
            folder,
            moments=given.moments,
            seed=given.seed,
            real=given.real,
        )
        for outcome in done:
            print(outcome.line, *outcome.failures, sep="\n    ", flush=True)
            failed |= bool(outcome.failures)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
