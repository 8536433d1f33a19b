"""Artefacts in a folder: loaded where what they were made from stands, and else made."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from fnmatch import fnmatch
from pathlib import Path
from time import monotonic
from typing import Any, Generic, TypeVar

from bayesdist.app.store.keys import Adjustable, as_json, difference, digest_of
from bayesdist.app.store.lock import locked
from bayesdist.app.store.record import (
    SCHEMA,
    Artefact,
    FileMark,
    Record,
    json_text,
    write_text,
)
from bayesdist.files.atomic import is_leftover, path_within, remove_leftovers, watched_writes
from bayesdist.files.regular import read_bytes

T = TypeVar("T")

RECORD, SUMMARY = "run.json", "summary.json"

log = logging.getLogger("bayesdist")


@dataclass(frozen=True)
class Stage:
    """Revision and checkpoints of a stage."""

    revision: int = 1  # raised when the numbers of the stage change
    # patterns of the files by which it goes on where it was interrupted
    checkpoints: tuple[str, ...] = ()


@dataclass(frozen=True)
class Made(Generic[T]):
    """An artefact that stands."""

    name: str  # of its stage
    digest: str  # hash of what was written: what is made from the artefact has it in its key
    # what the stage has given; None where it was not run now, as the artefact stood before
    value: T | None = None


class ArtefactStore:
    """Artefacts in a folder, each by the content that it was made from.

    An artefact stands while its key, a hash of what it was made from, and its files are as they
    were.  What a stage writes is noted in run.json before it takes its name, so that all of it is
    known at whatever moment a process is killed.

    `head`: what summary.json says of the run as a whole, from the facts of run.json.
    """

    def __init__(
        self,
        path: Path,
        stages: Mapping[str, Stage],
        head: Callable[[Mapping[str, Any]], Mapping[str, Any]] = lambda facts: {},
    ) -> None:
        self.path, self.stages, self.head = path, stages, head
        self._planned: Record | None = None
        self._read: tuple[tuple[int, ...], Record] | None = None  # while run.json stays as it is
        self._known: dict[str, tuple[tuple[int, ...], FileMark]] = {}  # by name, of files as read
        # of the stage that is being made here
        self._making = ""
        self._sections: dict[str, Any] = {}
        self._written: set[str] = set()

    # -- what is there ----------------------------------------------------------------------------

    @property
    def record(self) -> Record:
        """Content of run.json, or of what it will be."""
        if self._planned is not None:
            return self._planned
        path = self.path / RECORD
        now = _times(path)
        if self._read is None or not now or self._read[0] != now:
            record = Record.read(path)
            for name in record.file_names:
                path_within(self.path, name, where=str(path))
            self._read = now, record
        return self._read[1].copied()

    @property
    def summary(self) -> dict[str, Any]:
        """Sections of summary.json: of the stages that have ended, and of the one under way.

        A stage that is made anew sees those of the stages before it and its own.  Sections of a
        function that is called by itself, outside of a stage, are here and in no file.
        """
        return self._merged(self.record, before=self._making) | self._sections

    def _merged(self, record: Record, before: str = "") -> dict[str, Any]:
        """Sections of the artefacts, later stages in place of earlier ones."""
        out: dict[str, Any] = {}
        for name in self.stages:
            if name == before:  # never, where that is empty
                break
            if name in record.artefacts:
                out |= record.artefacts[name].sections
        return out

    def standing(self, name: str, *made_from: object) -> Made[Any] | None:
        """The artefact of a stage, where its key and the sizes of its files are as they were."""
        artefact = self.record.artefacts.get(name)
        if artefact is None or artefact.key != digest_of(self._parts(name, made_from)):
            return None
        if self.harmed(artefact, thorough=False):
            return None
        return Made(name, artefact.digest)

    def _parts(self, name: str, made_from: tuple[object, ...]) -> dict[str, Any]:
        """Ingredients of an artefact, as run.json has them."""
        made = {one.name: one.digest for one in made_from if isinstance(one, Made)}
        parts: dict[str, Any] = {"revision": self.stages[name].revision, "from": made}
        for one in made_from:
            if not isinstance(one, Made):
                parts |= as_json(one.value if isinstance(one, Adjustable) else one)
        return parts

    def harmed(self, artefact: Artefact, *, thorough: bool) -> str:
        """The first file of an artefact that is not as its stage left it, '' where all are."""
        for name, mark in artefact.files.items():
            path = self.path / name
            if not path.is_file() or path.stat().st_size != mark.size:
                return name
            if thorough and self._mark(name) != mark:
                return name
        return ""

    def _mark(self, name: str) -> FileMark:
        """Mark of a file, which is read once while its times stay as they are."""
        now = _times(self.path / name)
        if self._known.get(name, (None, None))[0] != now:
            self._known[name] = now, FileMark.of(self.path / name)
        return self._known[name][1]

    def locked(self) -> AbstractContextManager[None]:
        """Keep other processes from writing into the folder; the lock dies with the process."""
        return locked(self.path)

    # -- making -----------------------------------------------------------------------------------

    def stage(
        self, name: str, function: Callable[[], T], *made_from: object, force: bool = False
    ) -> Made[T]:
        """The artefact of a stage, which is made unless it stands; with `force` also where it does.

        `function` writes files into the folder, and sections by `summarise`; `made_from` are
        `Made`, and mappings that can be plain JSON.
        """
        parts, record = self._parts(name, made_from), self.record
        key, known = digest_of(parts), record.artefacts.get(name)
        harmed = "" if known is None else self.harmed(known, thorough=True)
        if known is not None and known.key == key and not harmed and not force:
            log.info("%s: done before", name)
            return Made(name, known.digest)
        log.info("%s: begins%s", name, _reason(known, parts, harmed))
        fixed = tuple(one for one in made_from if not isinstance(one, Adjustable))
        self._begin(record, name, digest_of(self._parts(name, fixed)), harmed)
        started = monotonic()
        with self._noted(name):
            value = function()
        artefact = self._end(name, key, parts, monotonic() - started)
        return Made(name, artefact.digest, value)

    def summarise(self, **sections: Any) -> None:
        """Replace sections of summary.json, for the stage that is under way."""
        self._sections |= as_json(sections)

    @contextmanager
    def amended(self, name: str, *made_from: object) -> Iterator[dict[str, Any]]:
        """Note what a command writes as part of a stage; yields facts of the record, to be changed.

        `made_from` is what the artefact is made from afterwards; nothing where it does not stand.
        """
        record, self._sections = self.record, {}
        known = record.artefacts.get(name)
        written: set[str] = set()

        def note(paths: Sequence[Path]) -> None:
            written.update(self._own(paths))

        with watched_writes(note):
            yield record.facts
        parts = self._parts(name, made_from) if known and made_from else {}
        known = known or Artefact(key="", parts={}, files={}, sections={})
        files = {one: FileMark.of(self.path / one) for one in written if self._is_there(one)}
        files = {one: mark for one, mark in known.files.items() if self._is_there(one)} | files
        sections = {**known.sections, **self._sections}
        key = digest_of(parts) if parts else ""
        record.artefacts[name] = Artefact(key=key, parts=parts, files=files, sections=sections)
        self._sections = {}
        self._write(record)

    def _begin(self, record: Record, name: str, checkpoints: str, harmed: str) -> None:
        """Note that a stage begins, and remove what it wrote before: it must not see that."""
        patterns = self.stages[name].checkpoints
        before = record.under_way or {"stage": name, "files": []}
        known = record.artefacts.pop(name, None)
        record.stages.pop(name, None)
        remove_leftovers(self.path)
        files = set(known.files) if known else set()
        if before["stage"] == name:
            files |= set(before["files"])
        else:
            self._remove(before["files"], record)  # of another stage that did not end
        record.under_way = {"stage": name, "files": sorted(files)}
        if patterns:
            if record.checkpoints.get(name) != checkpoints or _is_one_of(harmed, patterns):
                if record.checkpoints.pop(name, None) is not None:
                    self._write(record)  # first: what is half removed never counts
                self._remove(self._checkpoints(name), record)
            record.checkpoints[name] = checkpoints
        self._sections, self._written = {}, set()
        self._write(record)  # first: what is half removed never counts
        self._remove({one for one in files if not _is_one_of(one, patterns)}, record)

    def _end(self, name: str, key: str, parts: dict[str, Any], seconds: float) -> Artefact:
        """Note that a stage has ended."""
        record = self.record
        written = {one for one in self._written if self._is_there(one)}
        written |= set(self._checkpoints(name))
        marks = {one: FileMark.of(self.path / one) for one in sorted(written)}
        artefact = Artefact(key=key, parts=parts, files=marks, sections=self._sections)
        self._drop_sections(record, name, artefact)
        record.artefacts[name], record.under_way, self._sections = artefact, None, {}
        ended = datetime.now(UTC).isoformat(timespec="seconds")
        record.stages[name] = {"wall_s": seconds, "ended": ended}
        record.artefacts = self._in_order(record.artefacts)
        record.stages = self._in_order(record.stages)
        self._write(record)
        return artefact

    def _drop_sections(self, record: Record, name: str, artefact: Artefact) -> None:
        """Drop sections of a stage from later ones that added to them, made from something else."""
        stale: set[str] = set()
        for later in list(self.stages)[list(self.stages).index(name) + 1 :]:
            known = record.artefacts.get(later)
            made_from = {} if known is None else known.parts.get("from", {})
            if known is not None and (
                made_from.get(name, artefact.digest) != artefact.digest or stale & made_from.keys()
            ):
                stale.add(later)
                kept = {k: v for k, v in known.sections.items() if k not in artefact.sections}
                record.artefacts[later] = known.model_copy(update={"sections": kept})

    def _in_order(self, found: dict[str, Any]) -> dict[str, Any]:
        """Entries of stages that are there, in the order of these."""
        return {one: found[one] for one in self.stages if one in found}

    def _is_there(self, name: str) -> bool:
        """Boolean: a file of the folder exists."""
        return (self.path / name).is_file()

    @contextmanager
    def _noted(self, stage: str) -> Iterator[None]:
        """Note in run.json whatever is written, before it takes its name."""

        def note(paths: Sequence[Path]) -> None:
            names = self._own(paths) - self._written
            if not names:  # as of run.json itself, which need not be read again then
                return
            for name in names:  # a folder of the run may be a link to one of other files
                path_within(self.path, name, where=str(self.path), links=True)
            record = self.record
            if record.begins_files(names):
                record.write(self.path / RECORD)
            self._written |= names

        self._making = stage
        try:
            with watched_writes(note):
                yield
        finally:
            self._making = ""

    def _own(self, paths: Sequence[Path]) -> set[str]:
        """Names of the files that lie in the folder, without checkpoints and the record itself."""
        folder = self.path.absolute()
        places = (path.absolute() for path in paths)
        names = {p.relative_to(folder).as_posix() for p in places if p.is_relative_to(folder)}
        checkpoints = tuple(one for stage in self.stages.values() for one in stage.checkpoints)
        return {n for n in names - {RECORD, SUMMARY} if not _is_one_of(n, checkpoints)}

    def _checkpoints(self, name: str) -> list[str]:
        """Files by which a stage goes on, as they are there."""
        found = (path for one in self.stages[name].checkpoints for path in self.path.glob(one))
        return sorted(path.name for path in found)

    def _write(self, record: Record) -> None:
        """Write run.json, and summary.json where it is another."""
        self.restore_summary(record)
        record.write(self.path / RECORD)

    def restore_summary(self, record: Record | None = None) -> None:
        """Write summary.json as the stages that have ended have it, where it is not so."""
        record = record or self.record
        path, sections = self.path / SUMMARY, self._merged(record)
        if not sections:
            path.unlink(missing_ok=True)
            return
        content = {"schema": SCHEMA, **self.head(record.facts), **sections}
        text = json_text(as_json(content))
        if not path.is_file() or read_bytes(path) != text.encode():
            write_text(path, text)

    # -- removing ---------------------------------------------------------------------------------

    def clear(self, *others: str) -> None:
        """Remove what the run wrote, and some other files; the record goes last."""
        record = self.record
        files = record.file_names
        files |= {one for name in self.stages for one in self._checkpoints(name)}
        record.artefacts = {}
        self._remove({*files, *others, SUMMARY}, record)
        self._remove({RECORD}, record)

    def _remove(self, names: Any, record: Record) -> None:
        """Remove files that belong to no other artefact, and the folders that they leave empty."""
        others = {one for artefact in record.artefacts.values() for one in artefact.files}
        folders = set()
        for name in set(names) - others:
            path = path_within(self.path, name, where=str(self.path), links=True)
            path.unlink(missing_ok=True)
            folders.add(path.parent)
        for folder in folders - {self.path}:
            if folder.is_dir():
                remove_leftovers(folder)
                if not any(not is_leftover(one.name) for one in folder.iterdir()):
                    folder.rmdir()


def _times(path: Path) -> tuple[int, ...]:
    """What is another number once a file is another; () where there is none."""
    try:
        status = path.stat()
    except OSError:
        return ()
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _reason(known: Artefact | None, parts: Mapping[str, Any], harmed: str) -> str:
    """Why an artefact is made anew, as the end of a line; '' where it was never made."""
    if known is None:
        return ""
    if harmed:
        return f" again, as {harmed} is not what it wrote"
    changed = difference(known.parts, parts)
    return f" again, as {changed}" if changed else " again"


def _is_one_of(name: str, patterns: tuple[str, ...]) -> bool:
    """Boolean: a file name fits one of some patterns."""
    return any(fnmatch(name, one) for one in patterns)
