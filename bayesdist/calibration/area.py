"""Area of pixels in (u, v), and pixel area maps.

A map holds the area of each pixel on the sky over that of a corrected pixel, SCALE squared.  Flat
fields make the sky look even, which divides each pixel by its area; the map undoes this, so that
photometry agrees with that of drizzled images.  So are those of ACS, without velocity aberration.
Those of WFC3 are relative to the area at one pixel instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike, NDArray

from bayesdist.calibration.chip_map import ChipMap
from bayesdist.calibration.subarray import FULL, Subarray
from bayesdist.errors import InputError
from bayesdist.model import PolynomialBasis

__all__ = ["PixelAreaMap", "determinant", "pixel_area_map", "pixel_areas"]

Float = NDArray[np.float64]

_MAGNITUDES = 2.5 / np.log(10.0)


def determinant(
    basis: PolynomialBasis, polynomial: Float, x: Float, y: Float
) -> tuple[Float, Float]:
    """Determinant of the derivatives of two polynomials.

    Parameters
    ----------
    basis : PolynomialBasis
    polynomial : ndarray, shape (2, K)
        Coefficients of u and v.
    x, y : ndarray, shape (N,)
        FITS 1-based pixels.

    Returns
    -------
    det : ndarray, shape (N,)
        det d(u, v) / d(x, y).
    derivative : ndarray, shape (N, 2 K)
        Its derivatives by the coefficients.
    """
    px, py = basis.gradient(x, y)
    (ux, vx), (uy, vy) = polynomial @ px.T, polynomial @ py.T
    by_u = vy[:, None] * px - vx[:, None] * py
    by_v = ux[:, None] * py - uy[:, None] * px
    return ux * vy - uy * vx, np.concatenate([by_u, by_v], axis=1)


def pixel_areas(chip: ChipMap, x: ArrayLike, y: ArrayLike) -> tuple[Float, Float | None]:
    """Area of every pixel of a grid, however fine, in the unit of the map squared.

    Parameters
    ----------
    chip : ChipMap
    x : array_like, shape (nx,)
    y : array_like, shape (ny,)
        FITS 1-based pixels.

    Returns
    -------
    area : ndarray, shape (ny, nx)
        ``|det d(u, v) / d(x, y)|``.
    sigma : ndarray, shape (ny, nx), or None
        Its standard deviation; None where the map has no errors.

    Notes
    -----
    The determinant is a polynomial of order 2 (n - 1) and its variance one of 4 (n - 1), so that
    both follow exactly from as few nodes as such polynomials need.
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
    if chip.cov is None:
        return area, None
    variance = np.einsum("nk,nk->n", d @ chip.cov, d)
    return area, np.sqrt(np.maximum(_through_nodes(variance, nodes, weights, *at), 0.0))


def _through_nodes(values: Float, nodes: Float, weights: Float, X: Float, Y: Float) -> Float:
    """The polynomial (Y.size, X.size) through values on a square of Gauss-Legendre nodes."""
    n = nodes.size
    to_coefficients = legendre.legvander(nodes, n - 1).T * weights * (np.arange(n) + 0.5)[:, None]
    c = to_coefficients @ values.reshape(n, n) @ to_coefficients.T  # rows go with y
    return legendre.legvander(Y, n - 1) @ c @ legendre.legvander(X, n - 1).T


@dataclass(frozen=True, eq=False)
class PixelAreaMap:
    """Relative pixel areas of one image.

    Parameters
    ----------
    chip : int
    area : ndarray, shape (ny, nx)
        Over that of a corrected pixel.
    sigma : ndarray, shape (ny, nx), or None
        Standard deviation; None where the calibration has no errors.
    scale : float
        Size of the corrected pixel.
    unit : str
        Its unit, that of the calibration.
    image : Subarray
    epoch : float or None
        Decimal years.
    """

    chip: int
    area: Float
    sigma: Float | None
    scale: float
    unit: str
    image: Subarray
    epoch: float | None

    @property
    def magnitude(self) -> Float:
        """What the map adds to the magnitude of a point source, (ny, nx)."""
        return -2.5 * np.log10(self.area)

    @property
    def sigma_magnitude(self) -> Float | None:
        """Standard deviation of `magnitude`."""
        return None if self.sigma is None else _MAGNITUDES * self.sigma / self.area


def pixel_area_map(chip: ChipMap, scale: float, *, image: Subarray = FULL) -> PixelAreaMap:
    """The pixel area map of a chip, or of a part of it.

    Parameters
    ----------
    chip : ChipMap
    scale : float
        Size of a corrected pixel, in the unit of the calibration.
    image : Subarray
        With its size, unless it is the whole chip.

    Returns
    -------
    PixelAreaMap

    Raises
    ------
    InputError
        For a scale that is not positive, or a subarray without size or beyond the chip.
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
    """Pixels of the chip, columns and rows, that an image shows."""
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
