"""Arrangement of the chips of a detector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from bayesdist.model import Chip

Size = tuple[float, float]

MAX_COLUMNS = 3  # of panels; more would be too narrow


@dataclass(frozen=True)
class Mosaic:
    """Arrangement of the chips of a detector."""

    sizes: tuple[Size, ...]  # columns and rows of each chip, pixels
    names: tuple[str, ...] = ("",)  # shown if there are several chips
    places: tuple[tuple[int, int], ...] = ((0, 0),)  # row (0 at the top) and column of each chip

    @classmethod
    def of_chips(cls, chips: Sequence[Chip], places: Sequence[tuple[int, int]]) -> Mosaic:
        """Arrangement of the chips of a model, with their names if there are several."""
        names = tuple(chip.name if len(chips) > 1 else "" for chip in chips)
        return cls(tuple(chip.size for chip in chips), names, tuple(places))

    @property
    def several(self) -> bool:
        """True if there is more than one chip."""
        return len(self.sizes) > 1

    @property
    def largest(self) -> Size:
        """Numbers of columns and rows that are sufficient for every chip."""
        return max(s[0] for s in self.sizes), max(s[1] for s in self.sizes)

    @property
    def longest_side(self) -> float:
        """Longest side of a chip, in pixels."""
        return max(self.largest)

    @property
    def legible_places(self) -> tuple[tuple[int, int], ...]:
        """Row and column of each chip; a wide detector is wrapped to fewer columns."""
        if max(column for _, column in self.places) < MAX_COLUMNS:
            return self.places
        order = sorted(self.places)
        return tuple(divmod(order.index(place), MAX_COLUMNS) for place in self.places)
