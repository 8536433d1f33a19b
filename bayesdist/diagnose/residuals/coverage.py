"""Part of a chip that the stars cover; outside of it a polynomial is extrapolated.

The formal and posterior errors are valid there only if the model is, and no star can test that.
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

SPARSE = 0.02  # fraction of the typical density below which stars are strays rather than coverage
_FINE = (65, 65)


@dataclass(frozen=True, eq=False)
class Coverage:
    """Convex area of a chip that its stars span."""

    chip: Chip
    several: bool  # True if the detector has several chips
    # (m, 3) coefficients (a, b, c); a x + b y + c is the distance outside of a side of the area
    sides: Float
    gap: float  # fraction of the chip's area outside
    known: bool  # True if an earlier calibration, used as the prior, covers the remaining area
    by_chance: float  # average gap for this number of evenly distributed stars

    @property
    def significant(self) -> bool:
        """True if the gap is so large that corners or edges are extrapolated."""
        return not self.known and self.gap > self.most

    @property
    def most(self) -> float:
        """Largest acceptable fraction of the chip's area outside."""
        return max(UNCOVERED.value, UNCOVERED_BY_CHANCE.value * self.by_chance)

    @property
    def sentence(self) -> str:
        """Meaning of the gap, as a clause."""
        part = f"chip {self.chip.name}" if self.several else "the detector"
        (x_low, x_high), (bottom, top) = self.extent
        return (
            f"{100 * self.gap:.0f} % of {part} lies beyond the area that its stars cover (within "
            f"x {x_low:.0f} to {x_high:.0f}, y {bottom:.0f} to {top:.0f}): there the "
            "polynomial is extrapolated, and its errors are not known"
        )

    @property
    def extent(self) -> Float:
        """Range of the area in x, then in y, pixels, shape (2, 2)."""
        on_chip = [(0.5, n + 0.5) for n in self.chip.size]
        reach = np.eye(2)[:, None] * [[1.0], [-1.0]]  # directions that minimise x, -x, y and -y
        corners = [
            [linprog(way, self.sides[:, :2], -self.sides[:, 2], bounds=on_chip).x for way in axis]
            for axis in reach
        ]
        return np.einsum("aca->ac", np.array(corners))

    def within(self, field: Callable[[Float, Float], Bool]) -> Coverage:
        """Coverage of the illuminated part of the chip; `field` is True for its pixels."""
        x, y = _fine_pixels(self.chip)
        inside = field(x, y)
        if not inside.any():
            return self
        return replace(self, gap=float((self.beyond(x, y)[inside] > 0).mean()))

    def beyond(self, x: Float, y: Float) -> Float:
        """Distance (N,) of pixels outside of the area; negative inside."""
        return np.asarray((self.sides @ np.stack([x, y, np.ones_like(x)])).max(axis=0))


def coverage_of(
    sums: BinnedSums, corners: Float, chip: Chip, *, several: bool = False, known: bool = False
) -> Coverage:
    """Area of a chip that its stars cover.

    It is inside the convex hull of all stars and inside that of the cells with more than a few
    strays:  a few false matches in the corners do not cover them.

    `sums` are those of the stars used, `corners` (m, 2) are the vertices of the convex hull of all
    stars (`ChipSurvey.corners`).  `several` is True if the detector has several chips, and `known`
    if an earlier calibration covers the remaining area.

    The gap that n evenly distributed stars leave in a rectangle is (8/3) ln n / n of its area
    (Renyi & Sulanke 1963, Z. Wahrscheinlichkeitstheorie 2, 75).
    """
    count, size = sums.count, np.array(chip.size)
    n = int(count.sum())
    ny, nx = count.shape
    # density that half of the stars do not exceed in their cells
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
    """Centres (N,) of equal cells on a chip, for counting areas."""
    step = [(np.arange(k) + 0.5) / k for k in _FINE]
    return mesh(*(s * length + 0.5 for s, length in zip(step, chip.size, strict=True)))


def _sides(points: Float) -> Float:
    """Sides of the convex hull; one that excludes nothing if the points span no area."""
    try:
        return np.asarray(ConvexHull(points).equations)
    except (QhullError, ValueError):
        return np.array([[0.0, 0.0, -1.0]])
