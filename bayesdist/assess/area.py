"""Area that a pixel covers in (u, v), by itself and relative to that at the reference pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike, NDArray

from bayesdist.assess.calibration import Calibration
from bayesdist.assess.grid import DEFAULT_GRID, grid_pixels, mesh
from bayesdist.assess.solution import Solution, place_of, point_blocks
from bayesdist.errors import InputError
from bayesdist.model import PolynomialBasis

__all__ = ["AreaMap", "area_map", "determinant", "pixel_areas"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class AreaMap:
    """Relative pixel area over the detector.

    Parameters
    ----------
    x : ndarray, shape (nx,)
    y : ndarray, shape (ny,)
        FITS 1-based pixels.
    area : ndarray, shape (ny, nx)
        ``|det d(u, v) / d(x, y)|`` over its value at the reference pixel.
    sigma : ndarray, shape (ny, nx)
        Standard deviation of `area`; 0 at the reference pixel by definition.
    reference_area : float
        Area of the reference pixel, in `unit` squared.
    unit : str
        Unit of u and v.
    chip : int
    epoch : float or None
    """

    x: Float
    y: Float
    area: Float
    sigma: Float
    reference_area: float
    unit: str
    chip: int
    epoch: float | None


def area_map(
    solution: Solution,
    *,
    grid: tuple[int, int] = DEFAULT_GRID,
    epoch: float | None = None,
    chip: int | None = None,
) -> AreaMap:
    """Relative pixel area, with its uncertainty by the delta method.

    The map to multiply flat-fielded photometry with, as in Figure 4.5 of section 4.1 of the ACS
    handbook.  The frame of an exposure is linear and cancels, so it is the same for all exposures.

    Parameters
    ----------
    solution : LinearFit or Posterior
    grid : tuple of int
        Points on x and y.
    epoch : float, optional
        Decimal years; needed by a model with time dependence.
    chip : int, optional
        Chip number; the first chip by default.

    Returns
    -------
    AreaMap

    Raises
    ------
    InputError
        When the mapping is singular at the reference pixel, for an unknown chip, a missing epoch,
        or a bad grid.
    """
    place = place_of(solution.model, epoch=epoch, chip=chip)
    polynomial = place.polynomial(solution.mean)
    covariance = place.covariance(solution).reshape(2 * polynomial.shape[1], -1)
    det_ref, d_ref = determinant(
        place.basis, polynomial, *np.array(place.chip.reference_pixel)[:, None]
    )
    if det_ref[0] == 0.0:
        raise InputError(
            "the pixel area is zero at the reference pixel",
            where=f"chip {place.chip.number}",
            do="check the linear terms of the solution and model.reference_pixel",
        )
    x, y = grid_pixels(place.chip.size, grid)
    X, Y = mesh(x, y)
    area, sigma = np.empty(X.size), np.empty(X.size)
    for rows in point_blocks(X.size):
        det, d = determinant(place.basis, polynomial, X[rows], Y[rows])
        ratio = det / det_ref
        slope = d / det_ref - (ratio / det_ref)[:, None] * d_ref
        area[rows] = np.abs(ratio)
        sigma[rows] = np.sqrt(np.maximum(np.einsum("nk,nk->n", slope @ covariance, slope), 0.0))
    return AreaMap(
        x=x,
        y=y,
        area=area.reshape(y.size, x.size),
        sigma=sigma.reshape(y.size, x.size),
        reference_area=abs(float(det_ref[0])),
        unit=solution.model.unit,
        chip=place.chip.number,
        epoch=place.epoch,
    )


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


def pixel_areas(calibration: Calibration, x: ArrayLike, y: ArrayLike) -> tuple[Float, Float | None]:
    """Area of every pixel of a grid, however fine, in the unit of the calibration squared.

    Parameters
    ----------
    calibration : Calibration
    x : array_like, shape (nx,)
    y : array_like, shape (ny,)
        FITS 1-based pixels.

    Returns
    -------
    area : ndarray, shape (ny, nx)
        ``|det d(u, v) / d(x, y)|``.
    sigma : ndarray, shape (ny, nx), or None
        Its standard deviation; None where the calibration has no errors.

    Notes
    -----
    The determinant is a polynomial of order 2 (n - 1) and its variance one of 4 (n - 1), so that
    both follow exactly from as few nodes as such polynomials need.
    """
    basis = calibration.basis
    nodes, weights = legendre.leggauss(4 * (basis.order - 1) + 1)
    X, Y = mesh(nodes, nodes)
    (half_x, half_y), (nx, ny) = basis.half_size, basis.size
    det, d = determinant(
        basis, calibration.coefficients, X * half_x + (nx + 1) / 2, Y * half_y + (ny + 1) / 2
    )
    at = basis.scaled(x, y)
    area = np.abs(_through_nodes(det, nodes, weights, *at))
    if calibration.cov is None:
        return area, None
    variance = np.einsum("nk,nk->n", d @ calibration.cov, d)
    return area, np.sqrt(np.maximum(_through_nodes(variance, nodes, weights, *at), 0.0))


def _through_nodes(values: Float, nodes: Float, weights: Float, X: Float, Y: Float) -> Float:
    """The polynomial (Y.size, X.size) through values on a square of Gauss-Legendre nodes."""
    n = nodes.size
    to_coefficients = legendre.legvander(nodes, n - 1).T * weights * (np.arange(n) + 0.5)[:, None]
    c = to_coefficients @ values.reshape(n, n) @ to_coefficients.T  # rows go with y
    return legendre.legvander(Y, n - 1) @ c @ legendre.legvander(X, n - 1).T
