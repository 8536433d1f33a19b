"""`bayesdist wise rvb`: RvB pairs with transformed reference positions, frame by frame or all."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from math import radians
from operator import add
from pathlib import Path

import numpy as np

from bayesdist.data import Matches
from bayesdist.data.tables.column import SourceColumn
from bayesdist.data.tables.names import find_columns
from bayesdist.errors import InputError
from bayesdist.files.tables import read_table
from bayesdist.missions.wise.pairs.files import RVB_ALIASES, open_rvb_files
from bayesdist.missions.wise.pairs.read import chosen_band, stream_rvb
from bayesdist.missions.wise.pairs.rvb_pairs import RvbPairs, write_rvb
from bayesdist.missions.wise.published import WISE_ARRAYS
from bayesdist.missions.wise.rvb.linear import fit_transform, linear_moments
from bayesdist.missions.wise.rvb.transform import PARAMETERS, RvbTransform, rereference, transformed

SOLUTION_ALIASES: dict[str, tuple[str, ...]] = {
    "frame": RVB_ALIASES["exposure"],
    **{name: (name,) for name in PARAMETERS},
}


def read_solutions(
    path: str | os.PathLike[str], *, centre: tuple[float, float]
) -> dict[str, RvbTransform]:
    """Solutions of the frames of one band, solved about a centre, as `rereference` takes them.

    A parameter without a column is zero in all frames; scales are relative to one, the rotation in
    radians unless the column has a unit.
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


def transform_files(
    files: Sequence[str | Path],
    output: str | Path,
    *,
    band: str | None,
    columns: Mapping[str, str] | None,
    dx: float,
    dy: float,
    rotation: float,
    scale_x: float,
    scale_y: float,
    fit: bool,
) -> str:
    """Text to print, once pairs with all reference positions moved alike are in a new folder.

    With `fit` the five parameters are those that bring reference positions to the detections.
    """
    transform = RvbTransform(dx, dy, radians(rotation), scale_x, scale_y)
    if (transform == RvbTransform()) != fit:
        raise InputError(
            "a transformation is given, and one is to be fitted"
            if fit
            else "no transformation is asked for",
            where="bayesdist wise rvb transform",
            do="give --fit, or --dx, --dy, --rotation, --scale-x or --scale-y",
        )
    columns = columns or {}
    band = _band(files, band, columns)
    found = ""
    if fit:
        pieces = stream_rvb(files, band=band, columns=columns)
        best = fit_transform(
            reduce(add, (linear_moments(one.matches, WISE_ARRAYS[band].centre) for one in pieces))
        )
        transform, found = best.transform, f"\n{best.sentence}"
    else:
        transform = replace(transform, centre=WISE_ARRAYS[band].centre)
    written = _written(
        files, output, band, columns, lambda matches: transformed(matches, transform)
    )
    return written + found


def rereference_files(
    files: Sequence[str | Path],
    output: str | Path,
    *,
    free: str | Path,
    fixed: str | Path,
    band: str | None,
    columns: Mapping[str, str] | None,
) -> str:
    """Text to print, once pairs are brought from the solutions `free` of their frames to others."""
    columns = columns or {}
    band = _band(files, band, columns)
    old, new = (read_solutions(path, centre=WISE_ARRAYS[band].centre) for path in (free, fixed))
    return _written(files, output, band, columns, lambda matches: rereference(matches, old, new))


def _band(files: Sequence[str | Path], band: str | None, columns: Mapping[str, str]) -> str:
    return chosen_band(open_rvb_files(files, columns), band)


def _written(
    files: Sequence[str | Path],
    output: str | Path,
    band: str,
    columns: Mapping[str, str],
    move: Callable[[Matches], Matches],
) -> str:
    for path in map(Path, files):
        if path.is_dir() and Path(output).resolve().is_relative_to(path.resolve()):
            raise InputError(
                "lies inside the folder of its input",
                where=str(output),
                do="choose a folder outside of it",
            )

    def moved() -> Iterator[RvbPairs]:
        for pairs in stream_rvb(files, band=band, columns=columns):
            yield replace(pairs, matches=move(pairs.matches))

    n = write_rvb(moved(), output)
    return f"{output}: {n} pairs of {band}; calibrate them with data.format = 'rvb'"
