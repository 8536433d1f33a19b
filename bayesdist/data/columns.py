"""From the columns of any table to a MatchTable."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bayesdist.data.matches import MatchTable
from bayesdist.data.naming import find_columns
from bayesdist.data.tangent import mean_direction, tangent_plane
from bayesdist.data.units import check_unit, conversion
from bayesdist.data.values import Place, SourceColumn, row_number
from bayesdist.errors import InputError

__all__ = [
    "ALIASES",
    "Columns",
    "match_columns",
    "matches_from_table",
    "needed_columns",
    "nominal_columns",
    "plane_unit",
    "position_unit",
    "sky_columns",
    "sky_positions",
]

Float = NDArray[np.float64]

# lower case; the first that the file has is taken
ALIASES: dict[str, tuple[str, ...]] = {
    "x": ("x", "x_pix", "xpix", "x_raw", "x_image"),
    "y": ("y", "y_pix", "ypix", "y_raw", "y_image"),
    "u": ("u",),
    "v": ("v",),
    "ra": ("ra",),
    "dec": ("dec",),
    "sigma_u": ("sigma_u", "su", "sig_u", "u_error", "u_err", "u_sigma", "e_u", "err_u", "sigma"),
    "sigma_v": ("sigma_v", "sv", "sig_v", "v_error", "v_err", "v_sigma", "e_v", "err_v", "sigma"),
    "epoch": ("epoch", "year"),
    "exposure": ("exposure", "exp", "frame", "exposure_name"),
    "chip": ("chip", "ccdchip", "ccd_chip"),
    "filter": ("filter", "filt", "filter_name"),
    "mag": ("mag", "magnitude"),
    "colour": ("colour", "color"),
    "star": ("star",),
    "u_nominal": ("u_nominal",),
    "v_nominal": ("v_nominal",),
}


def position_unit(pair: tuple[SourceColumn, SourceColumn], unit: str | None) -> str:
    """Unit of a pair of position columns, from the file or else from the option.

    Parameters
    ----------
    pair : tuple of SourceColumn
    unit : str or None
        What the user says.

    Returns
    -------
    str
        'pix', 'arcsec', 'mas' or 'deg'.

    Raises
    ------
    InputError
        Where both say nothing, where they contradict each other, or where the two columns do.
    """
    if unit is not None:
        check_unit(unit, where="unit")
    stated: list[str | None] = []
    for column in pair:
        own = column.unit
        stated.append(None if own is None else check_unit(str(own), where=column.where))
    first, second = stated
    if first is not None and second is not None and first != second:
        raise InputError(
            f"unit is {second}, but {first} in column {pair[0].name!r}",
            where=pair[1].where,
            do="give both columns one unit",
        )
    own_unit = first or second
    if own_unit is None and unit is None:
        raise InputError(
            "has no unit",
            where=pair[0].where,
            do="set the unit option to pix, arcsec, mas or deg, or write the unit into the file",
        )
    if own_unit is not None and unit is not None and own_unit != unit:
        raise InputError(
            f"unit is {own_unit} in the file, but {unit} in the options",
            where=pair[0].where,
            do="correct one of the two",
        )
    return own_unit or unit or ""


class Columns(Protocol):
    """Named columns of one length, as an astropy Table has them."""

    @property
    def colnames(self) -> Sequence[str]:
        """Names."""

    def __len__(self) -> int:
        """Rows."""

    def __getitem__(self, name: str) -> Any:
        """What `SourceColumn` takes."""


@dataclass(frozen=True, eq=False)
class _Quantities:
    """The columns of a table by what they are."""

    table: Columns
    found: Mapping[str, str]
    source: str
    place: Place

    def __getitem__(self, key: str) -> SourceColumn:
        name = self.found[key]
        return SourceColumn(self.table[name], self.source, name, self.place)


def _as_table(data: Any, source: str) -> Table:
    if isinstance(data, Table):
        return data
    try:
        return Table(dict(data))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"columns do not make a table ({error})", where=source, do="give columns of one length"
        ) from error


def _degrees(column: SourceColumn) -> Float:
    unit = column.unit
    factor = 1.0 if unit is None else conversion(unit, "deg", where=column.where)
    return column.numbers() * factor


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
    table = _as_table(data, source)
    found = find_columns(table.colnames, columns, ALIASES, source=source)
    if not _on_sky(found, columns, source):
        return None
    return sky_columns(table, found, source=source)


def sky_columns(
    table: Columns, found: Mapping[str, str], *, source: str, place: Place = row_number
) -> tuple[Float, Float]:
    """Right ascension and declination of some rows of a table.

    Parameters
    ----------
    table, found, source, place
        As `match_columns`.

    Returns
    -------
    tuple of ndarray, shape (N,)
        Degrees.
    """
    return _sky(_Quantities(table, found, source, place))


def _sky(quantities: _Quantities) -> tuple[Float, Float]:
    ra, dec = (_degrees(quantities[key]) for key in ("ra", "dec"))
    beyond = np.abs(dec) > 90.0
    if beyond.any():
        bad = int(np.argmax(beyond))
        raise quantities["dec"].fail(bad, f"declination is {dec[bad]:g} degrees")
    return ra, dec


def _on_sky(found: Mapping[str, str], columns: Mapping[str, str] | None, source: str) -> bool:
    """Whether ra, dec are the reference positions, not u, v."""
    named = {key for key, column in (columns or {}).items() if column}
    plane, sky = named & {"u", "v"}, named & {"ra", "dec"}
    if plane and sky:
        raise InputError(
            "columns names both u, v and ra, dec", where=source, do="name one of the two pairs"
        )
    if plane or ({"u", "v"} <= set(found) and not sky):
        return False
    return {"ra", "dec"} <= set(found)


def matches_from_table(
    data: Any,
    columns: Mapping[str, str] | None = None,
    *,
    source: str = "table",
    unit: str | None = None,
    read_sigma: bool = True,
    pixel_origin: int = 1,
    tangent_point: tuple[float, float] | None = None,
    exposure_name: str | None = None,
) -> MatchTable:
    """MatchTable from a table's columns.

    Parameters
    ----------
    data : astropy Table or mapping of arrays
    columns : mapping of str to str, optional
        Column of each quantity: x y u v ra dec sigma_u sigma_v epoch exposure chip filter mag
        colour star u_nominal v_nominal.  What is not named is looked for under its usual names
        (`ALIASES`), in any case of letters; an empty name leaves a quantity out.  With ra and dec,
        u and v are the tangent plane in arcsec.
    source : str, optional
        File, for errors.
    unit : str, optional
        Unit of u and v, where the table does not say.
    read_sigma : bool, optional
        Whether the columns of errors are read.
    pixel_origin : {0, 1}, optional
        Coordinate of the centre of the first pixel.
    tangent_point : tuple of float, optional
        RA and Dec in degrees; by default the mean direction of the stars.
    exposure_name : str, optional
        Name of the one exposure, where the table has no column of them.

    Returns
    -------
    MatchTable

    Raises
    ------
    InputError
        For a missing column, text or missing values among numbers, units that are missing or
        contradict each other, no rows, and all that `MatchTable` refuses.
    """
    table = _as_table(data, source)
    found = needed_columns(table.colnames, columns, source=source, read_sigma=read_sigma)
    if len(table) == 0:
        raise InputError("holds no rows", where=source, do="give a table with matched stars")
    out = match_columns(
        table,
        found,
        source=source,
        unit=unit,
        pixel_origin=pixel_origin,
        tangent_point=tangent_point,
    )
    if exposure_name is not None:
        out.setdefault("exposure_names", (exposure_name,))
    return MatchTable(**out, sources=(source,))


def needed_columns(
    names: Iterable[str],
    columns: Mapping[str, str] | None,
    *,
    source: str,
    read_sigma: bool = True,
) -> dict[str, str]:
    """Column of each quantity that is read from a table.

    Parameters
    ----------
    names : iterable of str
        Columns of the table.
    columns, source, read_sigma
        As `matches_from_table`.

    Returns
    -------
    dict of str to str
        With either u and v or ra and dec.

    Raises
    ------
    InputError
        For a missing column.
    """
    names = list(names)
    found = find_columns(names, columns, ALIASES, source=source)
    on_sky = _on_sky(found, columns, source)
    for key in ("x", "y") if on_sky else ("x", "y", "u", "v"):
        if key not in found:
            raise InputError(
                f"no column for {key!r} among {', '.join(names) or 'none'}",
                where=source,
                do="name it in the option 'columns'",
            )
    unread = {"u", "v"} if on_sky else {"ra", "dec"}
    if not read_sigma:
        unread |= {"sigma_u", "sigma_v"}
    return {key: name for key, name in found.items() if key not in unread}


def match_columns(
    table: Columns,
    found: Mapping[str, str],
    *,
    source: str,
    unit: str | None = None,
    pixel_origin: int = 1,
    tangent_point: tuple[float, float] | None = None,
    place: Place = row_number,
) -> dict[str, Any]:
    """What a MatchTable is made of, from some rows of a table.

    Parameters
    ----------
    table : astropy Table, or what has columns like one
    found : mapping of str to str
        Column of each quantity, as `needed_columns` gives it.
    source, unit, pixel_origin, tangent_point
        As `matches_from_table`.
    place : callable, optional
        Name of a row, by its index.

    Returns
    -------
    dict
        Arguments of `MatchTable`: the columns, their labels, unit and tangent point.

    Raises
    ------
    InputError
        As `matches_from_table`.
    """
    quantities = _Quantities(table, found, source, place)
    column = quantities.__getitem__
    out: dict[str, Any] = {}
    out["x"], out["y"] = (_pixels(column(key), pixel_origin) for key in ("x", "y"))
    if "ra" in found:
        out |= _projected(quantities, unit, tangent_point)
    else:
        if tangent_point is not None:
            raise InputError(
                "a tangent point is given, but the reference positions are u, v",
                where=source,
                do="name the columns ra and dec, or leave the tangent point out",
            )
        out["u"], out["v"] = (column(key).numbers() for key in ("u", "v"))
        out["unit"] = position_unit((column("u"), column("v")), unit)
    for key in ("sigma_u", "sigma_v"):
        if key in found:
            out[key] = _sigma(column(key), out["unit"])
    if nominal := nominal_columns(found, source=source, tangent_point=tangent_point):
        for key in nominal:
            out[key] = _in_unit(column(key), out["unit"])
    if "epoch" in found:
        out["epoch"] = column("epoch").years()
    if "mag" in found:
        out["mag"] = column("mag").numbers()
    if "colour" in found:
        # colours serve a test alone: where stars have none, the table is read without
        with contextlib.suppress(InputError):
            out["colour"] = column("colour").numbers()
    if "exposure" in found:
        out["exposure"], out["exposure_names"] = column("exposure").labels()
    if "filter" in found:
        out["filter"], out["filter_names"] = column("filter").labels()
    if "star" in found:
        out["star"] = column("star").integers()
    if "chip" in found:
        numbers, out["chip"] = np.unique(column("chip").integers(), return_inverse=True)
        out["chip_numbers"] = tuple(numbers.tolist())
    return out


def _pixels(column: SourceColumn, pixel_origin: int) -> Float:
    """FITS 1-based pixels."""
    if pixel_origin not in (0, 1):
        raise InputError(
            f"pixel_origin is {pixel_origin}", where=column.source, do="set it to 0 or 1"
        )
    if column.unit is not None and str(column.unit) != "pix":
        raise InputError(
            f"unit is {column.unit}, and detector positions are in pix",
            where=column.where,
            do="name the columns of raw pixels",
        )
    return column.numbers() + (1 - pixel_origin)


def _projected(
    quantities: _Quantities, unit: str | None, tangent_point: tuple[float, float] | None
) -> dict[str, Any]:
    """u, v on the tangent plane."""
    unit = plane_unit(unit, source=quantities.source)
    sky = _sky(quantities)
    point = mean_direction(*sky) if tangent_point is None else tangent_point
    u, v = tangent_plane(*sky, point, where=quantities.source, place=quantities.place)
    return {"u": u, "v": v, "unit": unit, "tangent_point": (float(point[0]), float(point[1]))}


def plane_unit(unit: str | None, *, source: str) -> str:
    """Unit of u and v that come from the sky; an option that says another is refused."""
    if unit not in (None, "arcsec"):
        raise InputError(
            f"unit is {unit}, but sky positions come to the tangent plane in arcsec",
            where=source,
            do="set the unit to arcsec or leave it out",
        )
    return "arcsec"


def nominal_columns(
    found: Mapping[str, str], *, source: str, tangent_point: tuple[float, float] | None
) -> tuple[str, ...]:
    """'u_nominal' and 'v_nominal' where a table has them, else nothing.

    Parameters
    ----------
    found, source, tangent_point
        As of `match_columns`.

    Raises
    ------
    InputError
        For one without the other; beside sky positions, where no tangent point is given: the plane
        on which they lie is not to depend on which stars were matched.
    """
    keys = tuple(key for key in ("u_nominal", "v_nominal") if key in found)
    if len(keys) == 1:
        missing = "v_nominal" if keys[0] == "u_nominal" else "u_nominal"
        raise InputError(
            f"column {missing!r} is missing beside its partner",
            where=source,
            do="give nominal positions in both axes or in none",
        )
    if keys and "ra" in found and tangent_point is None:
        raise InputError(
            "nominal positions stand beside ra and dec, and the tangent point of their plane is "
            "not given",
            where=source,
            do="set data.tangent_point to that of the nominal positions",
        )
    return keys


def _in_unit(column: SourceColumn, unit: str) -> Float:
    """Numbers in the unit of u, v."""
    own = column.unit
    return column.numbers() * (1.0 if own is None else conversion(own, unit, where=column.where))


def _sigma(column: SourceColumn, unit: str) -> Float:
    """Standard errors in the unit of u, v."""
    sigma = _in_unit(column, unit)
    good = sigma > 0
    if not good.all():
        bad = int(np.argmin(good))
        raise column.fail(bad, f"sigma is {sigma[bad]:g}, and must be positive")
    return sigma
