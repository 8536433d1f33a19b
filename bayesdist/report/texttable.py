"""Tables of text, ready to be set on a page."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import groupby
from pathlib import PurePath

__all__ = ["MAX_ROWS", "Level", "TextTable", "further", "listing", "short_paths"]

_FEW_ROWS, _FEW_LETTERS = 16, 100  # of a table that leaves room beside it
MAX_ROWS = 60  # of frames and exposures; hundreds of them belong in the files


class Level(str):
    """A cell that says how a check came out: 'pass', 'warn', 'fail', or 'note'."""

    __slots__ = ()


@dataclass(frozen=True)
class TextTable:
    """A table of text.

    Parameters
    ----------
    caption : str
    columns : tuple of str
        Headings, with units; empty strings for a plain list of names and values.
    rows : tuple of tuple of str
        A cell may be a `Level`.
    words : tuple of int
        Columns that hold words; the others hold numbers.
    note : str
        Below the table.
    detail : bool
        Whether the page leaves the table out when it is printed.
    on_paper : tuple of int
        Columns that are printed; all of them where it is empty.
    leading : int
        Rows that are printed, the first so many; 0 for all of them.
    stacked : tuple of int
        Columns that stand first where a narrow screen shows each row as a block; where it is empty
        the table stays one.  Tables of checks are always shown so.
    grouped : bool
        Whether the first column is the heading of the rows that share it.
    """

    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    words: tuple[int, ...] = (0,)
    note: str = ""
    detail: bool = False
    on_paper: tuple[int, ...] = ()
    leading: int = 0
    stacked: tuple[int, ...] = ()
    grouped: bool = False

    @property
    def of_checks(self) -> bool:
        """Whether rows say how checks came out."""
        return any(isinstance(cell, Level) for row in self.rows for cell in row)

    @property
    def groups(self) -> tuple[tuple[str, tuple[tuple[str, ...], ...]], ...]:
        """Rows by the heading that they share, without it; under '' where there is none."""
        if not self.grouped:
            return (("", self.rows),)
        by_heading = groupby(self.rows, key=lambda row: row[0])
        return tuple((name, tuple(row[1:] for row in rows)) for name, rows in by_heading)

    @property
    def is_small(self) -> bool:
        """Whether another table has room beside it on paper."""
        rows = self.rows[: self.leading or None]
        widths = (max(map(len, column)) for column in zip(self.columns, *rows, strict=True))
        return len(rows) <= _FEW_ROWS and sum(widths) <= _FEW_LETTERS


def listing(
    caption: str,
    pairs: Mapping[str, str],
    note: str = "",
    *,
    detail: bool = False,
    leading: int = 0,
) -> TextTable:
    """A plain list of names and values."""
    rows = tuple(pairs.items())
    words = (0, 1)
    return TextTable(caption, ("", ""), rows, words, note, detail=detail, leading=leading)


def further(n: int) -> str:
    """How many of n rows the page leaves to the files; empty where it shows all."""
    return "" if n <= MAX_ROWS else f"{n - MAX_ROWS} more rows are in the run's tables."


def short_paths(paths: Iterable[str]) -> list[str]:
    """Paths without the folder that all of them are in, which is in run.json."""
    every = [PurePath(p) for p in paths]
    most = min((len(p.parts) - 1 for p in every), default=0)
    shared = next((k for k in range(most) if len({p.parts[k] for p in every}) > 1), most)
    return [str(PurePath(*p.parts[shared:])) for p in every]
