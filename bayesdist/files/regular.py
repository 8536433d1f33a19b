"""Bytes and text of regular files: no pipe, device or folder, and no more than fits in memory.

Files that are written in place, a log and a lock, are regular ones, too.
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

MOST_HOLLOW = 1000  # times what was written: no file system compresses data as much
PIECE = 2**24  # bytes that are read at once, where a file is longer than the system says
MOST_TEXT = 2**28  # bytes of a configuration, or of a file of JSON

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
    """Context with a regular file, open for reading bytes.

    InputError for a path where there is none, none that the system lets us read, and a file of
    holes.
    """
    try:
        stream = open(path, "rb", opener=_without_waiting)  # noqa: SIM115  in a context below
    except FileNotFoundError as error:
        raise InputError("does not exist", where=str(path), do="check the path") from error
    except IsADirectoryError as error:
        raise _irregular(path, stat.S_IFDIR) from error
    except (OSError, ValueError) as error:  # a zero byte in a name is a ValueError
        reason = getattr(error, "strerror", None) or error
        raise InputError(
            f"cannot be read ({reason})",
            where=str(path),
            do="check the path and its permissions",
        ) from error
    with stream:
        found = os.fstat(stream.fileno())
        kind = stat.S_IFMT(found.st_mode)
        if kind != stat.S_IFREG:
            raise _irregular(path, kind)
        _refuse_hollow(path, found)
        yield stream


def _without_waiting(path: str, flags: int) -> int:
    """File descriptor; a pipe that nobody writes into is opened too, and not waited for."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def descriptor_for_writing(path: PathLike, flags: int = 0) -> int:
    """Descriptor of a regular file that is written in place, and made where there is none.

    `flags`: of `os.open`, in addition.  A folder may come from others: a symbolic link is not
    followed, since what it leads to would be overwritten.  InputError for a link, a pipe, a device
    or a folder.  OSError, as the system raises it, for a file that cannot be opened.
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
    """Refuse a large file of which hardly anything was written: to read its holes takes hours."""
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

    `most`: bytes that are plausible; by default what fits in memory.
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
            f"has {size_text(max(size, len(raw)))}, and at most {size_text(most)} are read",
            where=str(path),
            do="check that it is the file that is meant, or divide it",
        )
    return raw


def read_up_to(stream: BinaryIO | io.BufferedIOBase, most: int, *, expected: int = PIECE) -> bytes:
    """Bytes of a stream, at most one beyond `most`; read at once where it has as many as expected.

    Python allocates whatever is asked for before it reads.
    """
    parts, n = [], expected + 1
    while n and (part := stream.read(n)):
        parts.append(part)
        most -= len(part)
        n = min(max(most + 1, 0), PIECE)
    return b"".join(parts)


def read_text(path: PathLike, *, most: int | None = None) -> str:
    """Text of a file in UTF-8, with its line ends as they stand; errors as of `read_bytes`.

    FormatError where it is no such text.
    """
    return decoded(read_bytes(path, most=most), str(path))


def decoded(raw: bytes, where: str) -> str:
    """Text of bytes in UTF-8; FormatError where they are no such text."""
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        raise FormatError(
            f"cannot be read (not UTF-8 text at byte {error.start + 1})",
            where=where,
            do="check the file",
        ) from error


def head_of(path: PathLike, n: int = 4096) -> bytes:
    """The first bytes of a file; empty where it cannot be read, which is left to its reader."""
    try:
        with opened(path) as stream:
            return stream.read(n)
    except (InputError, OSError):
        return b""
