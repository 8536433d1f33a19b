"""Units in which a number is easy to read, chosen by its size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.report.numerals import MISSING, number

__all__ = ["Scale", "display_scale", "ladder", "with_mas"]

# (factor, name) from the largest unit down
_LADDERS: dict[str, tuple[tuple[float, str], ...]] = {
    "pix": ((1.0, "pix"), (1e3, "10⁻³ pix"), (1e6, "10⁻⁶ pix")),
    "deg": ((1.0, "deg"), (3.6e3, "arcsec"), (3.6e6, "mas"), (3.6e9, "µas")),
    "arcsec": ((1.0, "arcsec"), (1e3, "mas"), (1e6, "µas")),
    "mas": ((1e-3, "arcsec"), (1.0, "mas"), (1e3, "µas")),
}


@dataclass(frozen=True)
class Scale:
    """A unit for display.

    Parameters
    ----------
    factor : float
        What a number in the native unit is multiplied by.
    unit : str
        Name of the unit after that, for a label.
    """

    factor: float
    unit: str

    def text(self, value: float, digits: int = 3) -> str:
        """A number in the native unit as text in this one."""
        times = "\u202f×\u202f" if self.unit.startswith("10") else "\u202f"
        return f"{value * self.factor:.{digits}g}{times}{self.unit}".replace("-", "−")


def display_scale(unit: str, values: ArrayLike) -> Scale:
    """Unit in which the largest of some values needs few zeros.

    Parameters
    ----------
    unit : str
        Native unit, or one per year ("pix/yr"); one that is not known is kept as it is.
    values : array_like
        In the native unit; what is not finite does not count.

    Returns
    -------
    Scale
    """
    base, _, rate = unit.partition("/")
    steps = ladder(base)
    if rate:
        steps = tuple((factor, f"{name}/{rate}") for factor, name in steps)
    size = np.abs(np.asarray(values, float))
    size = size[np.isfinite(size)]
    largest = float(size.max()) if size.size else 0.0
    if largest == 0.0:
        return Scale(*next(step for step in steps if step[0] == 1.0))
    # pixels have no name for a thousandth, so that 0.0266 pix reads better than 26.6 × 10⁻³ pix
    readable = 0.000999 if base == "pix" else 0.0999
    for factor, name in steps:
        if largest * factor >= readable:
            return Scale(factor, name)
    return Scale(*steps[-1])


def ladder(unit: str) -> tuple[tuple[float, str], ...]:
    """Units in which lengths of a native unit are shown: (factor, name), the largest first."""
    return _LADDERS.get(unit, ((1.0, unit),))


def with_mas(value: float, unit: str, scale_mas: float | None, digits: int = 3) -> str:
    """A length with its unit, and in mas beside it where the size of a pixel is known.

    Parameters
    ----------
    value : float
        In `unit`.
    unit : str
    scale_mas : float or None
        Size of a pixel in mas.
    digits : int
        Significant digits.

    Returns
    -------
    str
        As in ``"0.00930 pix (25.6 mas)"``; a dash where the value is not finite.
    """
    if not np.isfinite(value):
        return MISSING
    if unit != "pix":
        angle = display_scale(unit, value)
        return f"{number(value * angle.factor, digits)}\u202f{angle.unit}"
    text = f"{number(value, digits)}\u202fpix"
    return (
        text
        if scale_mas is None
        else f"{text} ({with_mas(value * scale_mas, 'mas', None, digits)})"
    )
