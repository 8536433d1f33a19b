"""Whatever happens to a run, it ends in the bytes of a fresh one."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bayesdist.app.store import Adjustable, ArtefactStore, Record, Stage
from bayesdist.files import atomic as files
from bayesdist.files.atomic import atomic_path
from tests.reduced import FULL

STAGES = ("first", "second", "third")


class Killed(BaseException):
    """What no code catches."""


def _write(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text)


class Job:
    """Three stages in a folder, the second one with checkpoints."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.store = ArtefactStore(
            folder,
            {
                "first": Stage(),
                "second": Stage(checkpoints=("chain-*.txt",)),
                "third": Stage(),
            },
        )
        if not (folder / "run.json").exists():
            Record({}).write(folder / "run.json")

    def save(self, name: str, value: list[int]) -> None:
        """Write one file for each entry of even index, and a section of the summary."""
        (self.folder / "parts").mkdir(exist_ok=True)
        for k in value[::2]:
            _write(self.folder / "parts" / f"{name}-{k}.txt", str(k))
        _write(self.folder / f"{name}.json", json.dumps(value))
        self.store.summarise(**{name: {"sum": sum(value)}, "last": name})

    def load(self, name: str) -> list[int]:
        return json.loads((self.folder / f"{name}.json").read_text())

    def run(self, wanted: Mapping[str, int], force: str = "") -> None:
        """All stages, as the settings have them now."""
        store = self.store
        store.restore_summary()

        def chain() -> None:
            found = [wanted["start"] + sum(self.load("first"))]
            for k in range(wanted["steps"]):
                path = self.folder / f"chain-{k}.txt"
                if not path.exists():
                    _write(path, str(7 * found[-1] % 1013))
                found.append(int(path.read_text()))
            self.save("second", found)

        def joined() -> None:
            self.save("third", [*self.load("first"), *self.load("second")[:: wanted["grid"]]])

        first = store.stage(
            "first",
            lambda: self.save("first", list(range(wanted["length"]))),
            {"length": wanted["length"]},
            force=force == "first",
        )
        second = store.stage(
            "second",
            chain,
            first,
            {"start": wanted["start"]},
            Adjustable({"steps": wanted["steps"]}),
            force=force == "second",
        )
        store.stage(
            "third",
            joined,
            first,
            second,
            {"grid": wanted["grid"]},
            force=force == "third",
        )

    def content(self) -> dict[str, bytes]:
        """Bytes of all files but run.json, which has times."""
        found = (p for p in sorted(self.folder.rglob("*")) if p.is_file() and p.name != "run.json")
        return {str(p.relative_to(self.folder)): p.read_bytes() for p in found}


SETTINGS = {"length": (1, 4), "start": (0, 2), "steps": (1, 4), "grid": (1, 3)}

change = st.sampled_from(sorted(SETTINGS)).flatmap(
    lambda key: st.tuples(st.just("set"), st.just(key), st.integers(*SETTINGS[key]))
)
action = st.one_of(
    change,
    st.tuples(st.sampled_from(["delete", "alter", "shorten"]), st.integers(0, 30)),
    st.tuples(st.just("kill"), st.integers(0, 25), st.booleans()),
    st.tuples(st.just("force"), st.sampled_from(STAGES)),
    st.tuples(st.just("run")),
)


def _kill(job: Job, wanted: Mapping[str, int], moment: int, after: bool) -> None:
    """Run until the rename of a number, and die before it or after."""
    replace, count = os.replace, 0

    def counted(source: Any, target: Any) -> None:
        nonlocal count
        count += 1
        if count > moment and not after:
            raise Killed
        replace(source, target)
        if count > moment:
            raise Killed

    files.os.replace = counted
    try:
        job.run(wanted)
    except Killed:
        pass
    finally:
        files.os.replace = replace


def _harm(job: Job, how: str, number: int) -> None:
    """Delete or change one of the files that a stage which has ended left, or the summary."""
    known = {name for one in job.store.record.artefacts.values() for name in one.files}
    there = sorted(name for name in {*known, "summary.json"} if (job.folder / name).exists())
    if not there:
        return
    path = job.folder / there[number % len(there)]
    content = path.read_bytes()
    if how == "delete":
        path.unlink()
    else:
        path.write_bytes(b"9" + content[1:] if how == "alter" else content[:-1])


@settings(max_examples=40 if FULL else 12, suppress_health_check=list(HealthCheck))
@given(st.lists(action, max_size=12))
def test_it_ends_as_a_fresh_run(actions):
    wanted = {key: low for key, (low, _) in SETTINGS.items()}
    with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as other:
        job = Job(Path(one))
        for what, *how in actions:
            if what == "set":
                wanted[how[0]] = how[1]
            elif what == "kill":
                _kill(job, wanted, *how)
            elif what == "force":
                job.run(wanted, force=how[0])
            elif what == "run":
                job.run(wanted)
            else:
                _harm(job, what, how[0])
        job.run(wanted)
        fresh = Job(Path(other))
        fresh.run(wanted)
        left = fresh.content()
        # checkpoints beyond the limit may be there: a limit was lowered
        assert {k: v for k, v in job.content().items() if k in left} == left
        assert all(k.startswith("chain-") for k in job.content().keys() - left.keys())
        # and nothing is made again
        before = (job.folder / "run.json").read_bytes()
        job.run(wanted)
        assert (job.folder / "run.json").read_bytes() == before
        job.store.clear()
        assert not list(job.folder.rglob("*"))
