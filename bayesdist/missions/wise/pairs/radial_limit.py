"""Acceptance of pairs by limits that depend on the distance from the array's centre.

WSDC D-T033, section 3: tight near the centre, where distortion is small, wide in the corners, which
a first distortion model leaves pixels off.  With each iteration of the calibration the expected
positions get better and the limits may shrink.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.arrays import Bool, Float
from bayesdist.data.matches import Matches
from bayesdist.errors import InputError

__all__ = ["CHI2", "OFFSET", "RadialLimit", "radial_rows"]

OFFSET = "offset beyond the radial limit"
CHI2 = "chi-square beyond the radial limit"


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


def radial_rows(
    matches: Matches,
    size: tuple[float, float],
    *,
    offset: RadialLimit | None = None,
    chi2: RadialLimit | None = None,
) -> tuple[Bool, Bool]:
    """Boolean masks of the pairs whose reference position lies near enough to the detection.

    `matches`: with u, v in pixels of the array. `size`: columns and rows of the array. `offset`: on
    the distance, in pixels. `chi2`: on the chi-square of both axes, with the quoted errors. Returns
    `near`, `likely`: (N,), within the limit on the offset, and within that on chi-square.
    InputError for u, v in another unit, and a chi-square limit without errors.
    """
    where = ", ".join(matches.sources)
    if matches.unit != "pix":
        raise InputError(
            f"u, v are in {matches.unit}, and offsets are judged in pixels",
            where=where,
            do="bring u, v to pixels of the array",
        )
    du, dv = matches.u - matches.x, matches.v - matches.y
    near = np.ones(len(matches), bool)
    if offset is not None:
        near = np.hypot(du, dv) <= offset.at(matches.x, matches.y, size)
    likely = np.ones(len(matches), bool)
    if chi2 is not None:
        if matches.sigma_u is None or matches.sigma_v is None:
            raise InputError(
                "a limit on chi-square needs errors",
                where=where,
                do="map sigma_u and sigma_v, or limit the offset alone",
            )
        value = (du / matches.sigma_u) ** 2 + (dv / matches.sigma_v) ** 2
        likely = value <= chi2.at(matches.x, matches.y, size)
    return np.asarray(near), np.asarray(likely)
