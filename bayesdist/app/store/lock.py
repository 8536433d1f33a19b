"""Lock that restricts a folder to one process, names its holder, and ends with the process."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from bayesdist.errors import InputError
from bayesdist.files.atomic import made_folder
from bayesdist.files.regular import descriptor_for_writing

# not available on all systems
fcntl: Any = import_module("fcntl") if find_spec("fcntl") else None

LOCK = ".bayesdist.lock"
LONGEST = 200  # bytes to read of a lock file

log = logging.getLogger("bayesdist")


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
