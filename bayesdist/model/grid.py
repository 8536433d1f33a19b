"""Detector grid of all maps; arrays on it are indexed [iy, ix]."""

from __future__ import annotations

import numpy as np

from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.memory import require_memory

DEFAULT_GRID = (33, 17)
BYTES_OF_POINT = 500  # at least: its position, the polynomial there, and some draws


def grid_pixels(size: tuple[float, float], grid: tuple[int, int]) -> tuple[Float, Float]:
    """Columns (nx,) and rows (ny,) of the grid, FITS 1-based, evenly from pixel 1 to the size.

    InputError for a grid that is not two whole numbers of at least 2.
    """
    if len(grid) != 2 or any(int(n) != n or n < 2 for n in grid):
        raise InputError(
            f"the grid is {list(grid)}",
            where="assess.grid",
            do="give two whole numbers of at least 2, points on x and on y",
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
    """Pixels (ny * nx,) of the grid points, x and y, in the order of a flattened [iy, ix] array."""
    X, Y = np.meshgrid(x, y)
    return X.ravel(), Y.ravel()


def cell_index(X: Float, Y: Float, bins: tuple[int, int]) -> Int:
    """Cell of each position (N,), counted along x first; X and Y run from -1 to 1 over the chip.

    Positions beyond are in the outermost cells.
    """
    ix, iy = (
        np.clip(((z + 1) * (0.5 * n)).astype(np.int64), 0, n - 1)
        for z, n in zip((X, Y), bins, strict=True)
    )
    return np.asarray(iy * bins[0] + ix, np.int64)


def outline_pixels(size: tuple[float, float]) -> tuple[Float, Float]:
    """Pixels once around a chip: its edges are not straight on the sky."""
    nx, ny = size
    t = np.linspace(0, 1, 9)
    x = 0.5 + nx * np.concatenate([t, 1 + 0 * t, 1 - t, 0 * t])
    y = 0.5 + ny * np.concatenate([0 * t, t, 1 + 0 * t, 1 - t])
    return x, y


def position_of_largest(values: Float, x: Float, y: Float) -> tuple[float, float]:
    """Pixel (x, y) at which a map (ny, nx) is largest, NaN apart."""
    iy, ix = np.unravel_index(int(np.nanargmax(values)), values.shape)
    return float(x[ix]), float(y[iy])
