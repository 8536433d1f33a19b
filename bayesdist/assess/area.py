"""Area that a pixel covers in (u, v), relative to the one at the reference pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.grid import DEFAULT_GRID, grid_pixels, mesh
from bayesdist.assess.solution import Place, Solution, place_of, point_blocks
from bayesdist.errors import InputError

__all__ = ["AreaMap", "area_map"]

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
    det_ref, d_ref = _determinant(place, polynomial, *np.array(place.chip.reference_pixel)[:, None])
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
        det, d = _determinant(place, polynomial, X[rows], Y[rows])
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


def _determinant(place: Place, polynomial: Float, x: Float, y: Float) -> tuple[Float, Float]:
    """det d(u, v) / d(x, y), (N,), and its derivative (N, 2 K) by the coefficients."""
    px, py = place.gradient(x, y)
    (ux, vx), (uy, vy) = polynomial @ px.T, polynomial @ py.T
    by_u = vy[:, None] * px - vx[:, None] * py
    by_v = ux[:, None] * py - uy[:, None] * px
    return ux * vy - uy * vx, np.concatenate([by_u, by_v], axis=1)
