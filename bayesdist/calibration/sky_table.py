"""Conversion of tables of pixels to sky positions with a calibration."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
from astropy import units
from astropy.table import QTable, Table

from bayesdist.calibration.apply import on_chip
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.sky_positions import sky_positions
from bayesdist.data.reading.table import as_table
from bayesdist.data.tables.column import unit_of
from bayesdist.data.tables.names import ALIASES, find_columns, origin_of
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.quantities import Direction, Epoch, direction_in, year_of

log = logging.getLogger("bayesdist")

COLUMNS = ("ra", "dec", "sigma_ra", "sigma_dec", "corr_ra_dec")
COVARIANCE = "covariance"  # metadata key of the joint covariance in a table


def table_on_sky(
    calibration: Calibration,
    table: Any,
    *,
    columns: Sequence[str] | None = None,
    centroids: Sequence[str] | None = None,
    pixel_origin: float | None = None,
    chip: int | None = None,
    epoch: Epoch | None = None,
    point: Direction | None = None,
    covariance: bool = False,
    name: str = "table",
) -> QTable:
    """Convert a table of pixels to sky positions; see `Calibration.to_sky`.

    `name` is the name of the table in messages.
    """
    rows = QTable(as_table(table, name))
    plain = Table(rows)
    x, y, origin, _ = pixel_columns(plain, columns, pixel_origin, name)
    sigma = None
    if centroids is not None:
        sigma_x, sigma_y = (position_column(plain, c, name) for c in centroids)
        sigma = sigma_x, sigma_y
    numbers = chip_numbers(plain, chip, list(calibration.numbers), calibration.name, name)
    year = None if epoch is None else year_of(epoch)
    at = sky_positions(
        calibration,
        x,
        y,
        numbers,
        epoch=year,
        point=None if point is None else direction_in(point, "point"),
        centroids=sigma,
        joint=covariance,
    )
    new = COLUMNS if at.sigma is not None else COLUMNS[:2]
    refuse_columns(rows, new, name)
    rows["ra"], rows["dec"] = at.ra * units.deg, at.dec * units.deg
    if at.cov is not None and at.sigma is not None:
        east, north = at.sigma
        rows["sigma_ra"], rows["sigma_dec"] = east * units.mas, north * units.mas
        product = east * north
        rows["corr_ra_dec"] = np.divide(
            at.cov[:, 0, 1], product, out=np.zeros_like(product), where=product > 0
        )
    outside = sum(
        int((~on_chip(m, x[numbers == n], y[numbers == n]) & np.isfinite(x[numbers == n])).sum())
        for n, m in calibration.at(year).items()
    )
    rows.meta = {
        "calibration": calibration.name,
        "errors": [error for error, _ in errors_in(calibration, centroids)],
        "outside": outside,
        "pixel_origin": origin,
    }
    if at.joint is not None:
        rows.meta[COVARIANCE] = at.joint
    return rows


def errors_in(calibration: Calibration, centroids: Sequence[str] | None) -> list[tuple[str, str]]:
    """Errors included in the sky positions, as pairs (name, correlation between stars in words).

    `centroids` are the names of the columns with centroid errors, if there are any.
    """
    out = []
    if calibration.errors == "covariance":
        out.append(("coefficients, with their covariance", "correlated between stars"))
    elif calibration.errors == "sigma":
        out.append(("coefficients, without their correlations", "correlated between stars"))
    for row in calibration.further:
        shared = "the same for all stars" if row.shared else "independent for each star"
        if row.correlation:
            low, high = (f(length for _, length in row.correlation) for f in (min, max))
            over = f"{low:.0f}" if low == high else f"{low:.0f} to {high:.0f}"
            shared = f"correlated between stars over {over} pixels"
        out.append((row.name, shared))
    if centroids is not None:
        out.append(("centroids", "independent for each star"))
    return out


def position_column(table: Table, name: str, where: str) -> Float:
    """Numbers (N,) of a column, NaN if missing; raises InputError if the column is unsuitable."""
    if name not in table.colnames:
        raise InputError(
            f"there is no column {name!r}",
            where=where,
            do="give the columns of the positions (columns in Python, --columns on the command "
            f"line), among {', '.join(table.colnames[:8])}",
        )
    column = table[name]
    if column.dtype.kind not in "iuf" or column.ndim != 1:
        raise InputError(
            "does not contain numbers", where=f"{where}, column {name!r}", do="check the column"
        )
    values: Float = np.ma.filled(np.ma.asarray(column).astype(float), np.nan)
    lost = ~np.isfinite(values)
    if lost.any():
        n = np.count_nonzero(lost)
        log.warning("%s: WARNING: column %r has no finite value in %d rows", where, name, n)
    return np.where(lost, np.nan, values)


def pixel_columns(
    table: Table, names: Sequence[str] | None, pixel_origin: float | None, where: str
) -> tuple[Float, Float, float, str]:
    """FITS 1-based pixels x and y (N,), the pixel origin of the columns, and its reason.

    If `names` is None, the columns are found by their usual names, as in tables of matches.  The
    origin is `pixel_origin` if it is given.  Otherwise it is that of the program that writes such
    columns, or 1 if the program is unknown.  Raises InputError if a column has a unit other than
    the pixel.
    """
    if names is None:
        names = usual_pixel_names(table.colnames, where)
    for name in names:
        unit = (
            unit_of(table[name], where=f"{where}, column {name!r}")
            if name in table.colnames
            else None
        )
        if unit is not None and unit != units.pix:
            raise InputError(
                f"unit is {unit}, but detector positions are in pix",
                where=f"{where}, column {name!r}",
                do="name the columns of raw pixels",
            )
    x, y = (position_column(table, name, where) for name in names)
    if pixel_origin is not None:
        origin, reason = float(pixel_origin), "as given"
    else:
        origin, reason = origin_of(names[0], table.colnames, table.meta)
    return x + (1.0 - origin), y + (1.0 - origin), origin, reason or "as in FITS"


def usual_pixel_names(names: Sequence[str], where: str) -> tuple[str, str]:
    """Names of the columns with x and y that are recognised in `names`; default ("x", "y")."""
    usual = {key: ALIASES[key] for key in ("x", "y")}
    column_of = find_columns(names, None, usual, source=where, pairs=(("x", "y"),))
    return (column_of["x"], column_of["y"]) if len(column_of) == 2 else ("x", "y")


def chip_numbers(
    table: Table, chip: int | None, known: Sequence[int], name: str, where: str
) -> Int:
    """Chip number (N,) of each row, from an option or a column.

    `known` are the chip numbers of the calibration; `name` and `where` are the names of the
    calibration and of the table for messages.  Raises InputError if a chip is unknown, or the
    column is needed but missing.
    """
    listed = ", ".join(map(str, known))
    if chip is not None:
        if chip not in known:
            raise InputError(f"there is no chip {chip}", where=name, do=f"choose one of {listed}")
        return np.full(len(table), chip)
    if len(known) == 1:
        return np.full(len(table), known[0])
    if "chip" not in table.colnames:
        raise InputError(
            f"there is no column 'chip', but {name} has chips {listed}",
            where=where,
            do="add the column, or give the chip (--chip on the command line)",
        )
    numbers = position_column(table, "chip", where)
    strange = np.flatnonzero(~np.isin(numbers, known))
    if strange.size:
        k = int(strange[0])
        raise InputError(
            f"there is no chip {numbers[k]:g}",
            where=f"{where}, row {k + 1}, column 'chip'",
            do=f"{name} has {listed}",
        )
    return numbers.astype(np.int64)


def refuse_columns(table: Table, new: Sequence[str], where: str) -> None:
    """Raise InputError if a table already has one of the new columns."""
    existing = [name for name in new if name in table.colnames]
    if existing:
        raise InputError(
            f"has a column {existing[0]!r} already, which would be overwritten",
            where=where,
            do="rename or remove it",
        )
