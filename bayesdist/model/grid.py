"""Detector grid of all maps; arrays of values on the grid are indexed [iy, ix]."""

from __future__ import annotations

import numpy as np

from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.memory import require_memory

DEFAULT_GRID = (33, 17)
BYTES_OF_POINT = 500  # lower bound: position, basis functions and some draws of one point


def grid_pixels(size: tuple[float, float], grid: tuple[int, int]) -> tuple[Float, Float]:
    """Pixels x (nx,) and y (ny,) of a regular grid from pixel 1 to the size, FITS 1-based.

    `size` and `grid` have the numbers of pixels and of grid points along x and y.  Raises
    InputError unless the grid is given by two integers of at least 2, and MemoryLimitError if it is
    too large.
    """
    if len(grid) != 2 or any(int(n) != n or n < 2 for n in grid):
        raise InputError(
            f"the grid is {list(grid)}",
            where="assess.grid",
            do="give two integers of at least 2, the numbers of points along x and y",
        )
    nx, ny = (int(n) for n in grid)
    require_memory(
        BYTES_OF_POINT * nx * ny,
        f"the grid of {nx} x {ny} positions",
        where="assess.grid",
        do="give fewer points",
    )
    return np.linspace(1.0, size[0], nx), np.linspace(1.0, size[1], ny)


def mesh(x: Float, y: Float) -> tuple[Float, Float]:
    """Pixels x and y (ny * nx,) of all grid points, in the order of a flattened [iy, ix] array."""
    X, Y = np.meshgrid(x, y)
    return X.ravel(), Y.ravel()


def cell_index(X: Float, Y: Float, bins: tuple[int, int]) -> Int:
    """Index (N,) of the cell that contains each position; the index along x varies fastest.

    X and Y are coordinates scaled to [-1, 1] over the chip, and `bins` the numbers of cells along x
    and y.  Positions outside are assigned to the outermost cells.
    """
    ix, iy = (
        np.clip(((z + 1) * (0.5 * n)).astype(np.int64), 0, n - 1)
        for z, n in zip((X, Y), bins, strict=True)
    )
    return np.asarray(iy * bins[0] + ix, np.int64)


def outline_pixels(size: tuple[float, float]) -> tuple[Float, Float]:
    """Pixels x and y (36,) along the outline of a chip, FITS 1-based.

    There are nine per side, since the sides are curved on the sky.
    """
    nx, ny = size
    t = np.linspace(0, 1, 9)
    x = 0.5 + nx * np.concatenate([t, 1 + 0 * t, 1 - t, 0 * t])
    y = 0.5 + ny * np.concatenate([0 * t, t, 1 + 0 * t, 1 - t])
    return x, y


def position_of_largest(values: Float, x: Float, y: Float) -> tuple[float, float]:
    """Pixel (x, y) of the maximum of a map (ny, nx), ignoring NaN."""
    iy, ix = np.unravel_index(int(np.nanargmax(values)), values.shape)
    return float(x[ix]), float(y[iy])
