"""Configuration section [data] for RvB pairs: band, selection, and radial limits.

See WSDC D-T033, section 3.  A radial limit for accepting pairs is small near the centre, where the
distortion is small, and large in the corners, where an initial distortion model is wrong by pixels.
It can be reduced as the calibration improves.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import PositiveFloat, PositiveInt

from bayesdist.app.config.section import Section
from bayesdist.errors import InputError
from bayesdist.kinds.matches.config import Data
from bayesdist.utils.arrays import Float


class RvbBlock(Section):
    """Limits for the selection of pairs; all limits that are given must be met.

    There are limits on colour, and on offset and chi-square at the centre of the array and in its
    corners.  `bluest` is the maximum number of pairs per frame; the bluest ones are selected.
    """

    colour: tuple[float, float] | None = None
    bluest: PositiveInt | None = None
    accept_centre: PositiveFloat | None = None
    accept_corner: PositiveFloat | None = None
    accept_chi2_centre: PositiveFloat | None = None
    accept_chi2_corner: PositiveFloat | None = None
    accept_power: PositiveFloat = 2.0

    def faults(self) -> Iterator[str]:
        """Errors in the ranges: a missing or reversed limit."""
        if self.colour is not None and not self.colour[0] <= self.colour[1]:
            yield (
                f"data.rvb.colour is from {self.colour[0]:g} to {self.colour[1]:g}; "
                "give the lower limit first"
            )
        for name in ("accept", "accept_chi2"):
            set_keys = [key for key in (f"{name}_centre", f"{name}_corner") if getattr(self, key)]
            if len(set_keys) == 1:
                yield (
                    f"data.rvb.{set_keys[0]} is given alone; give {name}_centre and {name}_corner, "
                    "with equal values for a constant limit"
                )

    @property
    def offset(self) -> RadialLimit | None:
        """Limit on the distance between detection and reference position, in pixels."""
        return self._limit(self.accept_centre, self.accept_corner)

    @property
    def chi2(self) -> RadialLimit | None:
        """Limit on the chi-square of this distance."""
        return self._limit(self.accept_chi2_centre, self.accept_chi2_corner)

    @property
    def takes_all(self) -> bool:
        """True if no limit is given, so that all pairs are selected."""
        return not self.by_colour and self.offset is None and self.chi2 is None

    @property
    def by_colour(self) -> bool:
        """True if pairs are selected by colour."""
        return self.colour is not None or self.bluest is not None

    def _limit(self, centre: float | None, corner: float | None) -> RadialLimit | None:
        if centre is None or corner is None:
            return None
        return RadialLimit(centre, corner, self.accept_power)


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


class RvbData(Data):
    """Section [data] for RvB pairs of one band."""

    format: Literal["rvb"] = "rvb"
    band: str | None = None
    rvb: RvbBlock = RvbBlock()

    one_array: ClassVar[bool] = True

    def faults(self) -> Iterator[str]:
        """Errors in the settings: those of all tables, and settings for sky positions."""
        yield from super().faults()
        if self.tangent_point is not None:
            yield (
                "data.tangent_point is given, but RvB pairs are in pixels of the band frame; "
                "omit it"
            )
        for key in ("epoch", "catalogue_epoch"):
            if getattr(self, key) is not None:
                yield (f"data.{key} is given, but RvB pairs have no proper motions; omit it")
