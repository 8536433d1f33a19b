"""Logs, progress and tables in the terminal."""

from __future__ import annotations

import logging
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import FileIO, TextIOWrapper
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
# they write tracebacks of lost connections above the sentence that says so; Dask sets their levels
DASK_LOGS = ("distributed.client", "distributed.core", "distributed.comm.tcp", "distributed.utils")
FORMAT = "%(asctime)s %(levelname)-7s %(message)s"


def open_streams() -> None:
    """Give a process that was started without standard streams empty ones.

    The files that it opens would get their numbers, and what a library writes to stderr would end
    in one of them.
    """
    for number_of, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(number_of)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # it gets the lowest number
        if getattr(sys, name) is None:
            stream = os.fdopen(number_of, mode, encoding="utf-8", closefd=False)
            setattr(sys, name, stream)


def start_logging(*, quiet: bool) -> None:
    """Send the package's log to stderr, warnings alone where it is quiet.

    What astropy says of units of columns that nobody uses stays out of the terminal: units that
    matter are checked column by column.
    """
    for message in _UNITS_UNKNOWN_TO_ASTROPY:
        warnings.filterwarnings("ignore", message=message)
    log.setLevel(logging.INFO)
    log.propagate = False
    for handler in list(log.handlers):
        log.removeHandler(handler)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    handler.setLevel(logging.WARNING if quiet else logging.INFO)
    log.addHandler(handler)
    for name in DASK_LOGS:
        logging.getLogger(name).addFilter(_nothing)


def _nothing(_: logging.LogRecord) -> bool:
    """Pass no record; a function of its own, so that it is added to a logger only once."""
    return False


class _QuietHandler(logging.FileHandler):
    """A log whose own errors do not bury that which stops the run, as of a full disk."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  logging's own name
        """Pass over it."""

    def _open(self) -> TextIOWrapper:
        """Open the log for appending; a symbolic link is not followed."""
        descriptor = descriptor_for_writing(self.baseFilename, os.O_APPEND)
        return TextIOWrapper(FileIO(descriptor, self.mode), encoding=self.encoding)


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
    log.addHandler(handler)
    try:
        yield
    finally:
        log.removeHandler(handler)
        with suppress(OSError):
            handler.close()


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar on stderr, silent where stderr is no terminal."""
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
    """A number as a person reads it."""
    if isinstance(value, Real) and not isinstance(value, Integral):
        return f"{value:.{digits}g}" if math.isfinite(value) else "-"
    return "-" if value is None else str(value)


def table_text(rows: list[dict[str, Any]], digits: int = 4) -> str:
    """Rows as aligned text: text to the left, numbers to the right, headings centred."""
    if not rows:
        return "(none)"
    columns = []
    for name, first in rows[0].items():
        texts = [number(row[name], digits) for row in rows]
        width = max(3, len(name), *map(len, texts))
        pad = str.ljust if isinstance(first, str) else str.rjust
        columns.append([name.center(width), "-" * width, *(pad(text, width) for text in texts)])
    return "\n".join(" ".join(line).rstrip() for line in zip(*columns, strict=True))
