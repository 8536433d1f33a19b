"""Difference in position between two models over the array, compared with noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.infer.equations.scaled import chi_square, scaled_cholesky
from bayesdist.model import Chip, DistortionModel
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.utils.arrays import Float
from bayesdist.utils.distributions import chi2_sf


@dataclass(frozen=True, eq=False)
class PositionChange:
    """Largest difference in position between two models over the array, with its significance."""

    largest: float  # length of the largest difference vector, in the unit of u, v
    at: tuple[float, float]  # its position, FITS 1-based pixels
    chip: int  # number of its chip
    sigma: float  # standard error of the difference there, along its direction
    noise_median: float  # median of the largest difference over the array from noise alone
    noise_95: float  # 95th percentile of the same
    # fraction of noise fields with a largest difference of at least this size, which accounts for
    # the search over the array
    p_value: float
    chi2: float  # chi-square of the entire field, which equals that of its coefficients
    dof: int  # degrees of freedom of `chi2`
    p_field: float  # probability of a larger chi-square


@dataclass(frozen=True, eq=False)
class DifferenceField:
    """Difference in position between two models on a grid over one chip."""

    chip: Chip
    x: Float  # (nx,) FITS 1-based pixels, from edge to edge
    y: Float  # (ny,) FITS 1-based pixels, from edge to edge
    du: Float  # (ny, nx) difference in u, in the unit of u, v
    dv: Float  # (ny, nx) difference in v
    p_value: Float  # (ny, nx) chance probability of the difference at each position by itself


def largest_difference(
    model: DistortionModel,
    difference: Float,
    cov: Float,
    *,
    rng: np.random.Generator,
    grid: int,
    n_draws: int,
) -> PositionChange:
    """Find the largest difference over the array and compare it with `n_draws` noise fields.

    The model must have neither frames nor time dependence.  `difference` (D,) and `cov` (D, D) are
    the difference of its parameters and the covariance; `grid` is the number of points per axis.
    """
    noise = rng.standard_normal((n_draws, len(cov))) @ scaled_cholesky(cov).T
    largest, worst = np.zeros(n_draws), (-1.0, 0, (0.0, 0.0), 0.0)
    for chip in model.chips:
        x, y = mesh(*grid_pixels(chip.size, (grid, grid)))
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
    """Difference on a grid (nx, ny) of one chip; see `largest_difference` for the arguments."""
    x, y = grid_pixels(chip.size, grid)
    phi = model.basis(chip.number).evaluate(*mesh(x, y))
    parts = [model.coefficient_slice(chip.number, axis) for axis in (0, 1)]
    field = np.stack([phi @ difference[part] for part in parts], axis=-1)
    joint = np.empty((len(phi), 2, 2))
    for a, row_slice in enumerate(parts):
        for b, column_slice in enumerate(parts):
            joint[:, a, b] = np.einsum(
                "nk,kl,nl->n", phi, cov[row_slice, column_slice], phi, optimize=True
            )
    z2 = np.einsum("na,na->n", field, np.linalg.solve(joint, field[..., None])[..., 0])
    du, dv, p_value = (a.reshape(len(y), len(x)) for a in (*field.T, chi2_sf(z2, 2)))
    return DifferenceField(chip, x, y, du, dv, p_value)
