"""Acceptance of pairs by limits that depend on the distance from the array's centre.

WSDC D-T033, section 3: tight near the centre, where distortion is small, wide in the corners, which
a first distortion model leaves pixels off.  With each iteration of the calibration the expected
positions get better and the limits may shrink.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float


@dataclass(frozen=True)
class RadialLimit:
    """A limit that goes from one value at the array's centre to another in its corners.

    InputError for values that are not positive.
    """

    centre: float  # positive; equal for a limit without dependence on the radius
    corner: float
    power: float = 2.0  # how it goes there: limit = centre + (corner - centre) (r / r_corner)^power

    def __post_init__(self) -> None:
        for name in ("centre", "corner", "power"):
            value = getattr(self, name)
            if not value > 0:
                raise InputError(
                    f"the radial limit's {name} is {value:g}", do="give a positive number"
                )

    def at(self, x: ArrayLike, y: ArrayLike, size: tuple[float, float]) -> Float:
        """The limit at detector positions.

        `x`, `y`: (N,), FITS 1-based pixels. `size`: columns and rows of the array. Returns (N,).
        """
        dx = np.asarray(x, float) - (size[0] + 1) / 2
        dy = np.asarray(y, float) - (size[1] + 1) / 2
        share = np.hypot(dx, dy) / (np.hypot(*size) / 2)
        return self.centre + (self.corner - self.centre) * share**self.power
