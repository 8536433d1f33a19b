"""Maps over the detector: uncertainty of positions, circular errors, and relative pixel areas.

The uncertainty of a position is the standard deviation of u and v; a circular error is the radius
that contains the true position with a given probability. Areas of pixels in (u, v) are relative to
that of the reference pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from bayesdist.assess.solution import place_of
from bayesdist.calibration.area import determinant
from bayesdist.calibration.calibration import calibration_of
from bayesdist.calibration.chip_map import position_moments
from bayesdist.errors import InputError, required
from bayesdist.infer.solution.solution import Solution
from bayesdist.model.basis import point_blocks
from bayesdist.model.grid import DEFAULT_GRID, grid_pixels, mesh, position_of_largest
from bayesdist.utils.arrays import Float
from bayesdist.utils.quantities import Epoch, takes, year_of

RELATIVE = "relative positions"
NODES = 33  # number of axis ratios between which radii are interpolated, accurate to 1e-4
ANGLES = 256  # number of angles of the integral over the error ellipse


@dataclass(frozen=True, eq=False)
class UncertaintyMap:
    """Standard deviation of the model's position over the detector.

    Parameters
    ----------
    x : ndarray, shape (nx,)
        FITS 1-based columns.
    y : ndarray, shape (ny,)
        FITS 1-based rows.
    sigma_u, sigma_v : ndarray, shape (ny, nx)
        Standard deviations in `unit`; NaN at positions outside the field that sees the sky.
    correlation : ndarray, shape (ny, nx)
        Correlation between u and v; 0 where one of them is known exactly.
    unit : str
        Unit of the standard deviations.
    chip : int
        Chip number.
    epoch : float or None
        Decimal years.
    kind : str
        'least squares', 'posterior', or `RELATIVE` for a posterior without the directions that the
        gauge determines.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> rng = np.random.default_rng(1)
    >>> matches, truth = simulate_wise(500, rng=rng)
    >>> model = bd.build_model(matches, order=2, size=(1016, 1016))
    >>> fit = bd.fit_linear(matches, model)
    >>> found = bd.uncertainty_map(fit, grid=(5, 3))
    >>> bool(found.radius_max >= found.sigma_u.max())
    True
    """

    x: Float
    y: Float
    sigma_u: Float
    sigma_v: Float
    correlation: Float
    unit: str
    chip: int
    epoch: float | None
    kind: str

    def __repr__(self) -> str:
        x, y = position_of_largest(self.per_axis, self.x, self.y)
        when = "" if self.epoch is None else f" in {self.epoch:.2f}"
        largest = float(np.nanmax(self.per_axis))
        return (
            f"UncertaintyMap({self.kind}, chip {self.chip}{when}, {self.x.size} x {self.y.size} "
            f"positions: at most {largest:.3g} {self.unit} per axis, at pixel "
            f"({x:g}, {y:g}))"
        )

    @property
    def radius(self) -> Float:
        """hypot(sigma_u, sigma_v), (ny, nx), in `unit`: half the diagonal of the error box."""
        return np.hypot(self.sigma_u, self.sigma_v)

    @property
    def per_axis(self) -> Float:
        """Rms of sigma_u and sigma_v, (ny, nx), in `unit`: the standard deviation per axis."""
        return per_axis(self.sigma_u, self.sigma_v)

    def circular_error(self, probability: float) -> Float:
        """Radius (ny, nx) of the circle that contains the true position with a given probability.

        Parameters
        ----------
        probability : float
            Between 0 and 1.

        Returns
        -------
        ndarray, shape (ny, nx)
        """
        return circular_error(self.sigma_u, self.sigma_v, self.correlation, probability)

    @property
    def radius_max(self) -> float:
        """Largest radius, in `unit`: the "max radius" of WSDC D-T033, section 6."""
        return float(np.nanmax(self.radius))

    @property
    def position_of_max(self) -> tuple[float, float]:
        """Pixel (x, y) of the largest radius."""
        return position_of_largest(self.radius, self.x, self.y)

    @property
    def sigma_u_max(self) -> float:
        """Largest sigma_u, in `unit`."""
        return float(np.nanmax(self.sigma_u))

    @property
    def sigma_v_max(self) -> float:
        """Largest sigma_v, in `unit`."""
        return float(np.nanmax(self.sigma_v))


def sigmas_of(uu: Float, vv: Float, uv: Float) -> tuple[Float, Float, Float]:
    """Standard deviations (N,) of u and v and their correlation, from variances and covariance.

    `uu`, `vv` and `uv` have shape (N,).  The correlation is 0 if a position is known exactly.
    """
    sigma_u, sigma_v = np.sqrt(uu), np.sqrt(vv)
    product = sigma_u * sigma_v
    correlation = np.divide(uv, product, out=np.zeros_like(uv), where=product > 0)
    return sigma_u, sigma_v, np.clip(correlation, -1.0, 1.0)


def with_local(found: UncertaintyMap, sigma: Float | None) -> UncertaintyMap:
    """Add the structure that the model omits to a map; unchanged if `sigma` is None.

    `sigma`: standard deviations of u and v at the points of the map, shape (ny nx, 2).
    """
    if sigma is None:
        return found
    u, v = sigma.T.reshape(2, *found.sigma_u.shape)
    sigma_u, sigma_v = np.hypot(found.sigma_u, u), np.hypot(found.sigma_v, v)
    return replace(
        found,
        sigma_u=sigma_u,
        sigma_v=sigma_v,
        correlation=found.correlation * found.sigma_u * found.sigma_v / (sigma_u * sigma_v),
    )


@takes(solution=Solution)
def uncertainty_map(
    solution: Solution,
    *,
    grid: tuple[int, int] = DEFAULT_GRID,
    epoch: Epoch | None = None,
    chip: int | None = None,
    exposure: int | str | None = None,
) -> UncertaintyMap:
    """Uncertainty of the predicted position, J cov J^T, over a grid.

    Parameters
    ----------
    solution : LinearFit or Posterior
    grid : tuple of int
        Number of points along x and y.
    epoch : float, str, Time, date or Quantity, optional
        Required if the model depends on time.
    chip : int, optional
        Chip number; the first chip by default.
    exposure : int or str, optional
        Code or name of the exposure that defines the frame of the positions; by default the frame
        of the gauge.

    Returns
    -------
    UncertaintyMap

    Raises
    ------
    InputError
        If the chip or exposure is unknown, the epoch is missing, or the grid is invalid.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> rng = np.random.default_rng(1)
    >>> matches, truth = simulate_wise(500, rng=rng)
    >>> model = bd.build_model(matches, order=2, size=(1016, 1016))
    >>> fit = bd.fit_linear(matches, model)
    >>> found = bd.uncertainty_map(fit, grid=(5, 3))
    >>> found.sigma_u.shape
    (3, 5)
    """
    year = None if epoch is None else year_of(epoch)
    place = place_of(solution.model, epoch=year, exposure=exposure, chip=chip)
    x, y = grid_pixels(place.chip.size, grid)
    uu, vv, uv = position_moments(place.covariance(solution), place.basis, *mesh(x, y))
    shape = (y.size, x.size)
    sigma_u, sigma_v, correlation = (values.reshape(shape) for values in sigmas_of(uu, vv, uv))
    return UncertaintyMap(
        x=x,
        y=y,
        sigma_u=sigma_u,
        sigma_v=sigma_v,
        correlation=correlation,
        unit=solution.model.unit,
        chip=place.chip.number,
        epoch=place.epoch,
        kind=solution.kind,
    )


def per_axis(sigma_u: ArrayLike, sigma_v: ArrayLike) -> Float:
    """Rms of the standard deviations of both axes, independent of their orientation.

    `sigma_u` and `sigma_v` have the same shape and unit, which are also those of the result.
    """
    return np.asarray(np.hypot(sigma_u, sigma_v) / np.sqrt(2.0))


def circular_error(
    sigma_u: ArrayLike, sigma_v: ArrayLike, correlation: ArrayLike, probability: float
) -> Float:
    """Radius of the circle about the true position that has a given probability: CE68, CE95.

    Parameters
    ----------
    sigma_u, sigma_v : array_like
        Standard deviations in the same unit, which is also that of the result.
    correlation : array_like
        Correlation between u and v.
    probability : float
        Between 0 and 1.

    Returns
    -------
    ndarray, shape of the arguments
        Radius.

    Examples
    --------
    >>> float(circular_error(1.0, 1.0, 0.0, 0.68).round(3))
    1.51
    """
    u, v = np.square(sigma_u), np.square(sigma_v)
    middle, half = (u + v) / 2, (u - v) / 2
    spread = np.hypot(half, np.multiply(correlation, np.sqrt(u * v)))
    major, minor = np.sqrt(middle + spread), np.sqrt(np.maximum(middle - spread, 0.0))
    ratio = np.divide(minor, major, out=np.ones_like(major), where=major > 0)
    return np.asarray(major * _radii(probability)(ratio))


@cache
def _radii(probability: float) -> CubicSpline:
    """Radius in units of the major axis, as a function of the axis ratio minor / major."""
    ratios = np.linspace(0.0, 1.0, NODES)
    angle = (np.arange(ANGLES) + 0.5) * np.pi / (2 * ANGLES)

    def outside(radius: float, ratio: float) -> float:
        square = np.cos(angle) ** 2 + (ratio * np.sin(angle)) ** 2
        return float(np.exp(-0.5 * radius**2 / square).mean())

    return CubicSpline(
        ratios,
        [brentq(lambda r, k=k: outside(r, k) - (1 - probability), 1e-3, 10.0) for k in ratios],
    )


@dataclass(frozen=True, eq=False)
class AreaMap:
    """Relative pixel area over the detector.

    Parameters
    ----------
    x : ndarray, shape (nx,)
        FITS 1-based columns.
    y : ndarray, shape (ny,)
        FITS 1-based rows.
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

    Multiply flat-fielded photometry by this map, as in Figure 4.5 of section 4.1 of the HST
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
