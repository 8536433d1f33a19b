"""`matches_from_table`: a MatchTable of whatever has columns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import Table
from astropy.time import Time
from numpy.typing import NDArray

from bayesdist.data.matches import MatchTable
from bayesdist.data.reading.columns import is_on_sky, match_columns, needed_columns
from bayesdist.data.sky.positions import MOTIONS, SPARED, sky_columns
from bayesdist.data.tables.checks import absent, check_not_finite, without_missing
from bayesdist.data.tables.column import row_number
from bayesdist.data.tables.names import ALIASES, PAIRS, find_columns, origin_of
from bayesdist.data.tables.quantities import Quantities
from bayesdist.errors import InputError

__all__ = ["as_table", "matches_from_table", "own_epoch", "sky_positions", "with_sky_columns"]

Float = NDArray[np.float64]

_SPARED = frozenset((*SPARED, "colour", "flux"))  # read for what they are worth


def as_table(data: Any, source: str) -> Table:
    """An astropy Table of whatever has columns."""
    if isinstance(data, Table):
        return data
    try:
        if hasattr(data, "to_parquet"):  # a DataFrame, whose NaN are missing values
            return Table.from_pandas(data)
        return Table(dict(data))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"columns do not make a table ({error})", where=source, do="give columns of one length"
        ) from error


def sky_positions(
    data: Any, columns: Mapping[str, str] | None = None, *, source: str = "table"
) -> tuple[Float, Float] | None:
    """Right ascension and declination, where the reference positions of a table are on the sky.

    Parameters
    ----------
    data, columns, source
        As `matches_from_table`.

    Returns
    -------
    tuple of ndarray, shape (N,), or None
        Degrees; None where u and v are columns of the table.
    """
    table = with_sky_columns(as_table(data, source))
    found = find_columns(table.colnames, columns, ALIASES, source=source, pairs=PAIRS)
    if not is_on_sky(table.colnames, found, columns, source):
        return None
    stay = ~(
        absent(table[found["ra"]], not_finite=True) | absent(table[found["dec"]], not_finite=True)
    )
    table = table if stay.all() else table[stay]
    return sky_columns(Quantities(table, found, source))


def with_sky_columns(table: Table) -> Table:
    """A table whose SkyCoord columns are columns of ra and dec, in degrees.

    Parameters
    ----------
    table : astropy Table

    Returns
    -------
    astropy Table
        The table itself where it has no such column; `skycoord` becomes `skycoord.ra`,
        `skycoord.dec` (ICRS).
    """
    coordinates = [name for name in table.colnames if isinstance(table[name], SkyCoord)]
    if not coordinates:
        return table
    out = table.copy(copy_data=False)
    for name in coordinates:
        sky = table[name].icrs
        out[f"{name}.ra"], out[f"{name}.dec"] = sky.ra.deg, sky.dec.deg
        out.remove_column(name)
    return out


def matches_from_table(
    data: Any,
    columns: Mapping[str, str] | None = None,
    *,
    source: str = "table",
    unit: str | None = None,
    read_sigma: bool = True,
    pixel_origin: int | None = None,
    tangent_point: tuple[float, float] | None = None,
    exposure_name: str | None = None,
    epoch: float | str | None = None,
    catalogue_epoch: float | None = None,
    chips: Mapping[str, int] | None = None,
    not_finite: str = "refuse",
) -> MatchTable:
    """MatchTable from a table's columns.

    Parameters
    ----------
    data : astropy Table or QTable, pandas DataFrame, or mapping of arrays
    columns : mapping of str to str, optional
        Column of each quantity: x y u v ra dec sigma_u sigma_v epoch exposure chip filter mag flux
        colour star u_nominal v_nominal, and beside ra and dec sigma_ra sigma_dec pm_ra pm_dec
        sigma_pm_ra sigma_pm_dec corr_ra corr_dec parallax sigma_parallax catalogue_epoch.  What is
        not named is looked for under its usual names (`ALIASES`), in any case of letters; an empty
        name leaves a quantity out.  With ra and dec, u and v are the tangent plane in arcsec.
    source : str, optional
        File, for errors.
    unit : str, optional
        Unit of u and v, where the table does not say.
    read_sigma : bool, optional
        Whether the columns of errors are read.
    pixel_origin : {0, 1}, optional
        Coordinate of the centre of the first pixel; by default 1, or 0 where names or header are
        those of a program that counts from 0.
    tangent_point : tuple of float, optional
        RA and Dec in degrees; by default the mean direction of the stars.
    exposure_name : str, optional
        Name of the one exposure, where the table has no column of them.
    epoch : float or str, optional
        Decimal year or ISO date of all exposures, where the table has no column of it.  Reference
        positions with proper motions are brought to it.
    catalogue_epoch : float, optional
        Decimal year of the reference positions, where the table has no column of it.
    chips : mapping of str to int, optional
        Numbers of the chips, where the table has their names; by default from 1 in the order of the
        names.
    not_finite : {'refuse', 'reject'}, optional
        Rows with NaN or infinity are an error, or left out and counted.  Rows with missing (masked)
        values are always left out and counted, in `rejected`.

    Returns
    -------
    MatchTable

    Raises
    ------
    InputError
        For a missing column, text among numbers, values that are not finite, units that are missing
        or contradict each other, no rows, and all that `MatchTable` refuses.
    """
    check_not_finite(not_finite)
    table = with_sky_columns(as_table(data, source))
    found = needed_columns(table.colnames, columns, source=source, read_sigma=read_sigma)
    if len(table) == 0:
        raise InputError("holds no rows", where=source, do="give a table with matched stars")
    if epoch is None and "pm_ra" in found and "epoch" not in found:
        epoch = own_epoch(table.meta)
    dated = "catalogue_epoch" in found or catalogue_epoch is not None
    moves = "pm_ra" in found and dated and ("epoch" in found or epoch is not None)
    stay, rejected = without_missing(
        table,
        found,
        source=source,
        reject=not_finite == "reject",
        spared=_SPARED | (frozenset() if moves else frozenset(MOTIONS)),
        motions=frozenset(MOTIONS),
    )
    n, rows, place = len(table), np.flatnonzero(stay), row_number
    if rejected:
        table = table[stay]

        def place(index: int) -> str:
            return row_number(int(rows[index]))

    notes: tuple[str, ...] = ()
    if pixel_origin is None:
        pixel_origin, why = origin_of(found["x"], table.colnames, table.meta)
        notes = (f"the first pixel is taken as {pixel_origin}: {why}",) if why else ()
    out = match_columns(
        Quantities(table, found, source, place),
        unit=unit,
        pixel_origin=pixel_origin,
        tangent_point=tangent_point,
        epoch=epoch,
        catalogue_epoch=catalogue_epoch,
        chips=chips,
    )
    if exposure_name is not None:
        out.setdefault("exposure_names", (exposure_name,))
    out["notes"] = (*notes, *out.get("notes", ()))
    return MatchTable(**out, sources=(source,), row=rows, n_rows=n, rejected=rejected)


def own_epoch(header: Mapping[str, Any]) -> float | str | None:
    """Date of the exposure by its header: MJD-OBS as a decimal year, DATE-OBS as it stands."""
    upper = {str(key).upper(): value for key, value in header.items()}
    if isinstance(upper.get("MJD-OBS"), float):
        return float(Time(upper["MJD-OBS"], format="mjd", scale="tt").decimalyear)
    date = upper.get("DATE-OBS")
    return date if isinstance(date, str) and date.strip() else None
