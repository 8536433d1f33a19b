"""One error for whatever libraries raise on a damaged file."""

from __future__ import annotations

import math
import signal
import struct
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bayesdist.errors import BayesdistError, FormatError, InputError


@contextmanager
def raising_interrupts() -> Iterator[None]:
    """Raise KeyboardInterrupt for an error that comes of one.

    A library that is interrupted in a callback, or as it closes a file, may fail in a way of its
    own: HDF5 does so with a SystemError.  An interrupt that a script was handling before is none.
    """
    before, handler = sys.exception(), signal.getsignal(signal.SIGINT)
    n_before = handler.n if isinstance(handler, InterruptHandler) else 0
    try:
        yield
    except Exception as error:
        noted = isinstance(handler, InterruptHandler) and handler.n > n_before
        if noted or _comes_of_interrupt(error, before):
            raise KeyboardInterrupt from error
        raise


class InterruptHandler:
    """Handler of SIGINT for a program: a second one soon after the first changes nothing.

    What is open is closed then; an interrupt in the midst of that would leave a traceback.  After
    `again` seconds the first one may have been lost, and another one counts.
    """

    def __init__(self, again: float = 2.0) -> None:
        self.again = again
        self.n = 0  # interrupts so far
        self._last = -math.inf

    def __call__(self, *_: object) -> None:
        """Raise the interrupt, unless it follows another one soon."""
        self.n += 1
        now = time.monotonic()
        if now - self._last > self.again:
            self._last = now
            raise KeyboardInterrupt


def _comes_of_interrupt(error: BaseException, before: BaseException | None) -> bool:
    """Boolean: an error was raised from a KeyboardInterrupt, or during one after `before`."""
    seen = {id(before)}
    open_ends: list[BaseException | None] = [error]
    while open_ends:
        one = open_ends.pop()
        if one is None or id(one) in seen:
            continue
        if isinstance(one, KeyboardInterrupt):
            return True
        seen.add(id(one))
        open_ends += [one.__cause__, one.__context__]
    return False


@contextmanager
def naming_faults(path: Path, where: str = "") -> Iterator[None]:
    """Turn any failure while a file is read into an error that names the file, or `where` in it.

    Readers of damaged files raise exceptions of every kind, so all are caught; only our own pass as
    they are.  InputError when the system refuses to read, FormatError when the content is not what
    the format demands.
    """
    try:
        with raising_interrupts():
            yield
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError("does not exist", where=str(path), do="check the path") from error
    except (IsADirectoryError, PermissionError) as error:
        raise InputError(
            f"cannot be read ({error.strerror})", where=str(path), do="check the path"
        ) from error
    except Exception as error:
        raise FormatError(
            f"cannot be read as {path.suffix.lower() or 'a table'} ({reason_of(error)})",
            where=where or str(path),
            do="it may be truncated or of another format: fetch or write it again",
        ) from error


@contextmanager
def restoring(path: Path, what: str, *, do: str) -> Iterator[None]:
    """Turn any failure while an artefact is made from its file into one FormatError.

    A file of a run's folder may have been changed by anybody: what is missing in it, or of another
    shape, shows where objects are made from it.

    `what`: with its article, as in 'a posterior'. `do`: by which the file is made again.
    """
    try:
        with raising_interrupts(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of foreign files
            yield
    except BayesdistError as error:
        if str(path) in error.where:
            raise
        where = f"{path}: {error.where}" if error.where else str(path)
        raise FormatError(error.cause, where=where, do=do) from error
    except Exception as error:
        raise FormatError(
            f"this is not {what} that bayesdist wrote, or it is damaged ({reason_of(error)})",
            where=str(path),
            do=do,
        ) from error


# what they say is about the reader's code, not about the file
_OF_CODE = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    NameError,
    TypeError,
    struct.error,
)


def reason_of(error: Exception) -> str:
    """First line of what an exception says of a file, or its kind where it says nothing."""
    if isinstance(error, _OF_CODE):
        return "it is not laid out as this format demands"
    line = next(iter(str(error).strip().splitlines()), "") or type(error).__name__
    return line[:160].rstrip(".")
