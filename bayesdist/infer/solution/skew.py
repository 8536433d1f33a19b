"""Skew of a solution: the angle between the detector's axes on the sky, minus 90 degrees.

The model of gnDSTR (WSDC D-T033, section 1) has a polynomial for each axis "plus a skew factor
applied to Y", constrained to zero. Since both polynomials have all linear terms here, the skew is
not an additional parameter: applying a skew to a polynomial with perpendicular axes gives another
polynomial of the same order. The skew is therefore a function of the four linear coefficients.

If one pixel along x and along y at the reference pixel maps to the vectors e_x and e_y, then::

    sin(skew) = - e_x . e_y / (|e_x| |e_y|)         the angle from e_x to e_y is 90 degrees + skew
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.infer.solution.solution import Solution
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float

__all__ = ["Skew", "skew_of"]


@dataclass(frozen=True)
class Skew:
    """Deviation of the angle between the axes from 90 degrees.

    Parameters
    ----------
    value, sigma : float
        Skew and its standard error in radians.
    """

    value: float
    sigma: float

    @property
    def significance(self) -> float:
        """Skew divided by its error; infinite if the error is zero."""
        return self.value / self.sigma if self.sigma > 0 else float("inf")


def skew_of(solution: Solution, *, chip: int | None = None) -> Skew:
    """Skew of a chip at its reference pixel, with its error.

    Parameters
    ----------
    solution : Solution
        Fit or posterior. The error is propagated from its covariance.
    chip : int, optional
        Chip number; the first chip by default.

    Returns
    -------
    Skew
        Skew of the polynomials, without drift and exposure frames.
    """
    value, gradient = _skew(solution.model, solution.mean, chip)
    # if the skew is constrained by a prior, rounding may make its variance slightly negative
    return Skew(value, float(np.sqrt(max(float(gradient @ solution.cov @ gradient), 0.0))))


def _skew(model: DistortionModel, theta: Float, chip: int | None) -> tuple[float, Float]:
    """Skew in radians, and its derivative (D,) with respect to theta."""
    basis = model.basis(chip)
    slices = [model.coefficient_slice(chip, axis) for axis in (0, 1)]
    rows = basis.monomial_matrix[[basis.terms.index((1, 0)), basis.terms.index((0, 1))]]
    # the columns of J are e_x and e_y
    J = np.stack([rows @ theta[part] for part in slices])
    (a, b), (c, d) = J
    n_x, n_y = np.hypot(a, c), np.hypot(b, d)
    cosine = (a * b + c * d) / (n_x * n_y)
    by_x = (J[:, 1] / n_y - cosine * J[:, 0] / n_x) / n_x
    by_y = (J[:, 0] / n_x - cosine * J[:, 1] / n_y) / n_y
    gradient = np.zeros_like(theta)
    for axis, part in enumerate(slices):
        gradient[part] = -(by_x[axis] * rows[0] + by_y[axis] * rows[1])
    return float(-np.arcsin(cosine)), gradient / np.sqrt(1 - cosine**2)
