"""What the configuration says of RvB pairs: which of them are taken."""

from __future__ import annotations

from pydantic import PositiveFloat, PositiveInt, model_validator

from bayesdist.app.config.section import Section
from bayesdist.data.rvb.limits import RadialLimit
from bayesdist.data.rvb.select import RvbSelection

__all__ = ["RvbBlock"]


class RvbBlock(Section):
    """Limits on colour, and on offset and chi-square at the array's centre and in its corners."""

    colour: tuple[float, float] | None = None
    bluest: PositiveInt | None = None
    accept_centre: PositiveFloat | None = None
    accept_corner: PositiveFloat | None = None
    accept_chi2_centre: PositiveFloat | None = None
    accept_chi2_corner: PositiveFloat | None = None
    accept_power: PositiveFloat = 2.0

    @model_validator(mode="after")
    def _ranges(self) -> RvbBlock:
        if self.colour is not None and not self.colour[0] <= self.colour[1]:
            raise ValueError(
                f"data.rvb.colour goes from {self.colour[0]:g} to {self.colour[1]:g}; "
                "give the lower limit first"
            )
        for name in ("accept", "accept_chi2"):
            given = [f"{name}_{place}" for place in ("centre", "corner") if self._at(name, place)]
            if len(given) == 1:
                raise ValueError(
                    f"data.rvb.{given[0]} stands alone; give {name}_centre and {name}_corner, "
                    "equal ones for a limit that is the same everywhere"
                )
        return self

    def selection(self) -> RvbSelection:
        """Which pairs are taken."""
        return RvbSelection(self.colour, self.bluest, self._limit("accept"),
                            self._limit("accept_chi2"))  # fmt: skip

    def _limit(self, name: str) -> RadialLimit | None:
        centre, corner = (self._at(name, place) for place in ("centre", "corner"))
        if centre is None or corner is None:
            return None
        return RadialLimit(centre, corner, self.accept_power)

    def _at(self, name: str, place: str) -> float | None:
        value: float | None = getattr(self, f"{name}_{place}")
        return value
