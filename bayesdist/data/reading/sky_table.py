"""Table of detector positions with sky coordinates, under names that the readers recognise."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import QTable

from bayesdist.errors import InputError

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord

SKY_COLUMN = "skycoord"


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
    """Sky coordinates (N,) in ICRS, with proper motions and obstime if they have them."""
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
