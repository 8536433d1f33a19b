"""Store of artefacts in a folder: loaded if they are up to date, otherwise made.

A lock restricts a folder to one process, names its holder, and ends with the process.
"""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from fnmatch import fnmatch
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from time import monotonic
from typing import Any, Generic, TypeVar

from bayesdist.app.store.record import (
    SCHEMA,
    Adjustable,
    Artefact,
    FileMark,
    Record,
    as_json,
    difference,
    digest_of,
    json_text,
    write_text,
)
from bayesdist.errors import InputError
from bayesdist.files.atomic import (
    is_leftover,
    made_folder,
    path_within,
    remove_leftovers,
    watched_writes,
)
from bayesdist.files.regular import descriptor_for_writing, read_bytes

T = TypeVar("T")

RECORD, SUMMARY = "run.json", "summary.json"

log = logging.getLogger("bayesdist")

# not available on all systems
fcntl: Any = import_module("fcntl") if find_spec("fcntl") else None

LOCK = ".bayesdist.lock"
LONGEST = 200  # bytes to read of a lock file


@dataclass(frozen=True)
class Stage:
    """Properties of a stage.

    Parameters
    ----------
    revision : int
        Raised when the results of the stage change.
    checkpoints : tuple of str
        File-name patterns of the checkpoints, from which an interrupted stage continues.
    """

    revision: int = 1
    checkpoints: tuple[str, ...] = ()


@dataclass(frozen=True)
class Made(Generic[T]):
    """An artefact that is up to date.

    Parameters
    ----------
    name : str
        Name of its stage.
    digest : str
        Hash of what the stage wrote.  It is part of the key of artefacts that depend on this one.
    value : object or None
        Return value of the stage; None if the stage was not run because its artefact was up to
        date.
    """

    name: str
    digest: str
    value: T | None = None


