"""Tables of frame solutions: one linear transformation for each frame."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from bayesdist.data.tables.column import SourceColumn
from bayesdist.data.tables.names import find_columns
from bayesdist.errors import InputError
from bayesdist.missions.wise.pairs.files import RVB_ALIASES
from bayesdist.missions.wise.rvb.transform import PARAMETERS, RvbTransform
from bayesdist.reading.tables import read_table

__all__ = ["SOLUTION_ALIASES", "read_solutions"]

SOLUTION_ALIASES: dict[str, tuple[str, ...]] = {
    "frame": RVB_ALIASES["exposure"],
    **{name: (name,) for name in PARAMETERS},
}


def read_solutions(
    path: str | os.PathLike[str], *, centre: tuple[float, float]
) -> dict[str, RvbTransform]:
    """Solutions of the frames of one band, as `rereference` takes them.

    `path`: an IPAC table or any other that `read_matches` knows, with a row for each frame, the
    column frame, and some of shift_u shift_v rotation scale_u scale_v skew. `centre`: point about
    which the frames were solved: the centre of the array, FITS 1-based pixels. A parameter without
    a column is zero in all frames; scales are relative to one, the rotation in radians unless the
    column has a unit. InputError for a missing column of frames, no parameter at all, a frame that
    stands twice, and for what is no number.
    """
    file = Path(path)
    table = read_table(file)
    found = find_columns(table.colnames, None, SOLUTION_ALIASES, source=str(file))
    given = [name for name in PARAMETERS if name in found]
    if "frame" not in found or not given:
        missing = "frames" if "frame" not in found else "parameters"
        raise InputError(
            f"no column of {missing} among {', '.join(table.colnames)}",
            where=str(file),
            do="rename the columns",
        )
    codes, names = SourceColumn(table[found["frame"]], str(file), found["frame"]).labels()
    first = np.unique(codes, return_index=True)[1]
    if len(first) < len(codes):
        again = int(np.setdiff1d(np.arange(len(codes)), first)[0])
        raise InputError(
            f"frame {names[codes[again]]!r} stands twice",
            where=f"{file}, row {again + 1}",
            do="give the solutions of one band, with one row for each frame",
        )
    values = np.zeros((len(codes), len(PARAMETERS)))
    for name in given:
        column = SourceColumn(table[found[name]], str(file), found[name])
        numbers = column.numbers()
        if name in ("rotation", "skew") and column.unit is not None:
            numbers = numbers * _radians(column)
        values[:, PARAMETERS.index(name)] = numbers
    return {
        names[code]: replace(RvbTransform(*row.tolist()), centre=centre)
        for code, row in zip(codes, values, strict=True)
    }


def _radians(column: SourceColumn) -> float:
    """Radians in one of the column's unit."""
    unit = column.unit
    try:
        return 1.0 if unit is None else float(unit.to("rad"))
    except ValueError:
        raise InputError(
            f"unit {unit} is not one of angles", where=column.where, do="give rad or deg"
        ) from None
