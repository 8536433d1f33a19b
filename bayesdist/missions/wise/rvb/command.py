"""`bayesdist wise rvb`: transform the reference positions of RvB pairs, all or frame by frame."""

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
    """Read the solutions of the frames of one band, for `rereference`.

    Parameters
    ----------
    path : path-like
        Table with one row per frame and columns for the frame and for one or more of `PARAMETERS`;
        missing parameters are zero.  Scales are given minus 1, and the rotation is in radians
        unless the column has a unit.
    centre : tuple of float
        Centre of rotation and scales, pixels.

    Returns
    -------
    dict of str to RvbTransform
        Solutions by frame.

    Raises
    ------
    InputError
        If the table has no column of frames or of parameters, a frame occurs twice, or the unit of
        the rotation is not an angle.
    """
    file = Path(path)
    table = read_table(file)
    column_of = find_columns(table.colnames, None, SOLUTION_ALIASES, source=str(file))
    parameter_names = [name for name in PARAMETERS if name in column_of]
    if "frame" not in column_of or not parameter_names:
        missing = "frames" if "frame" not in column_of else "parameters"
        raise InputError(
            f"no column of {missing} among {', '.join(table.colnames)}",
            where=str(file),
            do="rename the columns",
        )
    codes, names = SourceColumn(table[column_of["frame"]], str(file), column_of["frame"]).labels()
    first = np.unique(codes, return_index=True)[1]
    if len(first) < len(codes):
        repeated = int(np.setdiff1d(np.arange(len(codes)), first)[0])
        raise InputError(
            f"frame {names[codes[repeated]]!r} occurs twice",
            where=f"{file}, row {repeated + 1}",
            do="give the solutions of one band, with one row per frame",
        )
    values = np.zeros((len(codes), len(PARAMETERS)))
    for name in parameter_names:
        column = SourceColumn(table[column_of[name]], str(file), column_of[name])
        numbers = column.numbers()
        if name in ("rotation", "skew") and column.unit is not None:
            numbers = numbers * _radians(column)
        values[:, PARAMETERS.index(name)] = numbers
    return {
        names[code]: replace(RvbTransform(*row.tolist()), centre=centre)
        for code, row in zip(codes, values, strict=True)
    }


def _radians(column: SourceColumn) -> float:
    """Radians per unit of a column."""
    unit = column.unit
    try:
        return 1.0 if unit is None else float(unit.to("rad"))
    except ValueError:
        raise InputError(
            f"unit {unit} is not an angle", where=column.where, do="give rad or deg"
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
    """Apply one transformation to all reference positions; returns text to print.

    With `fit` the five parameters are fitted such that the reference positions agree with the
    detections.  The pairs are written to a new folder.
    """
    transform = RvbTransform(dx, dy, radians(rotation), scale_x, scale_y)
    if (transform == RvbTransform()) != fit:
        raise InputError(
            "a transformation is given, but --fit is set" if fit else "no transformation is given",
            where="bayesdist wise rvb transform",
            do="give --fit, or --dx, --dy, --rotation, --scale-x or --scale-y",
        )
    columns = columns or {}
    band = _band(files, band, columns)
    fit_text = ""
    if fit:
        pieces = stream_rvb(files, band=band, columns=columns)
        best = fit_transform(
            reduce(
                add, (linear_moments(pairs.matches, WISE_ARRAYS[band].centre) for pairs in pieces)
            )
        )
        transform, fit_text = best.transform, f"\n{best.sentence}"
    else:
        transform = replace(transform, centre=WISE_ARRAYS[band].centre)
    written = _written(
        files, output, band, columns, lambda matches: transformed(matches, transform)
    )
    return written + fit_text


def rereference_files(
    files: Sequence[str | Path],
    output: str | Path,
    *,
    free: str | Path,
    fixed: str | Path,
    band: str | None,
    columns: Mapping[str, str] | None,
) -> str:
    """Transform pairs from the frame solutions `free` to `fixed`; returns text to print."""
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
                "is inside the input folder",
                where=str(output),
                do="choose a folder outside of it",
            )

    def moved() -> Iterator[RvbPairs]:
        for pairs in stream_rvb(files, band=band, columns=columns):
            yield replace(pairs, matches=move(pairs.matches))

    n = write_rvb(moved(), output)
    return f"{output}: {n} pairs of {band}; calibrate them with data.format = 'rvb'"
