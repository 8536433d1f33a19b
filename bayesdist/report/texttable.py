"""Tables of text for a page."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import PurePath
from typing import Any

from bayesdist.utils.checks import Check
from bayesdist.utils.text import MISSING, number

_FEW_ROWS, _FEW_LETTERS = 16, 100  # largest table that leaves room for another one next to it
MAX_ROWS = 60  # of frames and exposures; longer tables are only in files


class Level(str):
    """Outcome of a check as a cell: 'pass', 'warn', 'fail', or 'note'."""

    __slots__ = ()


@dataclass(frozen=True)
class TextTable:
    """A table of text."""

    caption: str
    columns: tuple[str, ...]  # headings with units; empty for a list of names and values
    rows: tuple[tuple[str, ...], ...]  # a cell may be a `Level`
    words: tuple[int, ...] = (0,)  # columns with text; the others are numbers
    note: str = ""  # text below the table
    detail: bool = False  # True if it is not printed
    on_paper: tuple[int, ...] = ()  # columns that are printed; empty for all
    leading: int = 0  # number of rows that are printed; 0 for all
    stacked: tuple[int, ...] = ()  # first columns of a row's block on a narrow screen; empty: none
    grouped: bool = False  # True if the first column is a heading for groups of rows
    folded: bool = False  # True if it is shown only when a reader opens it
    number: int = 0  # table number; 0 if tables are not numbered

    @property
    def of_checks(self) -> bool:
        """True if rows are outcomes of checks."""
        return any(isinstance(cell, Level) for row in self.rows for cell in row)

    @property
    def groups(self) -> tuple[tuple[str, tuple[tuple[str, ...], ...]], ...]:
        """Rows grouped by their heading, without it; a single group '' if not grouped."""
        if not self.grouped:
            return (("", self.rows),)
        by_heading = groupby(self.rows, key=lambda row: row[0])
        return tuple((name, tuple(row[1:] for row in rows)) for name, rows in by_heading)

    @property
    def open(self) -> TextTable:
        """The rows of checks that fail or warn."""
        return replace(self, rows=tuple(row for row in self.rows if _is_open(row)))

    @property
    def passed(self) -> TextTable:
        """The rows of checks that pass, and notes."""
        rows = tuple(row for row in self.rows if not _is_open(row))
        named = "Criteria that pass, and notes" if self.n_notes else "Criteria that pass"
        return replace(self, caption=named, rows=rows)

    @property
    def n_passed(self) -> int:
        """Number of checks that pass."""
        return sum(Level("pass") in row for row in self.rows)

    @property
    def n_notes(self) -> int:
        """Number of notes, which require no action."""
        return sum(Level("note") in row for row in self.rows)

    @property
    def is_long(self) -> bool:
        """True if the table is so long that it is folded on screen."""
        return len(self.rows) > _FEW_ROWS and not self.of_checks and not self.leading

    @property
    def is_small(self) -> bool:
        """True if another table fits next to it on paper."""
        rows = self.rows[: self.leading or None]
        widths = (max(map(len, column)) for column in zip(self.columns, *rows, strict=True))
        return len(rows) <= _FEW_ROWS and sum(widths) <= _FEW_LETTERS


def _is_open(row: Sequence[str]) -> bool:
    """True for a check that fails or warns."""
    return Level("warn") in row or Level("fail") in row


def tabulated(caption: str, rows: Sequence[Mapping[str, str]], **look: Any) -> TextTable:
    """Table from rows that map headings to cells; `look` are further fields of `TextTable`."""
    columns = tuple(rows[0]) if rows else ()
    return TextTable(caption, columns, tuple(tuple(row.values()) for row in rows), **look)


def listing(
    caption: str,
    pairs: Mapping[str, str],
    note: str = "",
    *,
    detail: bool = False,
    leading: int = 0,
) -> TextTable:
    """List of names and values."""
    rows = tuple(pairs.items())
    words = (0, 1)
    return TextTable(caption, ("", ""), rows, words, note, detail=detail, leading=leading)


def check_cells(check: Check) -> tuple[str, str, Level]:
    """Value, limit and outcome of a check as table cells."""
    value = check.value if isinstance(check.value, str) else number(check.value)
    return value or check.text, check.limit or MISSING, Level(check.level)


def further(n: int) -> str:
    """Text on the number of rows that are only in files; empty if the page shows all n rows."""
    return "" if n <= MAX_ROWS else f"{n - MAX_ROWS} more rows are in the run's tables."


def moment(time: object) -> str:
    """Readable UTC time from a time in ISO 8601."""
    return str(time).replace("T", " ").replace("+00:00", " UTC")


def short_paths(paths: Iterable[str]) -> list[str]:
    """Paths without the folder that is common to all of them, which is recorded in run.json."""
    parsed = [PurePath(p) for p in paths]
    depth = min((len(p.parts) - 1 for p in parsed), default=0)
    shared = next((k for k in range(depth) if len({p.parts[k] for p in parsed}) > 1), depth)
    return [str(PurePath(*p.parts[shared:])) for p in parsed]
