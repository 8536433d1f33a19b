"""Units of positions and errors: pixels, angles, and the pixel scale that relates them."""

from __future__ import annotations

import math

from bayesdist.data.tables.column import UNITS
from bayesdist.errors import InputError, require_known
from bayesdist.infer.solution.solution import Solution

_MAS = {"mas": 1.0, "arcsec": 1e3, "deg": 3.6e6}


def convert(
    value: float, from_unit: str, to_unit: str, pixel_scale: float | None = None, *, where: str = ""
) -> float:
    """Convert a length to another unit.

    Parameters
    ----------
    value : float or ndarray
        Length in `from_unit`.
    from_unit, to_unit : str
        'pix', 'arcsec', 'mas' or 'deg'.
    pixel_scale : float, optional
        Size of one pixel in **mas**, as returned by `pixel_scale_of`; needed only between pixels
        and angles.
    where : str, optional
        Location of the value in the user's input, for the error message.

    Returns
    -------
    float or ndarray

    Raises
    ------
    InputError
        If a unit is unknown, the scale is not positive, or pixels and angles are converted without
        a scale.
    """
    for unit in (from_unit, to_unit):
        require_known(unit, UNITS, "unit", where=where)
    if from_unit == to_unit:
        return value
    if pixel_scale is None and "pix" in (from_unit, to_unit):
        raise InputError(
            f"{from_unit} cannot be converted to {to_unit} without a pixel scale",
            where=where,
            do="give detector.scale_mas",
        )
    mas = dict(_MAS)
    if pixel_scale is not None:
        require_scale(pixel_scale)
        mas["pix"] = pixel_scale
    return value * (mas[from_unit] / mas[to_unit])


def stated_unit(stated: str | None, unit: str, where: str) -> str:
    """Unit of a number given by the user: the stated unit, or pixels if u and v are in pixels.

    `unit`: unit of u and v; `where`: description of the number, for the error message. Raises
    InputError if no unit is stated and u and v are angles, since the number may be in either unit.
    """
    if not stated and unit != "pix":
        raise InputError(
            f"no unit is given, and u and v are in {unit}",
            where=where,
            do=f'state it, as unit = "{unit}" or unit = "pix"',
        )
    return stated or "pix"


def require_scale(scale_mas: float) -> None:
    """Raise InputError unless a pixel scale is positive and finite."""
    if not (math.isfinite(scale_mas) and scale_mas > 0):
        raise InputError(
            f"the pixel scale is {scale_mas} mas",
            where="detector.scale_mas",
            do="give a positive number",
        )


def pixel_scale_of(
    solution: Solution, chip: int | None = None, scale_mas: float | None = None
) -> float | None:
    """Size of one pixel, in mas.

    Parameters
    ----------
    solution : Solution
    chip : int, optional
        Chip number; the first chip by default.
    scale_mas : float, optional
        Scale stated by the user, which is returned unchanged.

    Returns
    -------
    float or None
        Without `scale_mas`, the square root of the pixel area at the reference pixel, ignoring
        drift and exposure frames; None if u and v are in pixels.

    Raises
    ------
    InputError
        If the chip is unknown, or the scale is not positive.
    """
    if scale_mas is not None:
        require_scale(scale_mas)
        return float(scale_mas)
    model = solution.model
    if model.unit == "pix":
        return None
    return convert(model.pixel_size(solution.mean, chip), model.unit, "mas")
