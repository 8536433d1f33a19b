"""Logs of exposures, read and written."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Column, MaskedColumn, Table

from bayesdist.data.exposure_log import NUMBERS, Exposure, ExposureLog
from bayesdist.data.tables.column import SourceColumn
from bayesdist.data.tables.files import read_table
from bayesdist.data.tables.names import find_columns
from bayesdist.data.tables.units import conversion
from bayesdist.errors import InputError
from bayesdist.files import atomic_path

__all__ = [
    "Exposure",
    "ExposureLog",
    "read_exposures",
    "write_exposures",
]

_UNITS = {"epoch": "yr", "exptime": "s", "pa_v3": "deg", "ra": "deg", "dec": "deg"}
_FORMATS = {".ecsv": "ascii.ecsv", ".csv": "ascii.csv", ".fits": "fits"}
_ALIASES: dict[str, tuple[str, ...]] = {
    "exposure": ("exposure", "name", "rootname"),
    "epoch": ("epoch", "year", "date", "mjd", "expstart"),
    "filter": ("filter", "filt"),
    "exptime": ("exptime", "exposure_time"),
    "vafactor": ("vafactor",),
    "pa_v3": ("pa_v3",),
    "ra": ("ra", "ra_targ"),
    "dec": ("dec", "dec_targ"),
}


def read_exposures(
    path: str | os.PathLike[str], columns: Mapping[str, str] | None = None
) -> ExposureLog:
    """Read a log of exposures.

    Parameters
    ----------
    path : path-like
        .ecsv, .csv, .fits or .parquet, one row for each exposure.
    columns : mapping of str to str, optional
        Column of each quantity: exposure epoch filter exptime vafactor pa_v3 ra dec.  The epoch may
        be a decimal year, an ISO date, or a Modified Julian Date with the unit 'd'.  All but
        exposure and epoch may be missing, in single rows, too.

    Returns
    -------
    ExposureLog

    Raises
    ------
    InputError
        For missing columns and values that are wrong, naming the row.
    """
    path = Path(path)
    table = read_table(path)
    needed = ("exposure", "epoch")
    found = find_columns(table.colnames, columns, _ALIASES, source=str(path), needed=needed)
    if not len(table):
        raise InputError("holds no exposures", where=str(path), do="name at least one")

    def column(key: str) -> SourceColumn:
        return SourceColumn(table[found[key]], str(path), found[key])

    codes, labels = column("exposure").labels()
    rows: dict[str, list[Any]] = {
        "name": [labels[code] for code in codes],
        "epoch": column("epoch").years().tolist(),
    }
    if "filter" in found:
        rows["filter"] = _filled(column("filter"))
    for key in NUMBERS:
        if key in found:
            rows[key] = _known_numbers(column(key), _UNITS.get(key))
    exposures = []
    for k in range(len(table)):
        try:
            exposures.append(Exposure(**{key: values[k] for key, values in rows.items()}))
        except InputError as error:
            where = f"{path}, row {k + 1}, {error.where}".rstrip(", ")
            raise InputError(error.cause, where=where, do=error.do) from None
    return ExposureLog(tuple(exposures), source=str(path))


def _filled(column: SourceColumn) -> list[str]:
    """Texts of a column, empty where they are missing."""
    known, named = column.known()
    out = [""] * len(column.values)
    if len(known):
        codes, labels = named.labels()
        for row, code in zip(known, codes, strict=True):
            out[row] = labels[code]
    return out


def _known_numbers(column: SourceColumn, unit: str | None) -> list[float | None]:
    """Numbers of a column, None where they are missing."""
    numbers = column.known_numbers()
    own = column.unit
    if own is not None and unit is not None and not np.isnan(numbers).all():
        numbers = numbers * conversion(own, unit, where=column.where)
    return [None if np.isnan(value) else value for value in numbers.tolist()]


def write_exposures(log: ExposureLog, path: str | os.PathLike[str]) -> None:
    """Write a log as `read_exposures` reads it.

    Parameters
    ----------
    log : ExposureLog
    path : path-like
        .ecsv, .csv or .fits; replaced atomically.

    Raises
    ------
    InputError
        For another extension, or when the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in _FORMATS:
        raise InputError(
            f"extension {path.suffix!r} is not one of a log",
            where=str(path),
            do=f"choose one of {', '.join(_FORMATS)}",
        )
    table = Table()
    for one in fields(Exposure):
        values = [getattr(exposure, one.name) for exposure in log]
        if one.name in ("name", "filter"):
            table["exposure" if one.name == "name" else one.name] = Column(values, dtype=str)
            continue
        missing = [value is None for value in values]
        if not all(missing):
            numbers = [np.nan if value is None else value for value in values]
            column = MaskedColumn(numbers, mask=missing, unit=_UNITS.get(one.name))
            table[one.name] = column if any(missing) else Column(column)
    with atomic_path(path) as temporary:
        table.write(temporary, format=_FORMATS[path.suffix.lower()])
