"""Units of positions and errors: pixels and angles, and the pixel scale that joins them."""

from __future__ import annotations

import math

from bayesdist.data.tables.units import UNITS
from bayesdist.errors import InputError, require_known
from bayesdist.infer.solution.solution import Solution

_MAS = {"mas": 1.0, "arcsec": 1e3, "deg": 3.6e6}


def convert(
    value: float, from_unit: str, to_unit: str, pixel_scale: float | None = None, *, where: str = ""
) -> float:
    """A length in another unit.

    Parameters
    ----------
    value : float or ndarray
    from_unit, to_unit : str
        'pix', 'arcsec', 'mas' or 'deg'.
    pixel_scale : float, optional
        Size of one pixel in **mas**, as `pixel_scale_of` gives it; needed only between pixels and
        angles.
    where : str, optional
        Where the value was given, for the message.

    Returns
    -------
    float or ndarray

    Raises
    ------
    InputError
        For an unknown unit, a scale that is not positive, or pixels and angles without a scale.
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
    """Unit of a number of the user: the stated one, or pixels if u and v are in pixels.

    `unit`: of u and v; `where`: what the number is, for the message. InputError where none is
    stated and u and v are angles: the number may be in either.
    """
    if not stated and unit != "pix":
        raise InputError(
            f"no unit is given, and u and v are in {unit}",
            where=where,
            do=f'state it, as unit = "{unit}" or unit = "pix"',
        )
    return stated or "pix"


def require_scale(scale_mas: float) -> None:
    """Pass a pixel scale that is positive and finite."""
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

    `chip`: chip number; the first chip by default. `scale_mas`: the scale where the user gives it;
    it is returned as it is. The result is in mas per pixel.  Without `scale_mas`: where u and v are
    angles, the square root of the pixel area at the reference pixel, without drift and frames;
    where they are pixels, None. InputError for an unknown chip or a scale that is not positive.
    """
    if scale_mas is not None:
        require_scale(scale_mas)
        return float(scale_mas)
    model = solution.model
    if model.unit == "pix":
        return None
    return convert(model.pixel_size(solution.mean, chip), model.unit, "mas")
