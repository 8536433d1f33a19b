"""What a person sees in the terminal: logs, progress, tables."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from tqdm import tqdm

from bayesdist.errors import InputError

__all__ = ["log_file", "number", "progress_bar", "start_logging", "table_text"]

log = logging.getLogger("bayesdist")
FORMAT = "%(asctime)s %(levelname)-7s %(message)s"


def start_logging(verbosity: int = 0) -> None:
    """Send the package's log to stderr: nobody else's logging is touched."""
    log.setLevel(logging.INFO)
    log.propagate = False
    for handler in list(log.handlers):
        log.removeHandler(handler)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    handler.setLevel({-1: logging.WARNING}.get(verbosity, logging.INFO))
    log.addHandler(handler)


@contextmanager
def log_file(path: Path) -> Iterator[None]:
    """Send the log to a file as well.

    Raises
    ------
    InputError
        When the file cannot be written.
    """
    try:
        handler = logging.FileHandler(path, encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"cannot be written ({error.strerror})", where=str(path), do="check its permissions"
        ) from error
    handler.setFormatter(logging.Formatter(FORMAT))
    # a full disk must not bury the error that stops the run under logging's own tracebacks
    handler.handleError = lambda record: None  # type: ignore[method-assign]
    log.addHandler(handler)
    try:
        yield
    finally:
        log.removeHandler(handler)
        try:
            handler.close()
        except OSError:
            pass


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar on stderr, silent where stderr is no terminal."""
    with tqdm(
        desc=label, unit="step", disable=not sys.stderr.isatty(), leave=False, file=sys.stderr
    ) as bar:

        def update(made: int, most: int) -> None:
            bar.total = most
            bar.update(made - bar.n)

        yield update


def number(value: Any, digits: int = 4) -> str:
    """A number as a person reads it."""
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return "-"
    if isinstance(value, (float, np.floating)):
        return f"{value:.{digits}g}"
    return str(value)


def table_text(rows: list[dict[str, Any]], digits: int = 4) -> str:
    """Rows as aligned text."""
    if not rows:
        return "(none)"
    table = Table({k: [number(row[k], digits) for row in rows] for k in rows[0]})
    left = [c for c in table.colnames if isinstance(rows[0][c], str)]
    lines = table.pformat(
        max_lines=-1, max_width=-1, align=["<" if c in left else ">" for c in table.colnames]
    )
    return "\n".join(line.rstrip() for line in lines)
