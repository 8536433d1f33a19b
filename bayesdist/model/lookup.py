"""Look-up tables: the part of the distortion that no polynomial follows.

A table holds small shifts of the pixel at the nodes of a grid.  Between the nodes it is bilinear,
beyond the outermost ones constant: exactly as astropy.wcs and the HST pipeline use a D2IMFILE, so
that a table has one meaning everywhere.

    x' = x + D_chip(x, y)             detector table, common to all filters
    x'' = x' + F_chip,filter(x')      filter table, evaluated at the corrected pixel
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.errors import InputError
from bayesdist.model.basis import as_pair
from bayesdist.utils.arrays import Bool, Float, Int


@dataclass(frozen=True, eq=False)
class LookupTable:
    """Shifts of the pixel at the nodes of a regular grid on one chip.

    Parameters
    ----------
    chip : int
        Chip number.
    values : array_like, shape (2, ny, nx)
        Pixels, *added* to x (first plane) and to y (second plane).
    filter : str
        Filter that the table belongs to; '' is the detector's own table, which holds in every one.
    first : tuple of float
        Pixel (x, y) of node [0, 0], FITS 1-based.  The default is the centre of a bin of 64 pixels.
    step : tuple of float
        Pixels between nodes along x and y.
    sigma : array_like, shape (2, ny, nx), optional
        Standard error of each node value, pixels.  The sigma of an interpolated shift needs the
        covariance of the nodes: it is not offered here.

    Raises
    ------
    InputError
        For arrays of another shape, values that are not finite, a sigma below zero, or a step that
        is not above zero.

    Examples
    --------
    >>> table = bd.LookupTable(1, np.full((2, 32, 64), 0.1))
    >>> table.shape
    (32, 64)
    >>> np.allclose(table.evaluate([1000.0], [500.0]), 0.1)
    True
    """

    chip: int
    values: Float
    filter: str = ""
    first: tuple[float, float] = (32.5, 32.5)
    step: tuple[float, float] = (64.0, 64.0)
    sigma: Float | None = None

    def __post_init__(self) -> None:
        values = np.array(self.values, float)
        where = f"look-up table {self.label}"
        if values.ndim != 3 or values.shape[0] != 2 or min(values.shape[1:]) < 2:
            raise InputError(
                f"the values have shape {values.shape}",
                where=where,
                do="give an array (2, ny, nx) with two nodes or more along each axis",
            )
        _refuse(~np.isfinite(values), values, "value", where, "fill the empty nodes first")
        if self.sigma is not None:
            sigma = np.array(self.sigma, float)
            if sigma.shape != values.shape:
                raise InputError(
                    f"sigma has shape {sigma.shape} and the values {values.shape}",
                    where=where,
                    do="give one sigma for each value",
                )
            bad = ~np.isfinite(sigma) | (sigma < 0)
            _refuse(bad, sigma, "sigma", where, "give a finite sigma, zero or above")
            object.__setattr__(self, "sigma", sigma)
        first, step = as_pair(self.first), as_pair(self.step)
        if not (np.isfinite(first).all() and np.isfinite(step).all() and min(step) > 0):
            raise InputError(
                f"node [0, 0] at {first} and steps of {step} pixels make no grid",
                where=where,
                do="give finite pixels and steps above zero",
            )
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "first", first)
        object.__setattr__(self, "step", step)

    @property
    def label(self) -> str:
        """Chip and filter of the table in words, for messages."""
        return f"of chip {self.chip}" + (f", filter {self.filter}" if self.filter else "")

    @property
    def shape(self) -> tuple[int, int]:
        """Nodes along y and x: (ny, nx)."""
        ny, nx = self.values.shape[1:]
        return ny, nx

    def nodes(self) -> tuple[Float, Float]:
        """Pixels of the nodes, FITS 1-based: x (nx,) and y (ny,)."""
        ny, nx = self.shape
        x: Float = self.first[0] + self.step[0] * np.arange(nx, dtype=float)
        y: Float = self.first[1] + self.step[1] * np.arange(ny, dtype=float)
        return x, y

    def weights(self, x: ArrayLike, y: ArrayLike) -> tuple[Int, Float]:
        """Nodes that a pixel is interpolated from, and their weights.

        Parameters
        ----------
        x, y : array_like, shape (N,)
            FITS 1-based pixels.

        Returns
        -------
        index : ndarray of int64, shape (N, 4)
            Into the node values flattened as ``values.reshape(2, -1)``.
        weight : ndarray, shape (N, 4)
            Bilinear, never below 0, sum 1.

        Raises
        ------
        InputError
            When a pixel is not finite.
        """
        ix, fx, _ = self._cell(x, 0)
        iy, fy, _ = self._cell(y, 1)
        nx = self.shape[1]
        corner = iy * nx + ix
        index = np.stack([corner, corner + 1, corner + nx, corner + nx + 1], axis=-1)
        gx, gy = 1 - fx, 1 - fy
        return index, np.stack([gx * gy, fx * gy, gx * fy, fx * fy], axis=-1)

    def evaluate(self, x: ArrayLike, y: ArrayLike) -> Float:
        """Shifts to be added to pixels.

        Parameters
        ----------
        x, y : array_like, shape (N,)
            FITS 1-based pixels.

        Returns
        -------
        ndarray, shape (N, 2)
            Pixels; beyond the outermost nodes the value at the nearest point of the grid.

        Raises
        ------
        InputError
            When a pixel is not finite.
        """
        index, weight = self.weights(x, y)
        flat = self.values.reshape(2, -1)
        return np.stack([(plane[index] * weight).sum(axis=-1) for plane in flat], axis=-1)

    def gradient(self, x: ArrayLike, y: ArrayLike) -> Float:
        """Derivatives of the corrected pixel by the pixel.

        Along each axis constant between nodes; on a node that of the cell above it.

        Parameters
        ----------
        x, y : array_like, shape (N,)
            FITS 1-based pixels.

        Returns
        -------
        ndarray, shape (N, 2, 2)
            [[dx'/dx, dx'/dy], [dy'/dx, dy'/dy]]: the identity where the table is flat.

        Raises
        ------
        InputError
            When a pixel is not finite.
        """
        ix, fx, in_x = self._cell(x, 0)
        iy, fy, in_y = self._cell(y, 1)
        out = np.empty((ix.size, 2, 2))
        for a, plane in enumerate(self.values):
            v00, v01 = plane[iy, ix], plane[iy, ix + 1]
            v10, v11 = plane[iy + 1, ix], plane[iy + 1, ix + 1]
            out[:, a, 0] = in_x * ((v01 - v00) * (1 - fy) + (v11 - v10) * fy) / self.step[0]
            out[:, a, 1] = in_y * ((v10 - v00) * (1 - fx) + (v11 - v01) * fx) / self.step[1]
            out[:, a, a] += 1.0
        return out

    def _cell(self, pixel: ArrayLike, axis: int) -> tuple[Int, Float, Bool]:
        """Lower node, fraction of the step above it, and a mask of the pixels on the grid."""
        pixel = np.atleast_1d(np.asarray(pixel, float))
        if not np.isfinite(pixel).all():
            raise InputError(
                f"a pixel {'xy'[axis]} is not finite",
                where=f"look-up table {self.label}",
                do="drop such rows first",
            )
        n = self.values.shape[2 - axis]
        node = (pixel - self.first[axis]) / self.step[axis]
        inside = (node >= 0) & (node < n - 1)
        node = np.clip(node, 0, n - 1)
        lower = np.minimum(node.astype(np.int64), n - 2)
        return lower, node - lower, inside


def corrected(
    tables: Sequence[LookupTable],
    x: ArrayLike,
    y: ArrayLike,
    *,
    chip: ArrayLike,
    filter: ArrayLike = "",
) -> tuple[Float, Float]:
    """Pixels after the look-up tables: the detector's first, then the filter's.

    Parameters
    ----------
    tables : sequence of LookupTable
        At most one for each chip and filter.  A chip or a filter without table is left as it is.
    x, y : array_like, shape (N,)
        FITS 1-based pixels.
    chip : int or array_like, shape (N,)
        Chip numbers.
    filter : str or array_like, shape (N,)
        Filters; '' asks for the detector's table alone.

    Returns
    -------
    x, y : ndarray, shape (N,)
        New arrays.

    Raises
    ------
    InputError
        When two tables have the same chip and filter, or a pixel is not finite.

    Notes
    -----
    The filter's table is evaluated at the pixel that the detector's table has corrected.
    """
    count = Counter((table.chip, table.filter) for table in tables)
    for table in tables:
        if count[table.chip, table.filter] > 1:
            raise InputError(
                f"{count[table.chip, table.filter]} look-up tables {table.label}",
                do="give one at most for each chip and filter",
            )
    x, y = np.broadcast_arrays(np.atleast_1d(np.asarray(x, float)), np.asarray(y, float))
    x, y = x.copy(), y.copy()
    chips = np.broadcast_to(np.asarray(chip), x.shape)
    filters = np.broadcast_to(np.asarray(filter, dtype=str), x.shape)
    for table in sorted(tables, key=lambda table: table.filter != ""):
        rows = chips == table.chip
        if table.filter:
            rows &= filters == table.filter
        if rows.any():
            shift = table.evaluate(x[rows], y[rows])
            x[rows] += shift[:, 0]
            y[rows] += shift[:, 1]
    return x, y


def _refuse(bad: Bool, array: Float, what: str, where: str, do: str) -> None:
    """Refuse a table with a bad node, naming the first."""
    if bad.any():
        axis, row, column = np.argwhere(bad)[0]
        raise InputError(
            f"the {what} of {'xy'[axis]} at node row {row + 1}, column {column + 1} is "
            f"{array[axis, row, column]}" + (f" and {bad.sum() - 1} more" if bad.sum() > 1 else ""),
            where=where,
            do=do,
        )
