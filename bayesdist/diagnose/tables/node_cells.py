"""Cells that divide the squares between the nodes of a look-up table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.model import Chip

__all__ = ["NodeCells"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]


@dataclass(frozen=True)
class NodeCells:
    """Cells that divide the squares between nodes."""

    # pixel of the corner of the first cell: on the node before the first one of the table
    origin: tuple[float, float]
    side: tuple[float, float]
    shape: tuple[int, int]  # cells along x and y
    parts: int  # along a side of a square

    @classmethod
    def of(cls, chip: Chip, step: tuple[float, float], parts: int) -> NodeCells:
        """Cells of a chip, `parts` along each side of a square."""
        squares = [int(np.ceil(n / s - 1e-9)) + 1 for n, s in zip(chip.size, step, strict=True)]
        return cls(
            ((1 - step[0]) / 2, (1 - step[1]) / 2),
            (step[0] / parts, step[1] / parts),
            (squares[0] * parts, squares[1] * parts),
            parts,
        )

    @property
    def number(self) -> int:
        """Number of cells."""
        return self.shape[0] * self.shape[1]

    def of_pixels(self, x: Float, y: Float) -> Int:
        """Cell of each pixel, shape (N,)."""
        i, j = (
            np.clip(((p - o) // s).astype(np.int64), 0, n - 1)
            for p, o, s, n in zip((x, y), self.origin, self.side, self.shape, strict=True)
        )
        return j * self.shape[0] + i

    def centres(self, cells: Int) -> tuple[Float, Float]:
        """Pixels x and y of the centres of cells."""
        j, i = np.divmod(cells, self.shape[0])
        x, y = (o + (k + 0.5) * s for o, k, s in zip(self.origin, (i, j), self.side, strict=True))
        return x, y

    def areas(self, chip: Chip) -> Float:
        """Fraction of each square that lies on the chip."""
        shares = []
        for o, s, n, size in zip(self.origin, self.side, self.shape, chip.size, strict=True):
            edges = o + s * self.parts * np.arange(n // self.parts + 1)
            shares.append(np.diff(np.clip(edges, 0.5, size + 0.5)) / (s * self.parts))
        return np.outer(shares[1], shares[0]).ravel()

    def squares(self) -> Int:
        """Square (cells,) that each cell lies in."""
        j, i = np.divmod(np.arange(self.number), self.shape[0])
        return j // self.parts * (self.shape[0] // self.parts) + i // self.parts
