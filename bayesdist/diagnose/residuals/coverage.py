"""Part of a chip that the stars cover; beyond it a polynomial is extrapolated.

The formal and the posterior errors hold beyond it only if the model does, and no star says so.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, QhullError

from bayesdist.diagnose.residuals.binned import BinnedSums
from bayesdist.model import Chip
from bayesdist.model.grid import mesh
from bayesdist.utils.arrays import Bool, Float
from bayesdist.utils.limits import UNCOVERED, UNCOVERED_BY_CHANCE

SPARSE = 0.02  # of the density where stars usually are: strays, not coverage
_FINE = (65, 65)


@dataclass(frozen=True, eq=False)
class Coverage:
    """The convex area of a chip that its stars span."""

    chip: Chip
    several: bool  # whether the detector has other chips beside it
    sides: Float  # (m, 3) (a, b, c) with a x + b y + c the distance beyond a side of the area
    gap: float  # fraction of the chip's area beyond it
    known: bool  # whether an earlier calibration, which is the prior, has the rest
    by_chance: float  # the gap that as many stars leave on average when they are scattered evenly

    @property
    def significant(self) -> bool:
        """True where so much is missing that the corners or edges are extrapolated."""
        return not self.known and self.gap > self.most

    @property
    def most(self) -> float:
        """Fraction of the chip's area that may lie beyond the stars."""
        return max(UNCOVERED.value, UNCOVERED_BY_CHANCE.value * self.by_chance)

    @property
    def sentence(self) -> str:
        """Meaning of the gap, as a clause."""
        part = f"chip {self.chip.name}" if self.several else "the detector"
        (left, right), (bottom, top) = self.extent
        return (
            f"{100 * self.gap:.0f} % of {part} lies beyond the area that its stars cover (within "
            f"x {left:.0f} to {right:.0f}, y {bottom:.0f} to {top:.0f}): there the "
            "polynomial is extrapolated, and its errors are not known"
        )

    @property
    def extent(self) -> Float:
        """Smallest and largest x, then y, of the area, shape (2, 2)."""
        on_chip = [(0.5, n + 0.5) for n in self.chip.size]
        reach = np.eye(2)[:, None] * [[1.0], [-1.0]]  # the least x, the least -x, ...
        found = [
            [linprog(way, self.sides[:, :2], -self.sides[:, 2], bounds=on_chip).x for way in axis]
            for axis in reach
        ]
        return np.einsum("aca->ac", np.array(found))

    def within(self, field: Callable[[Float, Float], Bool]) -> Coverage:
        """Coverage of the part of the chip that sees the sky; `field` is True for its pixels."""
        x, y = _fine_pixels(self.chip)
        inside = field(x, y)
        if not inside.any():
            return self
        return replace(self, gap=float((self.beyond(x, y)[inside] > 0).mean()))

    def beyond(self, x: Float, y: Float) -> Float:
        """Distance (N,) of pixels beyond the area; negative inside."""
        return np.asarray((self.sides @ np.stack([x, y, np.ones_like(x)])).max(axis=0))


def coverage_of(
    sums: BinnedSums, corners: Float, chip: Chip, *, several: bool = False, known: bool = False
) -> Coverage:
    """The area of a chip that its stars cover.

    It lies within the hull of all stars, and within that of the cells that hold more than strays:
    a few false matches in the corners cover nothing.

    `sums` are those of the stars used, `corners` (m, 2) the vertices of the convex hull of all
    stars (`ChipSurvey.corners`); `several` chips make the detector, or one; with `known` an earlier
    calibration says where no stars are.

    The gap that n even stars leave in a rectangle is (8/3) ln n / n of its area (Renyi & Sulanke
    1963, Z. Wahrscheinlichkeitstheorie 2, 75).
    """
    count, size = sums.count, np.array(chip.size)
    n = int(count.sum())
    ny, nx = count.shape
    # half of the stars have no more neighbours than this in their cells
    ordered = np.sort(count.ravel())
    usual = ordered[np.searchsorted(np.cumsum(ordered), n / 2)]
    iy, ix = np.nonzero(count > max(1.0, SPARSE * usual))
    cells = (
        np.concatenate([np.column_stack([ix + a, iy + b]) for a in (0, 1) for b in (0, 1)])
        * (size / [nx, ny])
        + 0.5
    )
    sides = np.concatenate([_sides(cells), _sides(corners)])
    x, y = _fine_pixels(chip)
    beyond = (sides @ np.stack([x, y, np.ones_like(x)])).max(axis=0) > 0
    chance = 8 / 3 * np.log(max(n, 2)) / max(n, 2)
    return Coverage(chip, several, sides, float(beyond.mean()), known, float(chance))


def _fine_pixels(chip: Chip) -> tuple[Float, Float]:
    """Pixels (N,) of equal cells, by which areas are counted."""
    step = [(np.arange(k) + 0.5) / k for k in _FINE]
    return mesh(*(s * length + 0.5 for s, length in zip(step, chip.size, strict=True)))


def _sides(points: Float) -> Float:
    """Sides of the convex hull; none, which bounds nothing, where there is no area."""
    try:
        return np.asarray(ConvexHull(points).equations)
    except (QhullError, ValueError):
        return np.array([[0.0, 0.0, -1.0]])
