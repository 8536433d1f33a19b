"""Limits for accepting pairs that depend on the distance from the centre of the array.

See WSDC D-T033, section 3.  The limit is small near the centre, where the distortion is small, and
large in the corners, where an initial distortion model is wrong by pixels.  It can be reduced as
the calibration improves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float


@dataclass(frozen=True)
class RadialLimit:
    """Limit that varies from the centre of the array to its corners.

        limit = centre + (corner - centre) (r / r_corner)^power

    Raises InputError if a value is not positive.
    """

    centre: float  # limit at the centre
    corner: float  # limit in the corners
    power: float = 2.0

    def __post_init__(self) -> None:
        for name in ("centre", "corner", "power"):
            value = getattr(self, name)
            if not value > 0:
                raise InputError(
                    f"the radial limit's {name} is {value:g}", do="give a positive number"
                )

    def at(self, x: ArrayLike, y: ArrayLike, size: tuple[float, float]) -> Float:
        """Limits (N,) at FITS 1-based pixels (N,) of an array with `size` columns and rows."""
        dx = np.asarray(x, float) - (size[0] + 1) / 2
        dy = np.asarray(y, float) - (size[1] + 1) / 2
        radius_fraction = np.hypot(dx, dy) / (np.hypot(*size) / 2)
        return self.centre + (self.corner - self.centre) * radius_fraction**self.power
