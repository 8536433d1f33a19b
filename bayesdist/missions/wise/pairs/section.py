"""The section [data] of RvB pairs: their band, and which of them are taken."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Literal

from pydantic import PositiveFloat, PositiveInt

from bayesdist.app.config.data import Data
from bayesdist.app.config.section import Section
from bayesdist.missions.wise.pairs.radial_limit import RadialLimit


class RvbBlock(Section):
    """Limits that pairs have to meet, all of those that are given.

    On colour, and on offset and chi-square at the array's centre and in its corners; `bluest` is
    how many of each frame are taken at most, those of the smallest colour.
    """

    colour: tuple[float, float] | None = None
    bluest: PositiveInt | None = None
    accept_centre: PositiveFloat | None = None
    accept_corner: PositiveFloat | None = None
    accept_chi2_centre: PositiveFloat | None = None
    accept_chi2_corner: PositiveFloat | None = None
    accept_power: PositiveFloat = 2.0

    def faults(self) -> Iterator[str]:
        """Ranges without an end, or from the upper to the lower one."""
        if self.colour is not None and not self.colour[0] <= self.colour[1]:
            yield (
                f"data.rvb.colour goes from {self.colour[0]:g} to {self.colour[1]:g}; "
                "give the lower limit first"
            )
        for name in ("accept", "accept_chi2"):
            given = [key for key in (f"{name}_centre", f"{name}_corner") if getattr(self, key)]
            if len(given) == 1:
                yield (
                    f"data.rvb.{given[0]} stands alone; give {name}_centre and {name}_corner, "
                    "equal ones for a limit that is the same everywhere"
                )

    @property
    def offset(self) -> RadialLimit | None:
        """Limit on the distance of the reference position from the detection, in pixels."""
        return self._limit(self.accept_centre, self.accept_corner)

    @property
    def chi2(self) -> RadialLimit | None:
        """Limit on the chi-square of that distance; a pair beyond both counts under the first."""
        return self._limit(self.accept_chi2_centre, self.accept_chi2_corner)

    @property
    def takes_all(self) -> bool:
        """True if no limit is given."""
        return not self.by_colour and self.offset is None and self.chi2 is None

    @property
    def by_colour(self) -> bool:
        """True if a pair needs a colour."""
        return self.colour is not None or self.bluest is not None

    def _limit(self, centre: float | None, corner: float | None) -> RadialLimit | None:
        if centre is None or corner is None:
            return None
        return RadialLimit(centre, corner, self.accept_power)


class RvbData(Data):
    """RvB pairs of one band."""

    format: Literal["rvb"] = "rvb"
    band: str | None = None
    rvb: RvbBlock = RvbBlock()

    one_array: ClassVar[bool] = True

    def faults(self) -> Iterator[str]:
        """Those of every table, and settings of the sky."""
        yield from super().faults()
        if self.tangent_point is not None:
            yield (
                "data.tangent_point is given, but RvB pairs lie in pixels of the band frame; "
                "leave it out"
            )
        for key in ("epoch", "catalogue_epoch"):
            if getattr(self, key) is not None:
                yield (f"data.{key} is given, and RvB pairs have no proper motions; leave it out")