class ArtefactStore:
    """Artefacts in a folder, each identified by the content of its ingredients.

    An artefact is up to date if its key, a hash of its ingredients, and its files are unchanged.  A
    file is noted in run.json before it appears under its name, so that all files of a stage are
    known even if the process is killed.

    Parameters
    ----------
    path : Path
        The folder.
    stages : mapping of str to Stage
        Stages in order.
    head : callable
        ``head(facts)`` returns the entries of summary.json about the run as a whole, from the
        entries of run.json.
    """

    def __init__(
        self,
        path: Path,
        stages: Mapping[str, Stage],
        head: Callable[[Mapping[str, Any]], Mapping[str, Any]] = lambda facts: {},
    ) -> None:
        self.path, self.stages, self.head = path, stages, head
        self._planned: Record | None = None
        self._read: tuple[tuple[int, ...], Record] | None = None  # with the times of run.json
        # by file name, with the times of the file
        self._known: dict[str, tuple[tuple[int, ...], FileMark]] = {}
        # of the stage that is being made by this process
        self._making = ""
        self._sections: dict[str, Any] = {}
        self._written: set[str] = set()

    # -- what is there ----------------------------------------------------------------------------

    @property
    def record(self) -> Record:
        """Content of run.json, or its planned content."""
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
        """Sections of summary.json: those of completed stages, and those of the current stage.

        A stage sees only the sections of preceding stages and its own.  Sections of a function that
        is called outside of a stage are included here, but not written to a file.
        """
        return self._merged(self.record, before=self._making) | self._sections

    def _merged(self, record: Record, before: str = "") -> dict[str, Any]:
        """Sections of all artefacts; those of later stages replace those of earlier ones."""
        out: dict[str, Any] = {}
        for name in self.stages:
            if name == before:  # never, if that is empty
                break
            if name in record.artefacts:
                out |= record.artefacts[name].sections
        return out

    def standing(self, name: str, *made_from: object) -> Made[Any] | None:
        """Artefact of a stage if its key and file sizes are unchanged, otherwise None."""
        artefact = self.record.artefacts.get(name)
        if artefact is None or artefact.key != digest_of(self._parts(name, made_from)):
            return None
        if self.harmed(artefact, thorough=False):
            return None
        return Made(name, artefact.digest)

    def _parts(self, name: str, made_from: tuple[object, ...]) -> dict[str, Any]:
        """Ingredients of an artefact, as stored in run.json."""
        digests = {
            ingredient.name: ingredient.digest
            for ingredient in made_from
            if isinstance(ingredient, Made)
        }
        parts: dict[str, Any] = {"revision": self.stages[name].revision, "from": digests}
        for ingredient in made_from:
            if not isinstance(ingredient, Made):
                parts |= as_json(
                    ingredient.value if isinstance(ingredient, Adjustable) else ingredient
                )
        return parts

    def harmed(self, artefact: Artefact, *, thorough: bool) -> str:
        """First file of an artefact that differs from what its stage wrote; empty if none does."""
        for name, mark in artefact.files.items():
            path = self.path / name
            if not path.is_file() or path.stat().st_size != mark.size:
                return name
            if thorough and self._mark(name) != mark:
                return name
        return ""

    def _mark(self, name: str) -> FileMark:
        """Mark of a file, which is read again only if its times have changed."""
        now = _times(self.path / name)
        if self._known.get(name, (None, None))[0] != now:
            self._known[name] = now, FileMark.of(self.path / name)
        return self._known[name][1]

    def locked(self) -> AbstractContextManager[None]:
        """Lock the folder against other processes; the lock ends with the process."""
        return locked(self.path)

    # -- making -----------------------------------------------------------------------------------

    def stage(
        self, name: str, function: Callable[[], T], *made_from: object, force: bool = False
    ) -> Made[T]:
        """Artefact of a stage, which is made unless it is up to date.

        Parameters
        ----------
        name : str
        function : callable
            Writes files to the folder, and sections by `summarise`.
        *made_from : Made or mapping
            Ingredients; mappings must be convertible to plain JSON.
        force : bool
            Call the function even if the artefact is up to date.

        Returns
        -------
        Made
        """
        parts, record = self._parts(name, made_from), self.record
        key, previous = digest_of(parts), record.artefacts.get(name)
        harmed = "" if previous is None else self.harmed(previous, thorough=True)
        if previous is not None and previous.key == key and not harmed and not force:
            log.info("%s: done before", name)
            return Made(name, previous.digest)
        log.info("%s: begins%s", name, _reason(previous, parts, harmed))
        fixed = tuple(
            ingredient for ingredient in made_from if not isinstance(ingredient, Adjustable)
        )
        self._begin(record, name, digest_of(self._parts(name, fixed)), harmed)
        started = monotonic()
        with self._noted(name):
            value = function()
        artefact = self._end(name, key, parts, monotonic() - started)
        return Made(name, artefact.digest, value)

    def summarise(self, **sections: Any) -> None:
        """Replace sections of summary.json for the current stage."""
        self._sections |= as_json(sections)

    @contextmanager
    def amended(self, name: str, *made_from: object) -> Iterator[dict[str, Any]]:
        """Record files that a command adds to a stage; yields the entries of the record to change.

        `made_from` are the new ingredients of the artefact; empty if it is not up to date.
        """
        record, self._sections = self.record, {}
        previous = record.artefacts.get(name)
        written: set[str] = set()

        def note(paths: Sequence[Path]) -> None:
            written.update(self._own(paths))

        with watched_writes(note):
            yield record.facts
        parts = self._parts(name, made_from) if previous and made_from else {}
        previous = previous or Artefact(key="", parts={}, files={}, sections={})
        files = {file: FileMark.of(self.path / file) for file in written if self._is_there(file)}
        files = {
            file: mark for file, mark in previous.files.items() if self._is_there(file)
        } | files
        sections = {**previous.sections, **self._sections}
        key = digest_of(parts) if parts else ""
        record.artefacts[name] = Artefact(key=key, parts=parts, files=files, sections=sections)
        self._sections = {}
        self._write(record)

    def _begin(self, record: Record, name: str, checkpoints: str, harmed: str) -> None:
        """Note that a stage begins, and remove its earlier files, which it must not see."""
        patterns = self.stages[name].checkpoints
        before = record.under_way or {"stage": name, "files": []}
        previous = record.artefacts.pop(name, None)
        record.stages.pop(name, None)
        remove_leftovers(self.path)
        files = set(previous.files) if previous else set()
        if before["stage"] == name:
            files |= set(before["files"])
        else:
            self._remove(before["files"], record)  # of another stage that was interrupted
        record.under_way = {"stage": name, "files": sorted(files)}
        if patterns:
            if record.checkpoints.get(name) != checkpoints or _is_one_of(harmed, patterns):
                if record.checkpoints.pop(name, None) is not None:
                    self._write(record)  # first: partly removed checkpoints are never used
                self._remove(self._checkpoints(name), record)
            record.checkpoints[name] = checkpoints
        self._sections, self._written = {}, set()
        self._write(record)  # first: partly removed files are never used
        self._remove({file for file in files if not _is_one_of(file, patterns)}, record)

    def _end(self, name: str, key: str, parts: dict[str, Any], seconds: float) -> Artefact:
        """Note that a stage has ended."""
        record = self.record
        written = {file for file in self._written if self._is_there(file)}
        written |= set(self._checkpoints(name))
        marks = {file: FileMark.of(self.path / file) for file in sorted(written)}
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
        """Drop the sections of a stage from later artefacts that were made from another version."""
        stale: set[str] = set()
        for later in list(self.stages)[list(self.stages).index(name) + 1 :]:
            affected = record.artefacts.get(later)
            made_from = {} if affected is None else affected.parts.get("from", {})
            if affected is not None and (
                made_from.get(name, artefact.digest) != artefact.digest or stale & made_from.keys()
            ):
                stale.add(later)
                remaining = {
                    k: v for k, v in affected.sections.items() if k not in artefact.sections
                }
                record.artefacts[later] = affected.model_copy(update={"sections": remaining})

    def _in_order(self, found: dict[str, Any]) -> dict[str, Any]:
        """Entries of stages, in the order of the stages."""
        return {stage: found[stage] for stage in self.stages if stage in found}

    def _is_there(self, name: str) -> bool:
        """True if a file of the folder exists."""
        return (self.path / name).is_file()

    @contextmanager
    def _noted(self, stage: str) -> Iterator[None]:
        """Note all written files in run.json before they appear under their names."""

        def note(paths: Sequence[Path]) -> None:
            names = self._own(paths) - self._written
            if not names:  # for example run.json itself
                return
            for name in names:  # a folder inside the run may be a link to a foreign one
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
        """Names of files inside the folder, without checkpoints and the record itself."""
        folder = self.path.absolute()
        places = (path.absolute() for path in paths)
        names = {p.relative_to(folder).as_posix() for p in places if p.is_relative_to(folder)}
        checkpoints = tuple(
            pattern for stage in self.stages.values() for pattern in stage.checkpoints
        )
        return {n for n in names - {RECORD, SUMMARY} if not _is_one_of(n, checkpoints)}

    def _checkpoints(self, name: str) -> list[str]:
        """Existing checkpoint files of a stage."""
        paths = (
            path for pattern in self.stages[name].checkpoints for path in self.path.glob(pattern)
        )
        return sorted(path.name for path in paths)

    def _write(self, record: Record) -> None:
        """Write run.json, and summary.json if it has changed."""
        self.restore_summary(record)
        record.write(self.path / RECORD)

    def restore_summary(self, record: Record | None = None) -> None:
        """Write summary.json from the completed stages, unless it is up to date."""
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
        """Remove the files of the run and some others; the record is removed last."""
        record = self.record
        files = record.file_names
        files |= {file for name in self.stages for file in self._checkpoints(name)}
        record.artefacts = {}
        self._remove({*files, *others, SUMMARY}, record)
        self._remove({RECORD}, record)

    def _remove(self, names: Any, record: Record) -> None:
        """Remove files that belong to no other artefact, and folders that become empty."""
        needed = {entry for artefact in record.artefacts.values() for entry in artefact.files}
        folders = set()
        for name in set(names) - needed:
            path = path_within(self.path, name, where=str(self.path), links=True)
            path.unlink(missing_ok=True)
            folders.add(path.parent)
        for folder in folders - {self.path}:
            if folder.is_dir():
                remove_leftovers(folder)
                if not any(not is_leftover(entry.name) for entry in folder.iterdir()):
                    folder.rmdir()


