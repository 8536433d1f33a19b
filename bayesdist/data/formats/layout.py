"""Interpretation of the columns of a table, which can be shown and saved before it is read."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesdist.data.formats.files import input_files, kind_of
from bayesdist.data.reading.columns import lacking_columns, present_columns
from bayesdist.data.reading.table import own_epoch, with_sky_columns
from bayesdist.data.tables.column import Columns
from bayesdist.data.tables.names import origin_of
from bayesdist.data.tables.parquet import describe_part
from bayesdist.errors import InputError
from bayesdist.files.tables import read_table

PathLike = str | os.PathLike[str]

MAX_ROWS_READ = 200_000  # rows of a large table that are read to interpret its columns
MAX_CHIPS = 200
MIN_ROWS_ON_CHIP = 20  # rows; flags and qualities often have rarer values


@dataclass(frozen=True)
class TableLayout:
    """Columns of a table, and their interpretation."""

    names: tuple[str, ...]  # all columns
    taken: dict[str, str]  # column of each quantity that is read
    origin: int  # coordinate of the first pixel, from column names and header
    why: str  # reason for the origin; empty if there is none
    like_chips: dict[str, int]  # number of distinct values in unused columns that may hold chips
    dated: bool  # True if the header has the date of the exposure
    spans: dict[str, tuple[float, float]]  # smallest and largest value of unused numeric columns

    @property
    def lacking(self) -> list[str]:
        """Quantities that matches need and that have no recognised column."""
        return lacking_columns(self.taken)


def table_layout(
    path: PathLike | Sequence[PathLike],
    columns: Mapping[str, str] | None = None,
    *,
    read_sigma: bool = True,
) -> TableLayout | None:
    """Layout of a file of matches, or of the first of several; None for files with fixed columns.

    Arguments and errors are as for `read_matches`, except that columns may be missing. `read_sigma`
    is True if columns of errors are read.
    """
    file = input_files(path)[0]
    if kind_of(file, columns) != "table":
        return None
    if file.suffix.lower() == ".parquet":
        part = describe_part(file)
        if not part.n_rows:
            raise InputError("holds no rows", where=str(file), do="give a table with stars")
        table: Columns = next(part.blocks(part.colnames, size=MAX_ROWS_READ))
        header: Mapping[str, Any] = {}
    else:
        full_table = with_sky_columns(read_table(file))
        table, header = full_table, full_table.meta
    names = tuple(table.colnames)
    taken = present_columns(names, columns, source=str(file), read_sigma=read_sigma)
    origin, why = origin_of(taken.get("x", ""), names, header)
    unused = {name: table[name] for name in names if name not in taken.values()}
    return TableLayout(
        names,
        taken,
        origin,
        why,
        {name: n for name, column in unused.items() if (n := _values_like_chips(column))},
        own_epoch(header) is not None,
        {name: span for name, column in unused.items() if (span := _span(column)) is not None},
    )


def _span(column: Any) -> tuple[float, float] | None:
    """Smallest and largest value of a numeric column; None for other columns."""
    values = np.ma.compressed(np.ma.asarray(getattr(column, "value", column)))
    if values.dtype.kind not in "iuf":
        return None
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if finite.size else None


def _values_like_chips(column: Any) -> int:
    """Number of distinct values if they may be chips, otherwise 0."""
    values = np.asarray(getattr(column, "unmasked", column))
    if values.ndim != 1 or values.dtype.kind not in "iuSU" or getattr(column, "unit", None):
        return 0
    unique, counts = np.unique(values, return_counts=True)
    if not 2 <= len(unique) <= MAX_CHIPS or counts.min() < MIN_ROWS_ON_CHIP:
        return 0
    return len(unique)
