"""What a table is to the page: text that is ready to be set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from bayesdist.report.context import ReportInput
from bayesdist.report.numerals import MISSING

__all__ = ["MOST_ROWS", "TextTable", "further", "listing", "marked"]

MOST_ROWS = 60  # of frames and exposures; hundreds of them belong in the files


@dataclass(frozen=True)
class TextTable:
    """A table of text.

    Parameters
    ----------
    caption : str
    columns : tuple of str
        Headings, with units; empty strings for a plain list of names and values.
    rows : tuple of tuple of str
    words : tuple of int
        Columns that hold words; the others hold numbers.
    note : str
        Below the table.
    detail : bool
        Whether the page leaves the table out when it is printed.
    """

    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    words: tuple[int, ...] = (0,)
    note: str = ""
    detail: bool = False


def marked(inputs: ReportInput, text: str) -> str:
    """A number that rests on the sampler, with a dagger where that did not converge."""
    return f"{text}\u202f†" if inputs.provisional and text != MISSING else text


def listing(
    caption: str, pairs: Mapping[str, str], note: str = "", *, detail: bool = False
) -> TextTable:
    """A plain list of names and values."""
    rows = tuple(pairs.items())
    return TextTable(caption, ("", ""), rows, words=(0, 1), note=note, detail=detail)


def further(n: int) -> str:
    """How many of n rows the page leaves to the files; empty where it shows all."""
    return "" if n <= MOST_ROWS else f"{n - MOST_ROWS} more rows are in the run's tables."
