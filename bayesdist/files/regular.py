"""Bytes and text of regular files; refuses pipes, devices, folders and files too large for memory.

Files that are written in place, such as logs and locks, must also be regular files.
"""

from __future__ import annotations

import errno
import io
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

from bayesdist.errors import FormatError, InputError
from bayesdist.utils.memory import memory_limit, size_text

PathLike = str | os.PathLike[str]

MOST_HOLLOW = 1000  # ratio of file size to allocated blocks; no file system compresses as much
PIECE = 2**24  # bytes read at a time, if a file is longer than the system reports
MOST_TEXT = 2**28  # bytes of a configuration or a JSON file

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
    stat.S_IFLNK: "a symbolic link",
}
_REMOVE = "remove it, or choose another folder"


@contextmanager
def opened(path: PathLike) -> Iterator[io.BufferedReader]:
    """Context manager for a regular file, open for reading bytes.

    Raises InputError if the path does not exist, cannot be read, is not a regular file, or is a
    sparse file that is mostly holes.
    """
    try:
        stream = open(path, "rb", opener=_without_waiting)  # noqa: SIM115  in a context below
    except FileNotFoundError as error:
        raise InputError("does not exist", where=str(path), do="check the path") from error
    except IsADirectoryError as error:
        raise _irregular(path, stat.S_IFDIR) from error
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        reason = getattr(error, "strerror", None) or error
        raise InputError(
            f"cannot be read ({reason})",
            where=str(path),
            do="check the path and its permissions",
        ) from error
    with stream:
        status = os.fstat(stream.fileno())
        kind = stat.S_IFMT(status.st_mode)
        if kind != stat.S_IFREG:
            raise _irregular(path, kind)
        _refuse_hollow(path, status)
        yield stream


def _without_waiting(path: str, flags: int) -> int:
    """File descriptor; a pipe without a writer is opened without waiting."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def descriptor_for_writing(path: PathLike, flags: int = 0) -> int:
    """Descriptor of a regular file that is written in place; created if it does not exist.

    `flags`: further flags of `os.open`. Symbolic links are not followed, because other people may
    have created them in the folder, and their targets would be overwritten. Raises InputError for a
    link, a pipe, a device or a folder, and OSError if the file cannot be opened.
    """
    flags |= os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        held = os.open(path, flags, 0o666)
    except IsADirectoryError as error:
        raise _irregular(path, stat.S_IFDIR, _REMOVE) from error
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        raise _irregular(path, stat.S_IFLNK, _REMOVE) from error
    kind = stat.S_IFMT(os.fstat(held).st_mode)
    if kind != stat.S_IFREG:
        os.close(held)
        raise _irregular(path, kind, _REMOVE)
    return held


def _refuse_hollow(path: PathLike, found: os.stat_result) -> None:
    """Refuse a large file that is mostly holes, which would take hours to read."""
    written = 512 * getattr(found, "st_blocks", found.st_size)
    if found.st_size > memory_limit() and found.st_size > MOST_HOLLOW * max(written, 1):
        raise InputError(
            f"has {size_text(found.st_size)}, of which {size_text(written)} were ever written",
            where=str(path),
            do="it is damaged: fetch or write it again",
        )


def _irregular(path: PathLike, kind: int, do: str = "give a regular file") -> InputError:
    return InputError(f"is {_KINDS.get(kind, 'no file')}, not a file", where=str(path), do=do)


def read_bytes(path: PathLike, *, most: int | None = None) -> bytes:
    """Content of a file.

    `most`: largest plausible number of bytes; by default limited by the available memory. Raises
    InputError if the file cannot be read, and an error if it has more than `most` bytes.
    """
    most = memory_limit() if most is None else most
    with opened(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        try:
            raw = b"" if size > most else read_up_to(stream, most, expected=size)
        except OSError as error:
            raise InputError(
                f"cannot be read ({error.strerror or error})",
                where=str(path),
                do="check the disk, and fetch the file again",
            ) from error
    if max(size, len(raw)) > most:
        raise InputError(
            f"has {size_text(max(size, len(raw)))}, but at most {size_text(most)} are read",
            where=str(path),
            do="check that it is the intended file, or split it",
        )
    return raw


def read_up_to(stream: BinaryIO | io.BufferedIOBase, most: int, *, expected: int = PIECE) -> bytes:
    """Bytes of a stream: all of them, or the first `most` + 1 if there are more.

    A stream of `expected` bytes is read at once. Python allocates the requested number of bytes
    before it reads, so that larger streams are read in blocks.
    """
    parts, n = [], expected + 1
    while n and (part := stream.read(n)):
        parts.append(part)
        most -= len(part)
        n = min(max(most + 1, 0), PIECE)
    return b"".join(parts)


def read_text(path: PathLike, *, most: int | None = None) -> str:
    """Text of a UTF-8 file with its original line ends; raises the errors of `read_bytes`.

    Raises FormatError if the file is not UTF-8 text.
    """
    return decoded(read_bytes(path, most=most), str(path))


def decoded(raw: bytes, where: str) -> str:
    """Decode UTF-8 text; raises FormatError if the bytes are not UTF-8."""
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        raise FormatError(
            f"cannot be read (not UTF-8 text at byte {error.start + 1})",
            where=where,
            do="check the file",
        ) from error


def head_of(path: PathLike, n: int = 4096) -> bytes:
    """First n bytes of a file; empty if it cannot be read (its reader will report the error)."""
    try:
        with opened(path) as stream:
            return stream.read(n)
    except (InputError, OSError):
        return b""
