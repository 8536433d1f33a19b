"""Areas of pixels in (u, v), and pixel area maps.

A pixel area map is the area of each pixel on the sky relative to that of a corrected pixel, SCALE
squared.  Flat-fielding makes the sky background uniform and thereby divides each pixel by its
area.  Multiplication by the map reverses this, so that photometry agrees with that of drizzled
images.  Some observatories follow this definition, without velocity aberration; maps of others are
relative to the area of one pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike

from bayesdist.calibration.apply import FULL, Subarray
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.errors import InputError
from bayesdist.model import PolynomialBasis
from bayesdist.utils.arrays import Float

_MAGNITUDES = 2.5 / np.log(10.0)


def determinant(
    basis: PolynomialBasis, polynomial: Float, x: Float, y: Float
) -> tuple[Float, Float]:
    """Jacobian determinants (N,) of (u, v) with respect to (x, y), and their derivatives (N, 2 K).

    The derivatives are with respect to the Legendre coefficients `polynomial` (2, K), u before v.
    x and y (N,) are FITS 1-based pixels.
    """
    px, py = basis.gradient(x, y)
    (ux, vx), (uy, vy) = polynomial @ px.T, polynomial @ py.T
    by_u = vy[:, None] * px - vx[:, None] * py
    by_v = ux[:, None] * py - uy[:, None] * px
    return ux * vy - uy * vx, np.concatenate([by_u, by_v], axis=1)


def pixel_areas(chip: ChipMap, x: ArrayLike, y: ArrayLike) -> tuple[Float, Float | None]:
    """Areas ``|det d(u, v) / d(x, y)|`` of the pixels of a grid, and their standard deviations.

    For a polynomial of order n the determinant is a polynomial of order 2 (n - 1) and its variance
    one of order 4 (n - 1).  Both are therefore obtained exactly from their values at a few
    Gauss-Legendre nodes.  With look-up tables the areas are those of the quadrilaterals between the
    transformed corners of the pixels; the standard deviations are still those of the polynomial.

    Parameters
    ----------
    chip : ChipMap
    x, y : array_like, shape (nx,) and (ny,)
        Columns and rows of the grid, FITS 1-based pixels.

    Returns
    -------
    area : ndarray, shape (ny, nx)
        In the unit of the map squared.
    sigma : ndarray, shape (ny, nx), or None
        None if the map has no errors.
    """
    basis = chip.basis
    nodes, weights = legendre.leggauss(4 * (basis.order - 1) + 1)
    X, Y = (grid.ravel() for grid in np.meshgrid(nodes, nodes))
    (half_x, half_y), (nx, ny) = basis.half_size, basis.size
    det, d = determinant(
        basis, chip.coefficients, X * half_x + (nx + 1) / 2, Y * half_y + (ny + 1) / 2
    )
    at = basis.scaled(x, y)
    area = np.abs(_through_nodes(det, nodes, weights, *at))
    if chip.before or chip.after:
        area = _quadrilaterals(chip, np.asarray(x, float), np.asarray(y, float))
    if chip.cov is None:
        return area, None
    variance = np.einsum("nk,nk->n", d @ chip.cov, d)
    return area, np.sqrt(np.maximum(_through_nodes(variance, nodes, weights, *at), 0.0))


def _quadrilaterals(chip: ChipMap, x: Float, y: Float) -> Float:
    """Areas (ny, nx) of transformed pixels: half the cross product of their diagonals."""
    X, Y = np.meshgrid(x, y)
    corners = [
        chip.at((X + dx).ravel(), (Y + dy).ravel())
        for dx, dy in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))
    ]
    a, b = corners[2] - corners[0], corners[3] - corners[1]
    return np.abs(a[0] * b[1] - a[1] * b[0]).reshape(X.shape) / 2


def _through_nodes(values: Float, nodes: Float, weights: Float, X: Float, Y: Float) -> Float:
    """Interpolate values on a square of Gauss-Legendre nodes to a grid (Y.size, X.size)."""
    n = nodes.size
    to_coefficients = legendre.legvander(nodes, n - 1).T * weights * (np.arange(n) + 0.5)[:, None]
    c = to_coefficients @ values.reshape(n, n) @ to_coefficients.T  # first axis: y
    return legendre.legvander(Y, n - 1) @ c @ legendre.legvander(X, n - 1).T


@dataclass(frozen=True, eq=False)
class PixelAreaMap:
    """Pixel area map of one image."""

    chip: int
    area: Float  # (ny, nx), relative to that of a corrected pixel
    sigma: Float | None  # (ny, nx); None if the calibration has no errors
    scale: float  # size of a corrected pixel, in `unit`
    unit: str  # unit of the calibration
    image: Subarray
    epoch: float | None  # decimal years

    @property
    def magnitude(self) -> Float:
        """Magnitude correction (ny, nx) for point sources: -2.5 log10 of the area."""
        return -2.5 * np.log10(self.area)

    @property
    def sigma_magnitude(self) -> Float | None:
        """Standard deviation (ny, nx) of `magnitude`; None if the calibration has no errors."""
        return None if self.sigma is None else _MAGNITUDES * self.sigma / self.area


def pixel_area_map(chip: ChipMap, scale: float, *, image: Subarray = FULL) -> PixelAreaMap:
    """Pixel area map of a chip or of a subarray.

    Parameters
    ----------
    chip : ChipMap
    scale : float
        Size of a corrected pixel, in the unit of the map.
    image : Subarray
        Subarray of known size; the full chip by default.

    Returns
    -------
    PixelAreaMap

    Raises
    ------
    InputError
        If the scale is not positive, or the size of the subarray is unknown or exceeds the chip.
    """
    number = chip.chip or 1
    location = f"pixel area map of chip {number}"
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"the scale is {scale}", where=location, do="give a positive number")
    x, y = _pixels(chip, image, location)
    area, sigma = pixel_areas(chip, x, y)
    # binning multiplies the areas of image pixels and of corrected pixels by the same factor
    norm = 1.0 / scale**2
    return PixelAreaMap(
        chip=number,
        area=norm * area,
        sigma=None if sigma is None else norm * sigma,
        scale=scale,
        unit=chip.unit,
        image=image,
        epoch=chip.epoch,
    )


def _pixels(chip: ChipMap, image: Subarray, where: str) -> tuple[Float, Float]:
    """Columns and rows of an image, in pixels of the chip."""
    nx, ny = (int(n) for n in chip.basis.size)
    if image.size is None and image != FULL:
        raise InputError("the size of the subarray is unknown", where=where, do="give its size")
    columns, rows = image.size or (nx, ny)
    x, _ = image.to_chip(np.arange(1, columns + 1), 1.0)
    _, y = image.to_chip(1.0, np.arange(1, rows + 1))
    if min(x[0], y[0]) < 0.5 or x[-1] > nx + 0.5 or y[-1] > ny + 0.5:
        raise InputError(
            f"the subarray extends from ({x[0]:g}, {y[0]:g}) to ({x[-1]:g}, {y[-1]:g}), but the "
            f"chip has {nx} x {ny} pixels",
            where=where,
            do="check LTV1 and LTV2, and that the image is calibrated and has no overscan",
        )
    return x, y
