"""Cells of the detector whose errors may pass for independent of each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import InputError
from bayesdist.model import DistortionModel

__all__ = ["Cells", "recommended_cells"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

MOST = 1024  # cells of a chip
LEAST = 4  # cells along the shorter side: with fewer there is nothing to compare


@dataclass(frozen=True)
class Cells:
    """Equal cells on each chip.

    Parameters
    ----------
    shapes : tuple of (int, int)
        Cells along x and along y of each chip, in the order of the model's.

    Raises
    ------
    InputError
        For chips with fewer than four cells on a side.
    """

    shapes: tuple[tuple[int, int], ...]

    def __post_init__(self) -> None:
        for shape in self.shapes:
            if min(shape) < LEAST:
                raise InputError(
                    f"{shape[0]} x {shape[1]} cells do not show what their stars have in common",
                    where="cells",
                    do=f"take {LEAST} or more on each side",
                )

    @property
    def most(self) -> int:
        """Cells of the chip that has most."""
        return max(nx * ny for nx, ny in self.shapes)

    def codes(self, X: Float, Y: Float, chip: int) -> Int:
        """Cell iy * nx + ix (N,) of scaled positions on a chip (by code)."""
        ix, iy = (
            np.clip(((z + 1) * (0.5 * n)).astype(np.int64), 0, n - 1)
            for z, n in zip((X, Y), self.shapes[chip], strict=True)
        )
        return np.asarray(iy * self.shapes[chip][0] + ix)

    def divisible(self, factor: int) -> bool:
        """Whether cells as many times larger are still enough on every chip."""
        return all(n // factor >= LEAST for shape in self.shapes for n in shape)

    @property
    def factors(self) -> tuple[int, ...]:
        """1, 2, 4, ...: how many times larger cells are looked at; at least two of them."""
        out = [1, 2]
        while self.divisible(2 * out[-1]):
            out.append(2 * out[-1])
        return tuple(out)

    def merged(self, factor: int) -> tuple[list[tuple[int, int]], list[Int]]:
        """Numbers of cells that are as many times larger, and into which one each cell goes."""
        shapes, into = [], []
        for nx, ny in self.shapes:
            mx, my = -(-nx // factor), -(-ny // factor)
            into.append(
                (np.arange(ny)[:, None] // factor * mx + np.arange(nx) // factor).reshape(-1)
            )
            shapes.append((mx, my))
        return shapes, into

    def sides(self, model: DistortionModel) -> tuple[float, float]:
        """Shortest and longest side of a cell in pixels."""
        sides = [
            size / n
            for chip, shape in zip(model.chips, self.shapes, strict=True)
            for size, n in zip(chip.size, shape, strict=True)
        ]
        return min(sides), max(sides)


def recommended_cells(model: DistortionModel, reach: float = 0.0) -> Cells:
    """Cells no smaller than the distance over which residuals are correlated.

    Parameters
    ----------
    model : DistortionModel
    reach : float
        Pixels, as `ResidualCorrelation.reach` finds them; 0 where no correlation is found.

    Returns
    -------
    Cells
        At most 1024 on a chip, at least four by four: where the correlation reaches further than
        these, `robust_covariance` has its doubts.

    Raises
    ------
    InputError
        For a reach that is negative or not finite.
    """
    if not 0 <= reach < np.inf:
        raise InputError(f"the reach is {reach}", where="reach", do="give 0 or more pixels")
    shapes = []
    for chip in model.chips:
        side = max(reach, np.sqrt(chip.size[0] * chip.size[1] / MOST))
        nx, ny = (max(LEAST, int(size / side + 1e-9)) for size in chip.size)
        shapes.append((nx, ny))
    return Cells(tuple(shapes))
