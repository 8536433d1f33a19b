"""Area of pixels in (u, v), and pixel area maps.

A map holds the area of each pixel on the sky over that of a corrected pixel, SCALE squared.  Flat
fields make the sky look even, which divides each pixel by its area; the map undoes this, so that
photometry agrees with that of drizzled images.  ACS's maps are defined in this way, without
velocity aberration.  WFC3's are relative to the area at one pixel instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike

from bayesdist.calibration.chip_map import ChipMap
from bayesdist.calibration.subarray import FULL, Subarray
from bayesdist.errors import InputError
from bayesdist.model import PolynomialBasis
from bayesdist.utils.arrays import Float

_MAGNITUDES = 2.5 / np.log(10.0)


def determinant(
    basis: PolynomialBasis, polynomial: Float, x: Float, y: Float
) -> tuple[Float, Float]:
    """Determinants (N,) of d(u, v) / d(x, y), and derivatives (N, 2 K) by the coefficients."""
    px, py = basis.gradient(x, y)
    (ux, vx), (uy, vy) = polynomial @ px.T, polynomial @ py.T
    by_u = vy[:, None] * px - vx[:, None] * py
    by_v = ux[:, None] * py - uy[:, None] * px
    return ux * vy - uy * vx, np.concatenate([by_u, by_v], axis=1)


def pixel_areas(chip: ChipMap, x: ArrayLike, y: ArrayLike) -> tuple[Float, Float | None]:
    """Areas (ny, nx) of the pixels of a grid, ``|det d(u, v) / d(x, y)|``, and standard deviations.

    In the unit of the map squared; None in place of the deviations where the map has no errors.
    The determinant is a polynomial of order 2 (n - 1) and its variance one of 4 (n - 1), so that
    both follow exactly from as few nodes as such polynomials need.  With look-up tables the areas
    are those of the quadrilaterals that the corners make, and the deviations of the polynomial's.
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
    """Areas (ny, nx) of the images of pixels, by their corners: half the product of diagonals."""
    X, Y = np.meshgrid(x, y)
    corners = [
        chip.at((X + dx).ravel(), (Y + dy).ravel())
        for dx, dy in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))
    ]
    a, b = corners[2] - corners[0], corners[3] - corners[1]
    return np.abs(a[0] * b[1] - a[1] * b[0]).reshape(X.shape) / 2


def _through_nodes(values: Float, nodes: Float, weights: Float, X: Float, Y: Float) -> Float:
    """Polynomial (Y.size, X.size) through values on a square of Gauss-Legendre nodes."""
    n = nodes.size
    to_coefficients = legendre.legvander(nodes, n - 1).T * weights * (np.arange(n) + 0.5)[:, None]
    c = to_coefficients @ values.reshape(n, n) @ to_coefficients.T  # rows go with y
    return legendre.legvander(Y, n - 1) @ c @ legendre.legvander(X, n - 1).T


@dataclass(frozen=True, eq=False)
class PixelAreaMap:
    """Relative pixel areas of one image."""

    chip: int
    area: Float  # (ny, nx), over that of a corrected pixel
    sigma: Float | None  # (ny, nx); None where the calibration has no errors
    scale: float  # size of the corrected pixel
    unit: str  # of the scale and the calibration
    image: Subarray
    epoch: float | None  # decimal years

    @property
    def magnitude(self) -> Float:
        """Change (ny, nx) of a point source's magnitude by the map."""
        return -2.5 * np.log10(self.area)

    @property
    def sigma_magnitude(self) -> Float | None:
        """Standard deviation of `magnitude`."""
        return None if self.sigma is None else _MAGNITUDES * self.sigma / self.area


def pixel_area_map(chip: ChipMap, scale: float, *, image: Subarray = FULL) -> PixelAreaMap:
    """Pixel area map of a chip, or of a subarray with a size, for a corrected pixel of `scale`.

    InputError for a scale that is not positive, or a subarray without size or beyond the chip.
    """
    number = chip.chip or 1
    where = f"pixel area map of chip {number}"
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"the scale is {scale}", where=where, do="give a positive number")
    x, y = _pixels(chip, image, where)
    area, sigma = pixel_areas(chip, x, y)
    # a binned pixel covers several of the chip's, and so does a corrected one of its image
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
    """Columns and rows, in pixels of the chip, that an image shows."""
    nx, ny = (int(n) for n in chip.basis.size)
    if image.size is None and image != FULL:
        raise InputError("the size of the subarray is not known", where=where, do="give it")
    columns, rows = image.size or (nx, ny)
    x, _ = image.to_chip(np.arange(1, columns + 1), 1.0)
    _, y = image.to_chip(1.0, np.arange(1, rows + 1))
    if min(x[0], y[0]) < 0.5 or x[-1] > nx + 0.5 or y[-1] > ny + 0.5:
        raise InputError(
            f"the subarray goes from ({x[0]:g}, {y[0]:g}) to ({x[-1]:g}, {y[-1]:g}), and the chip "
            f"has {nx} x {ny} pixels",
            where=where,
            do="check LTV1 and LTV2, and that the image is a calibrated one without overscan",
        )
    return x, y
