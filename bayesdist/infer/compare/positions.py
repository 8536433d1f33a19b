"""How far two models differ in positions over the array, and how far noise makes them differ."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi_square_distribution

from bayesdist.infer.equations.scaled import chi_square, scaled_cholesky
from bayesdist.model import Chip, DistortionModel

__all__ = [
    "DifferenceField",
    "PositionChange",
    "difference_field",
    "largest_difference",
]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PositionChange:
    """The largest difference of two models over the array, and how likely noise makes one.

    Parameters
    ----------
    largest : float
        Radial, in the unit of u, v.
    at : tuple of float
        Where, FITS 1-based pixels.
    chip : int
        On which chip.
    sigma : float
        Standard error of the difference there, along its direction.
    noise_median, noise_95 : float
        Largest difference over the array that noise alone makes: median and 95th percentile.
    p_value : float
        Share of noise fields with a largest difference of this size: it accounts for the search
        over the array.
    chi2 : float
        Of the whole field with its joint covariance.  The field is as good as its coefficients, so
        this is also the chi-square of these.
    dof : int
    p_field : float
        Probability of a chi-square as large.
    """

    largest: float
    at: tuple[float, float]
    chip: int
    sigma: float
    noise_median: float
    noise_95: float
    p_value: float
    chi2: float
    dof: int
    p_field: float


@dataclass(frozen=True, eq=False)
class DifferenceField:
    """Difference of the positions of two models over one chip.

    Parameters
    ----------
    chip : Chip
    x : ndarray, shape (nx,)
    y : ndarray, shape (ny,)
        FITS 1-based pixels, from edge to edge.
    du, dv : ndarray, shape (ny, nx)
        In the unit of u, v.
    p_value : ndarray, shape (ny, nx)
        Probability of as long a vector by noise, at each place by itself.
    """

    chip: Chip
    x: Float
    y: Float
    du: Float
    dv: Float
    p_value: Float


def largest_difference(
    model: DistortionModel,
    difference: Float,
    cov: Float,
    *,
    rng: np.random.Generator,
    grid: int,
    n_draws: int,
) -> PositionChange:
    """The largest difference over the array, against those of fields of noise.

    Parameters
    ----------
    model : DistortionModel
        Without frames and time dependence.
    difference : ndarray, shape (D,)
        Of the parameters.
    cov : ndarray, shape (D, D)
    rng : numpy.random.Generator
    grid : int
        Points along each axis.
    n_draws : int
        Fields of noise.

    Returns
    -------
    PositionChange
    """
    noise = rng.standard_normal((n_draws, len(cov))) @ scaled_cholesky(cov).T
    largest, worst = np.zeros(n_draws), (-1.0, 0, (0.0, 0.0), 0.0)
    for chip in model.chips:
        x, y = (a.ravel() for a in np.meshgrid(*_axes(chip, (grid, grid))))
        phi = model.basis(chip.number).evaluate(x, y)
        u, v = (model.coefficient_slice(chip.number, axis) for axis in (0, 1))
        radial = (noise[:, u] @ phi.T) ** 2 + (noise[:, v] @ phi.T) ** 2
        largest = np.maximum(largest, np.sqrt(radial.max(axis=1)))
        field = np.stack([phi @ difference[u], phi @ difference[v]])
        size = np.hypot(*field)
        k = int(np.argmax(size))
        if size[k] > worst[0]:
            along = np.zeros(len(cov))
            direction = field[:, k] / size[k] if size[k] > 0 else np.array([1.0, 0.0])
            along[u], along[v] = direction[0] * phi[k], direction[1] * phi[k]
            sigma = float(np.sqrt(along @ cov @ along))
            worst = (float(size[k]), chip.number, (float(x[k]), float(y[k])), sigma)
    chi2, dof, p_field = chi_square(difference, cov)
    return PositionChange(
        largest=worst[0],
        at=worst[2],
        chip=worst[1],
        sigma=worst[3],
        noise_median=float(np.median(largest)),
        noise_95=float(np.quantile(largest, 0.95)),
        p_value=float((1 + (largest >= worst[0]).sum()) / (n_draws + 1)),
        chi2=chi2,
        dof=dof,
        p_field=p_field,
    )


def difference_field(
    model: DistortionModel, difference: Float, cov: Float, chip: Chip, grid: tuple[int, int]
) -> DifferenceField:
    """The difference on a grid of one chip.

    Parameters
    ----------
    model, difference, cov
        As `largest_difference`.
    chip : Chip
    grid : tuple of int
        Points on x and on y.

    Returns
    -------
    DifferenceField
    """
    x, y = _axes(chip, grid)
    phi = model.basis(chip.number).evaluate(*(a.ravel() for a in np.meshgrid(x, y)))
    parts = [model.coefficient_slice(chip.number, axis) for axis in (0, 1)]
    field = np.stack([phi @ difference[part] for part in parts], axis=-1)
    joint = np.empty((len(phi), 2, 2))
    for a, one in enumerate(parts):
        for b, other in enumerate(parts):
            joint[:, a, b] = np.einsum("nk,kl,nl->n", phi, cov[one, other], phi, optimize=True)
    z2 = np.einsum("na,na->n", field, np.linalg.solve(joint, field[..., None])[..., 0])
    du, dv, p_value = (
        a.reshape(len(y), len(x)) for a in (*field.T, chi_square_distribution.sf(z2, 2))
    )
    return DifferenceField(chip, x, y, du, dv, p_value)


def _axes(chip: Chip, grid: tuple[int, int]) -> tuple[Float, Float]:
    """Pixels from edge to edge of a chip."""
    return np.linspace(1, chip.size[0], grid[0]), np.linspace(1, chip.size[1], grid[1])
