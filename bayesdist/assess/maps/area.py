"""Area of a pixel in (u, v), relative to that of the reference pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.calibration.area import determinant
from bayesdist.calibration.calibration import calibration_of
from bayesdist.errors import InputError, required
from bayesdist.infer.solution.solution import Solution
from bayesdist.model.basis import point_blocks
from bayesdist.model.grid import DEFAULT_GRID, grid_pixels, mesh
from bayesdist.utils.arrays import Float


@dataclass(frozen=True, eq=False)
class AreaMap:
    """Relative pixel area over the detector.

    Parameters
    ----------
    x : ndarray, shape (nx,)
    y : ndarray, shape (ny,)
        FITS 1-based pixels.
    area : ndarray, shape (ny, nx)
        ``|det d(u, v) / d(x, y)|`` divided by its value at the reference pixel.
    sigma : ndarray, shape (ny, nx)
        Standard deviation of `area`; 0 at the reference pixel by definition.
    reference_area : float
        Area of the reference pixel, in `unit` squared.
    unit : str
        Unit of u and v.
    chip : int
        Chip number.
    epoch : float or None
        Decimal years.
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
    """Relative pixel area, with its uncertainty by linear error propagation.

    Multiply flat-fielded photometry by this map, as in Figure 4.5 of section 4.1 of the ACS
    handbook. The frame of an exposure is linear and cancels, so the map is valid for all exposures.

    Parameters
    ----------
    solution : LinearFit or Posterior
    grid : tuple of int
        Number of points along x and y.
    epoch : float, optional
        Decimal years; required if the model depends on time.
    chip : int, optional
        Chip number; the first chip by default.

    Returns
    -------
    AreaMap

    Raises
    ------
    InputError
        If the mapping is singular at the reference pixel, the chip is unknown, the epoch is
        missing, or the grid is invalid.
    """
    chip_map = calibration_of(solution).chip(chip, epoch, origin="stated")
    basis, covariance = chip_map.basis, required(chip_map.cov, "the solution has no covariance")
    det_ref, d_ref = determinant(
        basis, chip_map.coefficients, *np.array(basis.reference_pixel)[:, None]
    )
    if det_ref[0] == 0.0:
        raise InputError(
            "the pixel area is zero at the reference pixel",
            where=f"chip {chip_map.chip}",
            do="check the linear terms of the solution and model.reference_pixel",
        )
    x, y = grid_pixels(basis.size, grid)
    X, Y = mesh(x, y)
    area, sigma = np.empty(X.size), np.empty(X.size)
    for rows in point_blocks(X.size):
        det, d = determinant(basis, chip_map.coefficients, X[rows], Y[rows])
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
        unit=chip_map.unit,
        chip=chip_map.chip or 1,
        epoch=chip_map.epoch,
    )
