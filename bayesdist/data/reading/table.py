"""Matches from any object with columns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from astropy.table import Column, Table
from astropy.time import Time

from bayesdist.data.matches import Matches
from bayesdist.data.reading.columns import columns_read, is_on_sky, match_columns
from bayesdist.data.reading.options import ReadOptions
from bayesdist.data.sky.positions import MOTIONS, SPARED, sky_columns
from bayesdist.data.tables.checks import absent, row_number, without_missing
from bayesdist.data.tables.column import Quantities
from bayesdist.data.tables.names import ALIASES, PAIRS, find_columns
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float

_MOTION = "mas / yr"
_SPARED = frozenset((*SPARED, "colour", "flux"))  # optional: a star may lack them


def _as_table(data: Any, source: str) -> Table:
    """Astropy Table from any object with columns."""
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
    table: Table, columns: Mapping[str, str] | None, *, source: str
) -> tuple[Float, Float] | None:
    """Degrees (N,) of ra and of dec where the reference positions are on the sky, else None."""
    table = with_sky_columns(table)
    found = find_columns(table.colnames, columns, ALIASES, source=source, pairs=PAIRS)
    if not is_on_sky(table.colnames, found, columns, source):
        return None
    stay = ~(
        absent(table[found["ra"]], not_finite=True) | absent(table[found["dec"]], not_finite=True)
    )
    table = table if stay.all() else table[stay]
    return sky_columns(Quantities(table, found, source))


def with_sky_columns(table: Table) -> Table:
    """Table whose SkyCoord columns are columns of ra and dec, in degrees.

    `skycoord` becomes `skycoord.ra`, `skycoord.dec` (ICRS), and its motions and the time of its
    positions `pmra`, `pmdec` and `ref_epoch`; without such it is the table itself.
    """
    others = [name for name in table.colnames if not isinstance(table[name], Column)]
    if not others:
        return table
    from astropy.coordinates import SkyCoord

    coordinates = [name for name in others if isinstance(table[name], SkyCoord)]
    if not coordinates:
        return table
    out = table.copy(copy_data=False)
    for name in coordinates:
        sky = table[name].icrs
        out[f"{name}.ra"], out[f"{name}.dec"] = sky.ra.deg, sky.dec.deg
        if "s" in sky.data.differentials and "pmra" not in out.colnames:
            out["pmra"] = sky.pm_ra_cosdec.to(_MOTION)
            out["pmdec"] = sky.pm_dec.to(_MOTION)
        if sky.obstime is not None and "ref_epoch" not in out.colnames:
            out["ref_epoch"] = np.broadcast_to(sky.obstime.jyear, len(out))
        out.remove_column(name)
    return out


def matches_from_table(
    data: Any,
    options: ReadOptions | None = None,
    *,
    source: str = "table",
    exposure_name: str | None = None,
) -> Matches:
    """Matches from a table's columns.

    Parameters
    ----------
    data : astropy Table or QTable, pandas DataFrame, or mapping of arrays
    options : ReadOptions, optional
    source : str, optional
        File, for errors.
    exposure_name : str, optional
        Name of the one exposure, where the table has no column of them.

    Returns
    -------
    Matches
        Without errors where these do not come from columns.

    Raises
    ------
    InputError
        For a missing column, text among numbers, values that are not finite, units that are missing
        or contradict each other, no rows, and all that `Matches` refuses.
    """
    options = options or ReadOptions()
    table = with_sky_columns(_as_table(data, source))
    found, options, notes = columns_read(table.colnames, table.meta, options, source=source)
    if len(table) == 0:
        raise InputError("holds no rows", where=source, do="give a table with matched stars")
    if options.epoch is None and "pm_ra" in found and "epoch" not in found:
        options = replace(options, epoch=own_epoch(table.meta))
    dated = "catalogue_epoch" in found or options.catalogue_epoch is not None
    moves = "pm_ra" in found and dated and ("epoch" in found or options.epoch is not None)
    stay, rejected = without_missing(
        table,
        found,
        source=source,
        reject=options.not_finite == "reject",
        spared=_SPARED | (frozenset() if moves else frozenset(MOTIONS)),
        motions=frozenset(MOTIONS),
    )
    n, rows, place = len(table), np.flatnonzero(stay), row_number
    if rejected:
        table = table[stay]

        def place(index: int) -> str:
            return row_number(int(rows[index]))

    out = match_columns(Quantities(table, found, source, place), options)
    if exposure_name is not None:
        out.setdefault("exposure_names", (exposure_name,))
    out["notes"] = (*notes, *out.get("notes", ()))
    return Matches(**out, sources=(source,), row=rows, n_rows=n, rejected=rejected)


def own_epoch(header: Mapping[str, Any]) -> float | str | None:
    """Date of the exposure by its header: MJD-OBS as a decimal year, DATE-OBS as it stands."""
    upper = {str(key).upper(): value for key, value in header.items()}
    if isinstance(upper.get("MJD-OBS"), float):
        return float(Time(upper["MJD-OBS"], format="mjd", scale="tt").decimalyear)
    date = upper.get("DATE-OBS")
    return date if isinstance(date, str) and date.strip() else None