def _times(path: Path) -> tuple[int, ...]:
    """Numbers that change whenever the file changes; empty if there is no file."""
    try:
        status = path.stat()
    except OSError:
        return ()
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _reason(known: Artefact | None, parts: Mapping[str, Any], harmed: str) -> str:
    """Reason for making an artefact again, as the end of a line; empty if it is made first."""
    if known is None:
        return ""
    if harmed:
        return f" again, as {harmed} is not what it wrote"
    changed = difference(known.parts, parts)
    return f" again, as {changed}" if changed else " again"


def _is_one_of(name: str, patterns: tuple[str, ...]) -> bool:
    """True if a file name matches one of some patterns."""
    return any(fnmatch(name, pattern) for pattern in patterns)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a folder against other processes, and create it if necessary.

    The lock is held on an open file; the existence of the file does not matter.  A file left behind
    by a killed process therefore blocks nothing.
    """
    made_folder(folder)
    if fcntl is None:
        yield
        return
    path = folder / LOCK
    held = _acquired(path)
    try:
        with suppress(OSError):  # a full disk
            os.ftruncate(held, 0)
            since = datetime.now(UTC).isoformat(timespec="seconds")
            holder = f"process {os.getpid()} on {socket.gethostname()} since {since}"
            os.pwrite(held, holder.encode(), 0)
        yield
    finally:
        with suppress(OSError):
            path.unlink()  # while the lock is held, so that no other process's file is removed
        os.close(held)


def _acquired(path: Path) -> int:
    """Descriptor of the locked file."""
    while True:
        try:
            held = descriptor_for_writing(path)
        except OSError as error:
            raise InputError(
                f"the folder cannot be written into ({error.strerror})",
                where=str(path.parent),
                do="make room, or choose a folder that you may write to",
            ) from error
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = _read(held)
            os.close(held)
            raise InputError(
                f"another process is using this run{holder and f' ({holder})'}",
                where=str(path.parent),
                do="wait until it has ended, or choose another folder",
            ) from error
        except OSError as error:  # file systems without locks
            log.debug("%s cannot be locked: %s", path, error)
            return held
        if _is_at(held, path):
            return held
        os.close(held)  # the previous holder has removed the file in the meantime


def _is_at(held: int, path: Path) -> bool:
    """True if an open file still has its name."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(held), path.lstat())
    return False


def _read(held: int) -> str:
    """Text in a lock file; empty if there is none."""
    text = os.pread(held, LONGEST, 0).decode("utf-8", errors="replace")
    return "".join(c for c in text if c.isprintable())
