"""What the columns of a table are taken for, to be told and written down before it is read."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesdist.data.reading.columns import needed_columns
from bayesdist.data.reading.formats import input_files, kind_of
from bayesdist.data.reading.table import own_epoch, with_sky_columns
from bayesdist.data.tables.files import read_table
from bayesdist.data.tables.names import origin_of
from bayesdist.data.tables.parquet import describe_part
from bayesdist.data.tables.quantities import Columns

__all__ = ["TableLayout", "table_layout"]

PathLike = str | os.PathLike[str]

MAX_ROWS_READ = 200_000  # rows of a large table, for what its columns may be
MAX_CHIPS = 200
MIN_ROWS_ON_CHIP = 20  # rows: flags and qualities have values that are rare


@dataclass(frozen=True)
class TableLayout:
    """The columns of a table, and what they are taken for.

    Parameters
    ----------
    names : tuple of str
        All columns.
    taken : dict of str to str
        Column of each quantity that is read.
    origin : int
        Of the pixels, by names and header.
    why : str
        What says so; empty where nothing does.
    like_chips : dict of str to int
        Columns that nothing was taken from and that may be chips: a few whole numbers or names,
        and how many.
    dated : bool
        Whether the header has the date of the exposure.
    """

    names: tuple[str, ...]
    taken: dict[str, str]
    origin: int
    why: str
    like_chips: dict[str, int]
    dated: bool


def table_layout(
    path: PathLike | Sequence[PathLike],
    columns: Mapping[str, str] | None = None,
    *,
    read_sigma: bool = True,
) -> TableLayout | None:
    """What the columns of a file of matches are taken for; of several files, those of the first.

    Parameters
    ----------
    path, columns
        As `read_matches`.
    read_sigma : bool
        Whether columns of errors are read.

    Returns
    -------
    TableLayout or None
        None of files whose format fixes the columns.

    Raises
    ------
    InputError
        As `read_matches`.
    """
    file = input_files(path)[0]
    if kind_of(file, columns) != "table":
        return None
    if file.suffix.lower() == ".parquet":
        part = describe_part(file)
        table: Columns = next(part.blocks(part.colnames, size=MAX_ROWS_READ))
        header: Mapping[str, Any] = {}
    else:
        table = with_sky_columns(read_table(file))
        header = table.meta
    names = tuple(table.colnames)
    taken = needed_columns(names, columns, source=str(file), read_sigma=read_sigma)
    origin, why = origin_of(taken["x"], names, header)
    found = {name: _values_like_chips(table[name]) for name in names}
    return TableLayout(
        names,
        taken,
        origin,
        why,
        {k: n for k, n in found.items() if n and k not in taken.values()},
        own_epoch(header) is not None,
    )


def _values_like_chips(column: Any) -> int:
    """How many chips there are if these are chips; 0 where they can be none."""
    values = np.asarray(getattr(column, "unmasked", column))
    if values.ndim != 1 or values.dtype.kind not in "iuSU" or getattr(column, "unit", None):
        return 0
    unique, counts = np.unique(values, return_counts=True)
    if not 2 <= len(unique) <= MAX_CHIPS or counts.min() < MIN_ROWS_ON_CHIP:
        return 0
    return len(unique)
