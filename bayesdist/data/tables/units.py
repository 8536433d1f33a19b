"""Resolution of units on reading: every unit of u and v becomes one of `UNITS`, or an error."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from bayesdist.errors import InputError
from bayesdist.utils.quantities import scale_advice

if TYPE_CHECKING:
    import astropy.units as apu

UNITS = ("pix", "arcsec", "mas", "deg")

# spellings of other programs that astropy does not recognise
_SPELLINGS = {
    "pixels": "pix",
    "pixel": "pix",
    "px": "pix",
    "degrees": "deg",
    "degree": "deg",
    "arcseconds": "arcsec",
    "arcsecs": "arcsec",
    "milliarcsec": "mas",
    "none": "",
}


def check_unit(unit: str, *, where: str = "unit") -> str:
    """The unit itself if it is one of `UNITS`; otherwise raise InputError."""
    if unit not in UNITS:
        do = length_advice(unit) or f"choose one of {', '.join(UNITS)}"
        raise InputError(f"unit is {unit!r}", where=where, do=do)
    return unit


def length_advice(unit: str) -> str:
    """Advice on positions in a length unit, such as millimetres; empty for other units."""
    import astropy.units as apu  # takes a tenth of a second to import

    parsed = apu.Unit(unit.strip(), parse_strict="silent")
    if parsed.physical_type != "length":
        return ""
    return (
        "give plate_scale, the arcsec in a millimetre of u and v (data.plate_scale); or "
        f"divide u, v and their errors by the size of a pixel in {unit} and call them 'pix'"
    )


def length_in_mm(unit: apu.UnitBase | str | None) -> float | None:
    """Millimetres per unit of length; None for other units, and for None."""
    import astropy.units as apu

    if unit is None:
        return None
    parsed = apu.Unit(unit, parse_strict="silent")
    return float(parsed.to(apu.mm)) if parsed.physical_type == "length" else None


def unit_of(column: Any, *, where: str) -> apu.UnitBase | None:
    """Unit of a table column; None if it has none. InputError for an unknown unit."""
    unit = getattr(column, "unit", None)
    if unit is None:
        return None
    text = _SPELLINGS.get(str(unit).strip().lower(), str(unit).strip())
    if not text:
        return None
    import astropy.units as apu

    parsed = apu.Unit(text, parse_strict="silent")
    if isinstance(parsed, apu.UnrecognizedUnit):
        raise InputError(
            f"unit {text!r} is unknown", where=where, do=f"write one of {', '.join(UNITS)}"
        )
    return None if parsed == apu.dimensionless_unscaled else parsed


def conversion(unit: apu.UnitBase | str, to: str, *, where: str) -> float:
    """Factor from values in `unit` to values in `to`; InputError for incompatible units."""
    import astropy.units as apu

    try:
        return float(apu.Unit(unit).to(apu.Unit(to)))
    except apu.UnitConversionError:
        raise InputError(
            f"unit {unit} cannot be brought to {to}",
            where=where,
            do=scale_advice(str(unit), to, "the values")
            or length_advice(str(unit))
            or "correct the unit",
        ) from None


def without_unit(column: Any) -> Any:
    """Numbers of a column without its unit; the mask is kept."""
    if hasattr(column, "to_value"):  # a Quantity, plain or masked
        return column.value
    if isinstance(column, np.ma.MaskedArray):
        return np.ma.MaskedArray(column.data, mask=column.mask)
    return np.asarray(column)
