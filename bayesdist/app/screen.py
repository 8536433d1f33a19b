"""Logs, progress bars and tables in the terminal."""

from __future__ import annotations

import logging
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import BufferedWriter, FileIO, TextIOWrapper
from numbers import Integral, Real
from pathlib import Path
from typing import Any

from bayesdist.errors import InputError
from bayesdist.files.regular import descriptor_for_writing

log = logging.getLogger("bayesdist")
_UNITS_UNKNOWN_TO_ASTROPY = (
    r".*did not parse as .*unit",
    r".*has a unit but is kept as a ",  # Column of a QTable
    r"The unit '.*' has been deprecated",
    r".*could not be saved in native FITS format",
)
# loggers that print tracebacks of lost connections before our message; Dask sets their levels
DASK_LOGS = ("distributed.client", "distributed.core", "distributed.comm.tcp", "distributed.utils")
_OF_STAGE = ": WARNING: "  # between the name of a stage and its warning
FORMAT = "%(asctime)s %(levelname)-7s %(message)s"


def open_streams() -> None:
    """Open null streams for a process that was started without standard streams.

    Otherwise files that it opens would get the descriptors of these streams, and output of
    libraries to stderr would be written to one of the files.
    """
    for number_of, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(number_of)
        except OSError:
            # the new file gets the lowest free descriptor
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
        if getattr(sys, name) is None:
            stream = os.fdopen(number_of, mode, encoding="utf-8", closefd=False)
            setattr(sys, name, stream)


def start_logging(*, quiet: bool) -> None:
    """Send the log of the package to stderr; only warnings if `quiet`.

    Warnings of astropy about units of unused columns are suppressed, because relevant units are
    checked column by column.
    """
    for message in _UNITS_UNKNOWN_TO_ASTROPY:
        warnings.filterwarnings("ignore", message=message)
    log.setLevel(logging.INFO)
    log.propagate = False
    for handler in list(log.handlers):
        log.removeHandler(handler)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Plain("%(message)s"))
    handler.addFilter(_Once())
    handler.setLevel(logging.WARNING if quiet else logging.INFO)
    log.addHandler(handler)
    for name in DASK_LOGS:
        logging.getLogger(name).addFilter(_nothing)


class _Plain(logging.Formatter):
    """Messages, of which warnings say that they are."""

    def format(self, record: logging.LogRecord) -> str:
        """Text of a record."""
        text = super().format(record)
        if record.levelno != logging.WARNING or record.levelname in text:
            return text
        return f"{record.levelname}: {text}"


class _Once(logging.Filter):
    """Filter that rejects repeated warnings, as of a file that a command reads several times.

    Stages of a run repeat a warning after their names.
    """

    def __init__(self) -> None:
        super().__init__()
        self._seen: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        """True unless the record is a warning that was passed before."""
        if record.levelno != logging.WARNING:
            return True
        text = record.getMessage().rsplit(_OF_STAGE, 1)[-1]
        if text in self._seen:
            return False
        self._seen.add(text)
        return True


def _nothing(_: logging.LogRecord) -> bool:
    """Reject every log record; a named function, so that it is added to a logger only once."""
    return False


class _QuietHandler(logging.FileHandler):
    """Log file that ignores errors of writing it, such as a full disk, which would hide others."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  logging's own name
        """Ignore the error."""

    def _open(self) -> TextIOWrapper:
        """Open the log for appending, without following a symbolic link."""
        descriptor = descriptor_for_writing(self.baseFilename, os.O_APPEND)
        binary = BufferedWriter(FileIO(descriptor, self.mode))
        return TextIOWrapper(binary, encoding=self.encoding)


@contextmanager
def log_file(path: Path) -> Iterator[None]:
    """Send the log to a file as well."""
    try:
        handler = _QuietHandler(path, encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"cannot be written ({error.strerror})",
            where=str(path),
            do="check its permissions",
        ) from error
    handler.setFormatter(logging.Formatter(FORMAT))
    handler.addFilter(_Once())
    log.addHandler(handler)
    try:
        yield
    finally:
        log.removeHandler(handler)
        with suppress(OSError):
            handler.close()


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[[int, int], None]]:
    """Progress bar on stderr, shown only if stderr is a terminal."""
    from tqdm import tqdm

    is_terminal = sys.stderr is not None and sys.stderr.isatty()
    with tqdm(
        desc=label, unit="step", disable=not is_terminal, leave=False, file=sys.stderr
    ) as bar:

        def update(made: int, most: int) -> None:
            bar.total = most
            bar.update(made - bar.n)

        yield update


def number(value: Any, digits: int = 4) -> str:
    """Text of a number for display."""
    if isinstance(value, Real) and not isinstance(value, Integral):
        return f"{value:.{digits}g}" if math.isfinite(value) else "-"
    return "-" if value is None else str(value)


def table_text(rows: list[dict[str, Any]], digits: int = 4) -> str:
    """Rows as aligned text: text on the left, numbers on the right, headings centred."""
    if not rows:
        return "(none)"
    columns = []
    for name, first in rows[0].items():
        texts = [number(row[name], digits) for row in rows]
        width = max(3, len(name), *map(len, texts))
        pad = str.ljust if isinstance(first, str) else str.rjust
        columns.append([name.center(width), "-" * width, *(pad(text, width) for text in texts)])
    return "\n".join(" ".join(line).rstrip() for line in zip(*columns, strict=True))
