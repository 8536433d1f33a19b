"""Matches as objects of other packages: astropy QTable, Arrow stream, and HTML."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from html import escape
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.columns import COLUMNS, MatchColumns, column_unit
from bayesdist.data.tables.column import check_unit, conversion
from bayesdist.files.parquet import HEADER, arrow_array

if TYPE_CHECKING:
    import pyarrow
    from astropy.table import QTable

_LEFT_OUT = frozenset(("source",))  # the header lists the files


def table_of(matches: MatchColumns) -> QTable:
    """QTable of matches in memory, with units and with names instead of codes.

    Columns that the matches do not have are omitted, and so is a filter column without names. The
    tangent point, match radius, counts and notes are in ``meta["bayesdist"]``.
    """
    from astropy import units as apu
    from astropy.table import QTable

    table = QTable()
    for name, values in _plain_columns(matches).items():
        unit = column_unit(name, matches.unit)
        labels = _labels(matches, name)
        if labels is not None:
            values = labels[values]
        table[name] = values if unit is None else values * apu.Unit(unit)
    table.meta[HEADER] = {
        "sources": list(matches.sources),
        "n_rows": matches.n_rows,
        "rejected": dict(matches.rejected),
        "notes": list(matches.notes),
    } | geometry_header(matches)
    return table


class GeometryHeader(TypedDict, total=False):
    """Geometry of matches in the header of a table."""

    tangent_point: list[float]  # right ascension and declination, degrees
    match_radius: float
    unit: str  # of the match radius


class GeometryArguments(TypedDict, total=False):
    """Arguments of `Matches` from a `GeometryHeader`."""

    tangent_point: tuple[float, float]  # right ascension and declination, degrees
    match_radius: float  # in the unit of u and v


def geometry_header(matches: MatchColumns) -> GeometryHeader:
    """Tangent point and match radius (with its unit) of matches, if they have them."""
    header: GeometryHeader = {}
    if matches.tangent_point is not None:
        header["tangent_point"] = list(matches.tangent_point)
    if matches.match_radius is not None:
        header["match_radius"], header["unit"] = matches.match_radius, matches.unit
    return header


def header_arguments(header: Mapping[str, Any], unit: str, *, source: str) -> GeometryArguments:
    """Arguments of `Matches` from the header of a table that has a `geometry_header`.

    `unit` is that of u and v, to which the match radius is converted.  The result is empty for a
    table written by another program.
    """
    stated = header.get(HEADER)
    if not isinstance(stated, Mapping):
        return {}
    out: GeometryArguments = {}
    point, radius = stated.get("tangent_point"), stated.get("match_radius")
    if isinstance(point, list | tuple) and len(point) == 2:
        out["tangent_point"] = (float(point[0]), float(point[1]))
    if isinstance(radius, int | float) and radius > 0:
        unit_of_radius = str(stated.get("unit", unit))
        check_unit(unit_of_radius, where=source)
        out["match_radius"] = float(radius) * conversion(unit_of_radius, unit, where=source)
    return out


def arrow_stream(
    matches: MatchColumns, batches: Iterable[MatchColumns], columns: Iterable[str]
) -> pyarrow.RecordBatchReader:
    """Arrow stream of matches, batch by batch.

    Parameters
    ----------
    matches : MatchColumns
        Matches with the labels of all batches.
    batches : iterable of MatchColumns
        Batches in memory, which are read one after another.
    columns : iterable of str
        Columns that all batches have.

    Returns
    -------
    pyarrow.RecordBatchReader
        Columns as in `table_of`, with units as metadata of the fields. Names of exposures, filters
        and chips are dictionary-encoded.
    """
    import pyarrow

    columns = set(columns)
    names = [name for name in COLUMNS if name in columns and _is_told(matches, name)]
    fields = []
    for name in names:
        labels, unit = _labels(matches, name), column_unit(name, matches.unit)
        kind = pyarrow.float64() if unit is not None else pyarrow.int64()
        if labels is not None and labels.dtype.kind == "U":
            kind = pyarrow.dictionary(pyarrow.int32(), pyarrow.string())
        elif name in ("mag", "colour", "epoch"):
            kind = pyarrow.float64()
        metadata = None if unit is None else {"unit": unit}
        fields.append(pyarrow.field(name, kind, nullable=False, metadata=metadata))
    header = json.dumps(geometry_header(matches))
    schema = pyarrow.schema(fields, metadata={HEADER: header})

    def made() -> Iterable[pyarrow.RecordBatch]:
        for batch in batches:
            arrays = [_arrow_column(batch, name) for name in names]
            yield pyarrow.RecordBatch.from_arrays(arrays, schema=schema)

    return pyarrow.RecordBatchReader.from_batches(schema, made())


def _arrow_column(matches: MatchColumns, name: str) -> pyarrow.Array:
    import pyarrow

    values, labels = np.asarray(getattr(matches, name)), _labels(matches, name)
    if labels is None:
        return arrow_array(values)
    if labels.dtype.kind != "U":
        return arrow_array(labels[values])
    codes = arrow_array(values.astype(np.int32))
    return pyarrow.DictionaryArray.from_arrays(codes, arrow_array(labels))


def html_of(n: int, facts: Iterable[tuple[str, str]]) -> str:
    """Short HTML table with the number of matches and further facts."""
    rows = "".join(
        f"<tr><th style='text-align:left'>{escape(key)}</th>"
        f"<td style='text-align:left'>{escape(value)}</td></tr>"
        for key, value in facts
    )
    return f"<table><caption><b>{n:,} matches</b></caption>{rows}</table>"


def _plain_columns(matches: MatchColumns) -> dict[str, NDArray[Any]]:
    """Columns that the matches have and that are included in tables."""
    return {
        name: np.asarray(values)
        for name in COLUMNS
        if _is_told(matches, name) and (values := getattr(matches, name)) is not None
    }


def _is_told(matches: MatchColumns, name: str) -> bool:
    """False for columns without information: codes of files, and a filter without a name."""
    if name in _LEFT_OUT:
        return False
    return name != "filter" or matches.filter_names != ("",)


def _labels(matches: MatchColumns, name: str) -> NDArray[Any] | None:
    """Names or numbers of the codes of a column; None for a column without codes."""
    if name == "exposure":
        return np.array(matches.exposure_names)
    if name == "filter":
        return np.array(matches.filter_names)
    if name == "chip":
        return np.array(matches.chip_names or matches.chip_numbers)
    return None
