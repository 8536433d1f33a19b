"""Uniform errors for the exceptions that libraries raise for damaged files."""

from __future__ import annotations

import math
import signal
import struct
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bayesdist.errors import BayesdistError, FormatError, InputError

REPEAT = 0.01  # seconds until an interrupt is repeated that was lost


@contextmanager
def raising_interrupts() -> Iterator[None]:
    """Raise KeyboardInterrupt for an exception that was caused by an interrupt.

    A library that is interrupted in a callback, or while it closes a file, may fail in other ways;
    HDF5, for example, raises a SystemError. An interrupt that a script was already handling before
    does not count.
    """
    before, handler = sys.exception(), installed_handler()
    n_before = 0 if handler is None else handler.n
    try:
        yield
    except Exception as error:
        noted = handler is not None and handler.n > n_before
        if noted or _comes_of_interrupt(error, before):
            raise KeyboardInterrupt from error
        raise


class InterruptHandler:
    """Handler of SIGINT and SIGTERM for a program, which raises KeyboardInterrupt for each of them.

    A second signal within `again` seconds of the first is ignored, because open files are being
    closed then, and another interrupt would leave a traceback.  A later signal counts, since the
    first one may have been lost.
    """

    def __init__(self, again: float = 2.0) -> None:
        self.again = again
        self.n = 0  # interrupts so far
        self.terminated = False  # True after SIGTERM
        self.deferring = self.deferred = False
        self._last = -math.inf

    def __call__(self, number: int = signal.SIGINT, *_: object) -> None:
        """Raise the interrupt, unless it follows another one soon."""
        self.n += 1
        self.terminated |= number == signal.SIGTERM
        now = time.monotonic()
        if now - self._last <= self.again:
            return
        self._last = now
        if self.deferring:
            self.deferred = True
        else:
            raise KeyboardInterrupt

    def repeat_lost(self, unraisable: Any) -> None:
        """Hook for `sys.unraisablehook`: repeat an interrupt that Python would print and ignore.

        Python ignores exceptions in destructors and in callbacks of weak references, which may run
        at any time. After an interrupt their other exceptions are not printed, since destructors of
        objects whose construction was interrupted fail.
        """
        if not isinstance(unraisable.exc_value, KeyboardInterrupt):
            if not self.n:
                sys.__unraisablehook__(unraisable)
            return
        self._last = -math.inf
        number = signal.SIGTERM if self.terminated else signal.SIGINT
        threading.Timer(REPEAT, _signal_main_thread, [number]).start()


def installed_handler() -> InterruptHandler | None:
    """Interrupt handler of this program; None if none is installed.

    Background jobs ignore SIGINT, so that the handler may be installed for SIGTERM only.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        handler = signal.getsignal(number)
        if isinstance(handler, InterruptHandler):
            return handler
    return None


def _signal_main_thread(number: signal.Signals) -> None:
    """Send a signal to the main thread, which wakes it if it waits."""
    ident = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and ident is not None:
        signal.pthread_kill(ident, number)
    else:  # Windows
        signal.raise_signal(number)


def _comes_of_interrupt(error: BaseException, before: BaseException | None) -> bool:
    """True if an error was raised from a KeyboardInterrupt, or during one later than `before`."""
    visited = {id(before)}
    open_ends: list[BaseException | None] = [error]
    while open_ends:
        cause = open_ends.pop()
        if cause is None or id(cause) in visited:
            continue
        if isinstance(cause, KeyboardInterrupt):
            return True
        visited.add(id(cause))
        open_ends += [cause.__cause__, cause.__context__]
    return False


@contextmanager
def deferred_interrupts() -> Iterator[None]:
    """Delay Ctrl-C until the end of the block, if an `InterruptHandler` is installed.

    HDF5 prints a traceback if a callback is interrupted.
    """
    handler = installed_handler()
    main = threading.current_thread() is threading.main_thread()
    if not main or handler is None or handler.deferring:
        yield
        return
    handler.deferring = True
    try:
        yield
    finally:
        handler.deferring = False
        if handler.deferred:
            handler.deferred = False
            raise KeyboardInterrupt


@contextmanager
def blocked_interrupts() -> Iterator[None]:
    """Delay Ctrl-C until the end of the block; processes that are started in it never receive one.

    A terminal sends Ctrl-C to child processes, too, and they would print tracebacks.  On systems
    without signal masks (Windows) nothing is delayed.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def naming_faults(path: Path, where: str = "") -> Iterator[None]:
    """Convert any exception while a file is read to an error that names the file, or `where`.

    Readers of damaged files raise many kinds of exceptions, so all are caught; only InputError
    passes unchanged. Raises InputError if the system refuses to read, FormatError if the content
    does not conform to the format.
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
    """Convert any exception while an object is restored from its file to a FormatError.

    A file in the folder of a run may have been changed. Missing or inconsistent content only shows
    when objects are made from it.

    `what`: the object with its article, as in 'a posterior'. `do`: advice on how to make the file
    again.
    """
    try:
        with raising_interrupts(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # caused by foreign files
            yield
    except BayesdistError as error:
        if str(path) in error.where:
            raise
        location = f"{path}: {error.where}" if error.where else str(path)
        raise FormatError(error.cause, where=location, do=do) from error
    except Exception as error:
        raise FormatError(
            f"this is not {what} that bayesdist wrote, or it is damaged ({reason_of(error)})",
            where=str(path),
            do=do,
        ) from error


# messages of these exceptions are about the code of the reader, not about the file
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
    """First line of the message of an exception about a file; its type if the message is empty."""
    if isinstance(error, _OF_CODE):
        return "it is not laid out as this format demands"
    line = next(iter(str(error).strip().splitlines()), "") or type(error).__name__
    return line[:160].rstrip(".")
