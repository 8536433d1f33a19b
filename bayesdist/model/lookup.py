"""Look-up tables for the part of the distortion that polynomials cannot describe.

A table contains small shifts of the pixel position at the nodes of a grid.  Between nodes it is
interpolated bilinearly, and beyond the outermost nodes it is constant, exactly as astropy.wcs and
the HST pipeline apply a D2IMFILE.

    x' = x + D_chip(x, y)             detector table, valid for all filters
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
    """Shifts of the pixel position at the nodes of a regular grid on one chip.

    Parameters
    ----------
    chip : int
        Chip number.
    values : array_like, shape (2, ny, nx)
        Shifts in pixels, *added* to x (first plane) and to y (second plane).
    filter : str
        Filter to which the table applies; '' is the detector table, which applies to all filters.
    first : tuple of float
        Pixel (x, y) of node [0, 0], FITS 1-based.  The default is the centre of a bin of 64 pixels.
    step : tuple of float
        Distance of the nodes along x and y, in pixels.
    sigma : array_like, shape (2, ny, nx), optional
        Standard error of each node value, in pixels.  Errors of interpolated shifts are not
        available, since they require the covariance of the nodes.

    Raises
    ------
    InputError
        If an array has a wrong shape, a value is not finite, a sigma is negative, or a step is not
        positive.

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
        location = f"look-up table {self.label}"
        if values.ndim != 3 or values.shape[0] != 2 or min(values.shape[1:]) < 2:
            raise InputError(
                f"the values have shape {values.shape}",
                where=location,
                do="give an array (2, ny, nx) with at least two nodes along each axis",
            )
        _refuse(~np.isfinite(values), values, "value", location, "fill the empty nodes first")
        if self.sigma is not None:
            sigma = np.array(self.sigma, float)
            if sigma.shape != values.shape:
                raise InputError(
                    f"sigma has shape {sigma.shape}, but the values have {values.shape}",
                    where=location,
                    do="give one sigma for each value",
                )
            bad = ~np.isfinite(sigma) | (sigma < 0)
            _refuse(bad, sigma, "sigma", location, "give a finite sigma of at least zero")
            object.__setattr__(self, "sigma", sigma)
        first, step = as_pair(self.first), as_pair(self.step)
        if not (np.isfinite(first).all() and np.isfinite(step).all() and min(step) > 0):
            raise InputError(
                f"node [0, 0] at {first} and steps of {step} pixels do not define a grid",
                where=location,
                do="give a finite pixel and positive steps",
            )
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "first", first)
        object.__setattr__(self, "step", step)

    @property
    def label(self) -> str:
        """Chip and filter of the table, for messages."""
        return f"of chip {self.chip}" + (f", filter {self.filter}" if self.filter else "")

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of nodes along y and x: (ny, nx)."""
        ny, nx = self.values.shape[1:]
        return ny, nx

    def nodes(self) -> tuple[Float, Float]:
        """Pixel coordinates x (nx,) and y (ny,) of the nodes, FITS 1-based."""
        ny, nx = self.shape
        x: Float = self.first[0] + self.step[0] * np.arange(nx, dtype=float)
        y: Float = self.first[1] + self.step[1] * np.arange(ny, dtype=float)
        return x, y

    def weights(self, x: ArrayLike, y: ArrayLike) -> tuple[Int, Float]:
        """Nodes and weights for the bilinear interpolation at pixel positions.

        Parameters
        ----------
        x, y : array_like, shape (N,)
            FITS 1-based pixels.

        Returns
        -------
        index : ndarray of int64, shape (N, 4)
            Indices of the nodes in ``values.reshape(2, -1)``.
        weight : ndarray, shape (N, 4)
            Weights of the nodes; they are not negative and their sum is 1.

        Raises
        ------
        InputError
            If a pixel is not finite.
        """
        ix, fx, _ = self._cell(x, 0)
        iy, fy, _ = self._cell(y, 1)
        nx = self.shape[1]
        corner = iy * nx + ix
        index = np.stack([corner, corner + 1, corner + nx, corner + nx + 1], axis=-1)
        gx, gy = 1 - fx, 1 - fy
        return index, np.stack([gx * gy, fx * gy, gx * fy, fx * fy], axis=-1)

    def evaluate(self, x: ArrayLike, y: ArrayLike) -> Float:
        """Interpolated shifts, to be added to the pixel positions.

        Parameters
        ----------
        x, y : array_like, shape (N,)
            FITS 1-based pixels.

        Returns
        -------
        ndarray, shape (N, 2)
            Shifts in pixels.  Beyond the outermost nodes this is the value at the nearest point of
            the grid.

        Raises
        ------
        InputError
            If a pixel is not finite.
        """
        index, weight = self.weights(x, y)
        flat = self.values.reshape(2, -1)
        return np.stack([(plane[index] * weight).sum(axis=-1) for plane in flat], axis=-1)

    def gradient(self, x: ArrayLike, y: ArrayLike) -> Float:
        """Derivatives of the corrected with respect to the original pixel position.

        The derivative along an axis is constant along it between nodes.  At a node it is that of
        the cell with the higher pixel coordinates.

        Parameters
        ----------
        x, y : array_like, shape (N,)
            FITS 1-based pixels.

        Returns
        -------
        ndarray, shape (N, 2, 2)
            [[dx'/dx, dx'/dy], [dy'/dx, dy'/dy]]; the identity if the table is constant.

        Raises
        ------
        InputError
            If a pixel is not finite.
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
        """Lower node, distance from it in steps, and a mask that is True inside the grid."""
        pixel = np.atleast_1d(np.asarray(pixel, float))
        if not np.isfinite(pixel).all():
            raise InputError(
                f"a pixel coordinate {'xy'[axis]} is not finite",
                where=f"look-up table {self.label}",
                do="remove such rows first",
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
    """Apply look-up tables to pixel positions: first the detector table, then the filter table.

    The filter table is evaluated at the pixel that was corrected with the detector table.

    Parameters
    ----------
    tables : sequence of LookupTable
        At most one table per chip and filter.  Pixels of a chip or filter without a table are not
        changed.
    x, y : array_like, shape (N,)
        FITS 1-based pixels.
    chip : int or array_like, shape (N,)
        Chip numbers.
    filter : str or array_like, shape (N,)
        Filters; with '' only the detector table is applied.

    Returns
    -------
    x, y : ndarray, shape (N,)
        Corrected pixels, FITS 1-based; the input arrays are not modified.

    Raises
    ------
    InputError
        If two tables have the same chip and filter, or a pixel is not finite.
    """
    count = Counter((table.chip, table.filter) for table in tables)
    for table in tables:
        if count[table.chip, table.filter] > 1:
            raise InputError(
                f"there are {count[table.chip, table.filter]} look-up tables {table.label}",
                do="give at most one for each chip and filter",
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
    """Raise an error that names the first invalid node of a table, if there is one."""
    if bad.any():
        axis, row, column = np.argwhere(bad)[0]
        raise InputError(
            f"the {what} of {'xy'[axis]} at node row {row + 1}, column {column + 1} is "
            f"{array[axis, row, column]}" + (f" and {bad.sum() - 1} more" if bad.sum() > 1 else ""),
            where=where,
            do=do,
        )
