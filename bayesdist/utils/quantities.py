"""Conversion of arguments from users into plain numbers, and type checks of arguments.

Quantities, dates, directions and seeds are converted.  The decorator `takes` checks the types of
the arguments of public functions.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import date
from functools import wraps
from inspect import signature
from typing import TYPE_CHECKING, Any, ParamSpec, TypeAlias, TypeVar, Union

import numpy as np

from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.time import Time
    from astropy.units import Quantity

__all__ = [
    "Direction",
    "Epoch",
    "Number",
    "Random",
    "direction_in",
    "generator_of",
    "unit_name",
    "value_in",
    "values_in",
    "whole_number",
    "year_of",
]
Number: TypeAlias = Union[float, "Quantity"]
Epoch: TypeAlias = Union[float, str, date, "Time", "Quantity"]
Direction: TypeAlias = Union[tuple[float, float], "SkyCoord", tuple["Quantity", "Quantity"]]
Random: TypeAlias = int | np.random.Generator
YEARS = (1800.0, 2200.0)  # decimal years; epochs outside are in another unit or not dates
LARGEST_RA = 720.0  # degrees; some programs continue beyond 360 in a field around zero
UNITS = ("pix", "arcsec", "mas", "deg")
_OF_A_SOLUTION = "Posterior or LinearFit"  # what users have of the abstract class
_OF_A_TABLE = "; bayesdist.Matches.from_table makes it of a table"
P = ParamSpec("P")
R = TypeVar("R")


def value_in(value: Number, unit: str, what: str, *, where: str = "") -> float:
    """Convert a number or a Quantity to a unit.

    Parameters
    ----------
    value : float or astropy.units.Quantity
        Plain numbers are taken to be in `unit`.
    unit : str
        Unit of the result, in the notation of astropy.
    what : str
        Name of the argument, for the error message.
    where : str, optional
        File or key, for the error message.

    Returns
    -------
    float

    Raises
    ------
    InputError
        If the Quantity cannot be converted to `unit`, or holds more than one value.

    Examples
    --------
    >>> import astropy.units as u
    >>> value_in(0.5 * u.arcsec, "mas", "match_radius"), value_in(3, "mas", "match_radius")
    (500.0, 3.0)
    """
    values = values_in(value, unit, what, where=where)
    if values.ndim:
        raise InputError(
            f"{what} has {values.size} values", where=where, do=f"give one number in {unit}"
        )
    return float(values)


def values_in(values: Any, unit: str, what: str, *, where: str = "") -> Float:
    """Convert numbers or a Quantity to a unit, as an array; see `value_in`."""
    if hasattr(values, "to_value"):
        import astropy.units as apu

        try:
            return np.asarray(values.to_value(apu.Unit(unit)), float)
        except apu.UnitConversionError:
            given_unit = str(values.unit) or "no unit"
            raise InputError(
                f"{what} is given in {given_unit}, which cannot be converted to {unit}",
                where=where,
                do=scale_advice(given_unit, unit, what) or f"give {what} in {unit}",
            ) from None
    if isinstance(values, tuple | list) and any(hasattr(item, "to_value") for item in values):
        return np.array([value_in(item, unit, what, where=where) for item in values])
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError):
        raise InputError(
            f"{what} is {values!r}, which is not a number",
            where=where,
            do=f"give a number in {unit}, or a Quantity",
        ) from None


def scale_advice(given: str, unit: str, what: str) -> str:
    """Advice on converting `what`, if it has the unit `given` where `unit` is required.

    The result is empty unless one of the units is the pixel and the other one is an angle.
    """
    angles = ("arcsec", "mas", "deg")
    if given == "pix" and unit in angles:
        return f"multiply {what} by the size of a pixel in {unit}"
    if given in angles and unit == "pix":
        return f"divide {what} by the size of a pixel"
    return ""


def whole_number(value: Any, what: str, *, least: int, where: str = "") -> int:
    """Convert to an integer of at least `least`; raises InputError for any other value."""
    if isinstance(value, int | np.integer) and not isinstance(value, bool) and value >= least:
        return int(value)
    raise InputError(
        f"{what} is {value!r}", where=where, do=f"give a whole number of {least} or more"
    )


def unit_name(value: Any, what: str, *, where: str = "") -> str | None:
    """Unit of a Quantity as 'pix', 'arcsec', 'mas' or 'deg'; None for a plain number.

    The result is 'mas' for any other angular unit.  Raises InputError if the unit is neither an
    angle nor the pixel.
    """
    if not hasattr(value, "to_value"):
        return None
    name = str(value.unit)
    if name in UNITS:
        return name
    values_in(value, "mas", what, where=where)
    return "mas"


def year_of(epoch: Epoch, what: str = "epoch", *, where: str = "") -> float:
    """Convert a date to a decimal year.

    Parameters
    ----------
    epoch : float, str, datetime.date, astropy.time.Time or astropy.units.Quantity
        A decimal year; a string with a decimal year or an ISO date; a date; a time; a Quantity in
        years; or a Quantity in days, which is taken as a Modified Julian Date.
    what, where : str, optional
        See `value_in`.

    Returns
    -------
    float

    Raises
    ------
    InputError
        If `epoch` is not a date between 1800 and 2200.

    Examples
    --------
    >>> year_of(2016.5), year_of("2016-01-01")
    (2016.5, 2016.0)
    """
    year = _year(epoch)
    if year is None:
        raise InputError(
            f"{what} is {epoch!r}, which is not a date",
            where=where,
            do="give a decimal year, an ISO date or an astropy Time",
        )
    if not YEARS[0] <= year <= YEARS[1]:
        raise InputError(
            f"{what} is {year:g}, which is not a year from 1800 to 2200",
            where=where,
            do="give a decimal year, an ISO date or an astropy Time",
        )
    return year


def _year(epoch: Any) -> float | None:
    """Decimal year without a range check; None if `epoch` is not a date."""
    if isinstance(epoch, str):
        try:
            return float(epoch)
        except ValueError:
            pass
    elif not isinstance(epoch, date | np.datetime64) and not hasattr(epoch, "unit"):
        if hasattr(epoch, "decimalyear"):
            return None if np.ndim(epoch) else float(epoch.decimalyear)
        try:
            return float(epoch)
        except (TypeError, ValueError):
            return None
    import astropy.units as apu
    from astropy.time import Time

    try:
        if hasattr(epoch, "unit"):
            if epoch.unit != apu.d:
                return float(epoch.to_value(apu.yr))
            return float(Time(epoch.value, format="mjd", scale="tt").decimalyear)
        # TT has no leap seconds, so that no date is shifted
        return float(Time(np.datetime64(epoch) if isinstance(epoch, date) else epoch,
                          scale="tt").decimalyear)  # fmt: skip
    except (TypeError, ValueError, apu.UnitsError):
        return None


def direction_in(point: Direction, what: str, *, where: str = "") -> tuple[float, float]:
    """Convert a direction to ICRS right ascension and declination in degrees.

    Parameters
    ----------
    point : SkyCoord, or pair of float or Quantity
        Right ascension and declination; plain numbers are in degrees.  A SkyCoord in another frame
        is transformed to ICRS.
    what, where : str, optional
        See `value_in`.

    Returns
    -------
    ra, dec : float
        Degrees.

    Raises
    ------
    InputError
        If `point` is not a single direction.

    Examples
    --------
    >>> import astropy.units as u
    >>> direction_in((1 * u.hourangle, -30), "tangent_point")
    (15.0, -30.0)
    """
    do = "give a SkyCoord of one direction, or right ascension and declination in degrees"
    icrs = getattr(point, "icrs", None)
    if icrs is not None:
        if icrs.shape:
            raise InputError(f"{what} has {icrs.size} directions", where=where, do=do)
        return float(icrs.ra.deg), float(icrs.dec.deg)
    try:
        ra, dec = point
    except (TypeError, ValueError):
        raise InputError(
            f"{what} is {point!r}, which is not a direction", where=where, do=do
        ) from None
    ra, dec = (value_in(coordinate, "deg", what, where=where) for coordinate in (ra, dec))
    if not (abs(ra) <= LARGEST_RA and abs(dec) <= 90.0):
        raise InputError(
            f"{what} is ({ra:g}, {dec:g}), which is not a direction", where=where, do=do
        )
    return ra, dec


def generator_of(rng: Random) -> np.random.Generator:
    """Random generator from a seed; a generator is returned unchanged.

    Parameters
    ----------
    rng : int or numpy.random.Generator
        Seed, 0 or larger, or a generator.

    Returns
    -------
    numpy.random.Generator

    Raises
    ------
    InputError
        If `rng` is neither a seed nor a generator.

    Examples
    --------
    >>> import numpy as np
    >>> generator_of(1).normal() == np.random.default_rng(1).normal()
    True
    """
    if isinstance(rng, np.random.Generator):
        return rng
    if isinstance(rng, int | np.integer) and not isinstance(rng, bool) and rng >= 0:
        return np.random.default_rng(int(rng))
    raise InputError(
        f"rng is {rng!r}, which is neither a seed nor a generator",
        do="give an integer of at least 0, or numpy.random.default_rng(seed)",
    )


def takes(**kinds: type | tuple[type, ...]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator that checks the types of arguments at each call.

    Parameters
    ----------
    **kinds : type or tuple of type
        Allowed types of the argument of that name.  Its default, such as None, is always allowed.

    Raises
    ------
    InputError
        Raised by the decorated function if an argument has another type.
    """

    def decorated(function: Callable[P, R]) -> Callable[P, R]:
        parameters = signature(function)

        @wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            arguments = parameters.bind(*args, **kwargs).arguments
            for name, kind in kinds.items():
                value = arguments.get(name, parameters.parameters[name].default)
                if value is parameters.parameters[name].default or isinstance(value, kind):
                    continue
                allowed = kind if isinstance(kind, tuple) else (kind,)
                raise InputError(
                    f"{name} is a {type(value).__name__}",
                    where=function.__name__,
                    do=f"give a {' or '.join(map(_name_of, allowed))}"
                    + (_OF_A_TABLE if allowed[0].__name__ == "Matches" else ""),
                )
            return function(*args, **kwargs)

        return checked

    return decorated


def _name_of(kind: type) -> str:
    """Name of a type in messages."""
    return _OF_A_SOLUTION if kind.__name__ == "Solution" else kind.__name__
