"""Atomic writing of files, and checksums."""

from __future__ import annotations

import hashlib
import os
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from bayesdist.errors import InputError
from bayesdist.files.regular import opened

_MARK = ".bayesdist-"
LONGEST_NAME = 200  # bytes; file systems allow 255, which must also hold the mark
_watchers: list[Callable[[Sequence[Path]], None]] = []


@contextmanager
def watched_writes(note: Callable[[Sequence[Path]], None]) -> Iterator[None]:
    """Call a function with the paths that `atomic_path` writes, before a file gets its final name.

    `note`: function of a sequence of paths. If it raises, the file is not created.
    """
    _watchers.append(note)
    try:
        yield
    finally:
        _watchers.remove(note)


def announce(paths: Sequence[Path]) -> None:
    """Notify watchers of several files that will be written; faster than one by one."""
    for note in _watchers:
        note(paths)


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Path of a temporary file that replaces `path` when the block succeeds.

    The temporary file is in the same folder and its name has the same ending as `path`, for writers
    that depend on the extension. If the block raises, the temporary file is removed and an existing
    file at `path` remains unchanged.

    `path`: file to write. Yields the path to write to, which does not exist yet. Raises InputError
    with the path and the reason if the system refuses to write (full disk, no permission).
    """
    target = Path(path)
    temporary = target.with_name(f"{_MARK}{secrets.token_hex(4)}-{target.name}")
    try:
        yield temporary
        with temporary.open("rb+") as written:
            os.fsync(written.fileno())  # otherwise the rename may reach the disk before the content
        announce([target])
        temporary.replace(target)
    except OSError as error:
        if not _concerns(error, temporary, target):
            raise
        raise InputError(
            f"cannot be written ({_reason(error)})",
            where=str(target),
            do="make room, or choose a folder that exists and that you may write to",
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def _reason(error: OSError) -> str:
    """Reason given by the system; HDF5 embeds it in a longer message."""
    if error.errno:
        return os.strerror(error.errno)
    return str(error).strip().splitlines()[0][:160] if str(error).strip() else "unknown reason"


def _concerns(error: OSError, temporary: Path, target: Path) -> bool:
    """True if an error is about the file being written, not another file used in the block."""
    if error.filename is None:  # the error of a full disk has no file name
        return True
    return Path(os.fsdecode(error.filename)) in (temporary, target, target.parent)


def made_folder(path: str | os.PathLike[str]) -> Path:
    """Create a folder, with its parents, unless it exists, and return its path.

    Raises InputError with the path and the reason if the system refuses to create it.
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"the folder cannot be made ({_reason(error)})",
            where=str(folder),
            do="choose one that you may write to",
        ) from error
    return folder


def path_within(
    folder: str | os.PathLike[str], name: str, *, where: str, links: bool = False
) -> Path:
    """Path of a file below a folder, from its name relative to that folder.

    Names are read from files that other people may have written, so they must not lead elsewhere.

    `where`: the file that contains the name, for the error message. `links`: True to resolve
    symbolic links in the folders of the path, too. Raises InputError if the name leads out of the
    folder.
    """
    folder = Path(folder)
    path = folder / name
    inside = not Path(name).is_absolute() and ".." not in Path(name).parts and bool(name)
    if inside and links:
        inside = path.parent.resolve().is_relative_to(folder.resolve())
    if not inside:
        raise InputError(
            f"names a file outside of its folder ({name!r})",
            where=where,
            do="restore it, or choose another folder",
        )
    return path


def refuse_unsafe_name(name: str, *, where: str) -> None:
    """Raise InputError for a file name that leads into another folder or is not portable.

    `where`: the setting from which the name is made.
    """
    if not name.isprintable() or {*name} & {*"/\\"} or not 0 < len(name.encode()) <= LONGEST_NAME:
        start = name if len(name) <= 60 else f"{name[:60]}..."
        raise InputError(
            f"{start!r} cannot be the name of a file",
            where=where,
            do=f"choose shorter names without slashes, of {LONGEST_NAME} bytes at most",
        )


def is_leftover(name: str) -> bool:
    """True for the name of a temporary file, which a killed process may have left."""
    return name.startswith(_MARK)


def remove_leftovers(folder: str | os.PathLike[str]) -> None:
    """Remove temporary files of killed processes from a folder."""
    for path in Path(folder).glob(f"{_MARK}*"):
        path.unlink(missing_ok=True)


def sha256_of(path: str | os.PathLike[str]) -> str:
    """SHA-256 of the content of a file, as 64 hexadecimal digits.

    Raises InputError if the file cannot be read.
    """
    with opened(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
