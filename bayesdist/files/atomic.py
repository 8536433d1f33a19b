"""Files that appear whole or not at all, and their fingerprints."""

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
LONGEST_NAME = 200  # bytes, of 255 that file systems have room for, beside the mark
_watchers: list[Callable[[Sequence[Path]], None]] = []


@contextmanager
def watched_writes(note: Callable[[Sequence[Path]], None]) -> Iterator[None]:
    """Call a function with the paths that `atomic_path` writes, before a file takes its name.

    `note`: where it raises, the file does not appear.
    """
    _watchers.append(note)
    try:
        yield
    finally:
        _watchers.remove(note)


def announce(paths: Sequence[Path]) -> None:
    """Tell those who watch writes of files to come, all at once: sooner than one by one."""
    for note in _watchers:
        note(paths)


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Path of a temporary file that takes the place of `path` when the block succeeds.

    The temporary file lies in the same folder and its name ends like that of `path`, so that
    writers which go by the extension do the same.  When the block raises, it is removed and
    whatever stood at `path` before is left as it was.

    `path`: file to write. Result: where to write; no file is there yet. InputError when the system
    refuses to write, naming the path and the reason (full disk, no permission).
    """
    target = Path(path)
    temporary = target.with_name(f"{_MARK}{secrets.token_hex(4)}-{target.name}")
    try:
        yield temporary
        with temporary.open("rb+") as written:
            os.fsync(written.fileno())  # a rename may reach the disk before the content does
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
    """What the system says; HDF5 wraps it in lines of its own."""
    if error.errno:
        return os.strerror(error.errno)
    return str(error).strip().splitlines()[0][:160] if str(error).strip() else "unknown reason"


def _concerns(error: OSError, temporary: Path, target: Path) -> bool:
    """Whether an error is about the file being written, not about another that the block uses."""
    if error.filename is None:  # a full disk carries no name
        return True
    return Path(os.fsdecode(error.filename)) in (temporary, target, target.parent)


def made_folder(path: str | os.PathLike[str]) -> Path:
    """A folder that is there from now on, with those above it.

    InputError when the system refuses to make it, naming the path and the reason.
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
    """Path of a file below a folder, by its name there.

    Names that stand in files which others may have written are not to lead anywhere else.

    `where`: the file that has the name, for the error. `links`: follow symbolic links in the
    folders of the path, too. InputError for a name that leads out of the folder.
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
    """Refuse (InputError) a file name that leads into another folder or that no system takes.

    `where`: the setting that the name is made from.
    """
    if not name.isprintable() or {*name} & {*"/\\"} or not 0 < len(name.encode()) <= LONGEST_NAME:
        start = name if len(name) <= 60 else f"{name[:60]}..."
        raise InputError(
            f"{start!r} cannot be the name of a file",
            where=where,
            do=f"choose shorter names without slashes, of {LONGEST_NAME} bytes at most",
        )


def is_leftover(name: str) -> bool:
    """Whether a file name is that of a temporary file, left by a process that was killed."""
    return name.startswith(_MARK)


def remove_leftovers(folder: str | os.PathLike[str]) -> None:
    """Remove the temporary files that killed processes left in a folder."""
    for path in Path(folder).glob(f"{_MARK}*"):
        path.unlink(missing_ok=True)


def sha256_of(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file's content.

    Result: 64 hexadecimal digits. InputError when the file cannot be read.
    """
    with opened(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
