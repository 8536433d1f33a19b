"""Conversion of tables to columns of Matches, and of arrays to a table that readers recognise.

A table may be any table-like object: an astropy, pandas or Arrow table, a mapping, or records.
`sky_table` makes a table of detector positions and sky coordinates under names that the readers
recognise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import Column, MaskedColumn, QTable, Table
from astropy.time import Time

from bayesdist.data.output import header_arguments
from bayesdist.data.reading.centroids import check_ellipses, with_variances
from bayesdist.data.reading.columns import are_moved, columns_read, is_on_sky, match_columns
from bayesdist.data.reading.motions import with_prior_motions
from bayesdist.data.reading.options import ReadOptions
from bayesdist.data.repeated import star_codes
from bayesdist.data.sky import MOTIONS, SPARED, sky_columns
from bayesdist.data.tables.checks import absent, row_number, without_missing
from bayesdist.data.tables.column import Quantities, length_in_mm, unit_of, without_unit
from bayesdist.data.tables.names import ALIASES, ASSUMED, PAIRS, find_columns
from bayesdist.errors import InputError
from bayesdist.files.fits import MISSING_EXTENSIONS
from bayesdist.files.parquet import arrow_table
from bayesdist.utils.arrays import Float

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord

# beginnings of error messages about values that `not_finite` can leave out
NOT_FINITE_CAUSES = ("value is nan", "value is inf", "value is -inf")
_MOTION = "mas / yr"
# optional quantities, which may have missing values
_SPARED = frozenset((*SPARED, "colour", "flux"))
_KINDS = (
    "an astropy Table or QTable, a pandas or polars DataFrame, an Arrow table, a mapping of arrays "
    "or a structured array"
)
SKY_COLUMN = "skycoord"


def is_table(data: Any) -> bool:
    """True for objects that `as_table` accepts."""
    return (
        isinstance(data, Table | Mapping)
        or _is_pandas(data)
        or hasattr(data, "__arrow_c_stream__")
        or (isinstance(data, np.ndarray) and data.dtype.names is not None)
    )


def _is_pandas(data: Any) -> bool:
    return hasattr(data, "iloc") and hasattr(data, "to_parquet")


def as_table(data: Any, source: str) -> Table:
    """Convert any object with columns to an astropy Table.

    Parameters
    ----------
    data : table
        An astropy Table or QTable; a pandas DataFrame, in which NaN is a missing value; any object
        with an Arrow stream (polars, pyarrow, DuckDB), in which nulls are missing values; a mapping
        of arrays or lists, in which None is a missing value; or a structured numpy array.
    source : str
        Name of the table, for error messages.

    Returns
    -------
    Table
        The object itself if it is an astropy Table; otherwise a table of views of its columns where
        possible.

    Raises
    ------
    InputError
        If it is not such an object, or if its columns have different lengths.
    """
    if isinstance(data, Table):
        return data
    if not is_table(data):
        file = isinstance(data, str) or hasattr(data, "__fspath__")
        raise InputError(
            f"is a {type(data).__name__}, which is no table",
            where=source,
            do="read files with read_matches" if file else f"give {_KINDS}",
        )
    try:
        if _is_pandas(data):
            return Table.from_pandas(data)
        if hasattr(data, "__arrow_c_stream__"):
            return arrow_table(data)
        if isinstance(data, Mapping):
            return Table({name: _without_none(column) for name, column in data.items()})
        return Table(data)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"columns do not make a table ({error})", where=source, do="give columns of one length"
        ) from error


def _without_none(column: Any) -> Any:
    """Column of a mapping; lists that contain None become masked columns."""
    if not isinstance(column, list | tuple) or not any(value is None for value in column):
        return column
    mask = [value is None for value in column]
    filling = next((value for value in column if value is not None), 0)
    return MaskedColumn([filling if gone else v for v, gone in zip(column, mask, strict=True)],
                        mask=mask)  # fmt: skip


def _through_plate_scale(
    table: Table, found: Mapping[str, str], options: ReadOptions, source: str
) -> tuple[Table, str]:
    """Table with positions and errors converted from lengths to arcsec, and a note about it."""
    if "u" not in found:
        raise InputError(
            "a plate scale is given, and the reference positions are on the sky",
            where=source,
            do="leave plate_scale out, or name the columns u and v",
        )
    table = table.copy(copy_data=False)
    stated = length_in_mm(options.unit)
    words = str(options.unit)
    for key in ("u", "v", "sigma_u", "sigma_v", "u_nominal", "v_nominal"):
        if key not in found:
            continue
        column = table[found[key]]
        unit = unit_of(column, where=f"{source}, column {found[key]!r}")
        factor = stated if unit is None else length_in_mm(unit)
        if factor is None and key not in ("u", "v") and unit is not None:
            continue  # an angle, which needs no conversion
        other = key in ("u", "v") and stated is not None and factor != stated
        if factor is None or other:
            raise InputError(
                f"a plate scale is given, and the unit is {unit or options.unit or 'not stated'}",
                where=f"{source}, column {found[key]!r}",
                do="state a length for u and v, as unit = 'mm', or leave plate_scale out",
            )
        if key == "u":
            stated, words = factor, str(unit or options.unit)
        values = factor * float(options.plate_scale or 0.0) * without_unit(column)
        table[found[key]] = MaskedColumn(values, unit="arcsec")
    return table, (
        f"u and v in {words} are taken to arcsec by the plate scale, {options.plate_scale:g} "
        "arcsec per mm"
    )


def sky_positions(
    table: Table, columns: Mapping[str, str] | None, *, source: str
) -> tuple[Float, Float] | None:
    """RA and Dec (n,) in degrees of the rows that have both; None if positions are u, v."""
    sky = catalogue_positions(table, columns, source=source)
    if sky is None:
        return None
    finite = np.isfinite(sky[0])
    return sky[0][finite], sky[1][finite]


def catalogue_positions(
    table: Table, columns: Mapping[str, str] | None, *, source: str
) -> tuple[Float, Float] | None:
    """RA and Dec (N,) in degrees as stored in a table, NaN in rows that lack one of them.

    The result is None if the reference positions are u, v.
    """
    table = with_sky_columns(table)
    column_names = find_columns(table.colnames, columns, ALIASES, source=source, pairs=PAIRS)
    if not is_on_sky(table.colnames, column_names, columns, source):
        return None
    stay = ~(
        absent(table[column_names["ra"]], not_finite=True)
        | absent(table[column_names["dec"]], not_finite=True)
    )
    out = np.full((2, len(table)), np.nan)
    if stay.any():
        out[:, stay] = sky_columns(
            Quantities(table if stay.all() else table[stay], column_names, source)
        )
    return out[0], out[1]


def with_sky_columns(table: Table) -> Table:
    """Table with SkyCoord columns replaced by columns of ra and dec in degrees.

    `skycoord` becomes `skycoord.ra`, `skycoord.dec` (ICRS); its motions and the time of its
    positions become `pmra`, `pmdec` and `ref_epoch`. A single SkyCoord column of any other name is
    also available as `skycoord`. Distances are not used. A table without such columns is returned
    unchanged.
    """
    mixin_names = [name for name in table.colnames if not isinstance(table[name], Column)]
    if not mixin_names:
        return table
    from astropy.coordinates import SkyCoord

    coordinates = [name for name in mixin_names if isinstance(table[name], SkyCoord)]
    if not coordinates:
        return table
    out = table.copy(copy_data=False)
    for name in coordinates:
        sky = table[name].icrs
        usual = len(coordinates) > 1 or f"{name}.ra".lower() in ALIASES["ra"]
        for title in (name,) if usual else (name, "skycoord"):
            out[f"{title}.ra"], out[f"{title}.dec"] = sky.ra.deg, sky.dec.deg
        if "s" in sky.data.differentials and "pmra" not in out.colnames:
            out["pmra"] = sky.pm_ra_cosdec.to(_MOTION)
            out["pmdec"] = sky.pm_dec.to(_MOTION)
        if sky.obstime is not None and "ref_epoch" not in out.colnames:
            out["ref_epoch"] = np.broadcast_to(sky.obstime.jyear, len(out))
        out.remove_column(name)
    return out


def match_arguments(
    data: Any,
    options: ReadOptions | None = None,
    *,
    source: str = "table",
    exposure_name: str | None = None,
    identify: bool = True,
) -> dict[str, Any]:
    """Arguments of `Matches` from the columns of a table.

    Parameters
    ----------
    data : table
        As for `as_table`.
    options : ReadOptions, optional
        Reading options.
    source : str, optional
        Name of the file, for error messages.
    exposure_name : str, optional
        Name of the single exposure, if the table has no column of exposures.
    identify : bool, optional
        True to recognise stars by equal reference positions if there is no column of stars. False
        for a part of the data, because the same stars may also be in other parts.

    Returns
    -------
    dict
        Arguments, without errors of the matches if these do not come from columns.

    Raises
    ------
    InputError
        If a column is missing, if a column of numbers contains text, if values are not finite, if
        units are missing or contradictory, or if there are no rows.
    """
    options = options or ReadOptions()
    original = with_sky_columns(as_table(data, source))
    table = with_variances(original)
    column_names, options, notes = columns_read(table.colnames, table.meta, options, source=source)
    check_ellipses(original, column_names, source)
    if MISSING_EXTENSIONS in table.meta:
        notes = (f"{source}: {table.meta[MISSING_EXTENSIONS]}", *notes)
    if len(table) == 0:
        raise InputError("holds no rows", where=source, do="give a table with matched stars")
    if options.plate_scale is not None:
        table, scaled = _through_plate_scale(table, column_names, options, source)
        options, notes = replace(options, unit="arcsec", plate_scale=None), (*notes, scaled)
    if options.epoch is None and "pm_ra" in column_names and "epoch" not in column_names:
        options = replace(options, epoch=own_epoch(table.meta))
    moves = are_moved(options, column_names, source)
    assumed = np.zeros(len(table), bool)
    if moves:
        filled = with_prior_motions(
            table,
            column_names,
            source=source,
            sigma_mas_yr=options.motion_prior,
            reject=options.not_finite == "reject",
        )
        table, notes, assumed = filled.table, (*notes, *filled.notes), filled.assumed
    rows_with_values = partial(
        without_missing,
        table,
        column_names,
        source=source,
        spared=_SPARED | (frozenset() if moves else frozenset(MOTIONS)),
        motions=frozenset(MOTIONS),
    )
    stay, rejected = rows_with_values(reject=options.not_finite == "reject")
    n, rows, place = len(table), np.flatnonzero(stay), row_number
    if rejected:
        table = table[stay]

        def place(index: int) -> str:
            return row_number(int(rows[index]))

    quantities = Quantities(table, column_names, source, place)
    try:
        out = match_columns(quantities, options)
    except InputError as error:
        if not error.cause.startswith(NOT_FINITE_CAUSES):
            raise
        n_lost = int((stay & ~rows_with_values(reject=True)[0]).sum())
        raise InputError(
            error.cause,
            where=error.where,
            do=f'correct such rows, or leave out {n_lost} of {n} with data.not_finite = "reject"',
        ) from error
    if assumed.any():
        out[ASSUMED] = (assumed[stay] | (out.get(ASSUMED, 0) != 0)).astype(np.int64)
    if identify and "star" not in out:
        # compare catalogue positions: proper motion moves a star differently in each exposure
        first, second = sky_columns(quantities) if "ra" in column_names else (out["u"], out["v"])
        star, note = star_codes(first, second, options.same_position)
        if star is not None:
            out |= {"star": star, "notes": (*out.get("notes", ()), note)}
    if "ra" not in column_names:
        out |= header_arguments(table.meta, out["unit"], source=source)
    if exposure_name is not None:
        out.setdefault("exposure_names", (exposure_name,))
    out["notes"] = (*notes, *out.get("notes", ()))
    return out | {"sources": (source,), "row": rows, "n_rows": n, "rejected": rejected}


def own_epoch(header: Mapping[str, Any]) -> float | str | None:
    """Date of the exposure from its header; None if the header has none.

    MJD-OBS is converted to a decimal year; DATE-OBS is returned unchanged.
    """
    upper = {str(key).upper(): value for key, value in header.items()}
    day = upper.get("MJD-OBS")
    if isinstance(day, int | float) and not isinstance(day, bool):
        return float(Time(day, format="mjd", scale="tt").decimalyear)
    date = upper.get("DATE-OBS")
    return date if isinstance(date, str) and date.strip() else None


def sky_table(x: Any, y: Any, sky: SkyCoord, *, sigma: Any, epoch: Any, **columns: Any) -> QTable:
    """Table of pixels (N,) and sky coordinates (N,), with the other columns given by keyword.

    `sigma` is one error, one per star, or a pair of these; plain numbers are in arcsec. `epoch`
    becomes a column if it has one value per star.
    """
    table = QTable({"x": _column(x, "x", None)})
    n = len(table)
    table["y"] = _column(y, "y", n)
    table[SKY_COLUMN] = icrs_of(sky, n)
    if sigma is not None:
        pair = sigma if isinstance(sigma, tuple) else (sigma, sigma)
        for name, values in zip(("sigma_u", "sigma_v"), pair, strict=True):
            table[name] = _column(values, name, n, broadcast=True)
    for name, values in columns.items():
        if values is not None:
            table[name] = _column(values, name, n)
    if epoch is not None and np.shape(epoch) == (n,):
        table["epoch"] = _column(epoch, "epoch", n)
    return table


def icrs_of(sky: Any, n: int | None, *, where: str = "sky") -> SkyCoord:
    """Sky coordinates (N,) in ICRS, with proper motions and obstime if they have them.

    Raises InputError if `sky` is not a SkyCoord of shape (n,), or cannot be transformed to ICRS.
    """
    from astropy.coordinates import ConvertError, SkyCoord

    if not isinstance(sky, SkyCoord):
        raise InputError(
            f"is a {type(sky).__name__}, not sky coordinates",
            where=where,
            do="give a SkyCoord, or a table with ra and dec by Matches.from_table",
        )
    if sky.ndim != 1 or (n is not None and sky.size != n):
        raise InputError(
            f"has the shape {sky.shape}" + ("" if n is None else f", and x has {n} values"),
            where=where,
            do="give one direction for each detection",
        )
    obstime = sky.obstime
    try:
        icrs = sky.icrs
    except (ConvertError, ValueError, TypeError) as error:
        raise InputError(
            f"cannot be transformed from {sky.name} to ICRS ({error})",
            where=where,
            do="give the frame what it needs, or coordinates in ICRS",
        ) from None
    if obstime is not None and icrs.obstime is None:
        icrs = SkyCoord(icrs, obstime=obstime)
    return icrs


def _column(values: Any, name: str, n: int | None, *, broadcast: bool = False) -> Any:
    """Column of n values, or of any number of values if n is None."""
    if not hasattr(values, "shape"):
        values = np.asarray(values)
    if broadcast and n is not None and values.shape == ():
        values = np.broadcast_to(values, (n,), subok=True)
    if len(values.shape) != 1 or (n is not None and len(values) != n):
        raise InputError(
            f"has the shape {values.shape}" + ("" if n is None else f", and x has {n} values"),
            where=name,
            do="give one value for each detection",
        )
    return values
