"""Skew of the gnDSTR model, the angle between the detector's axes on the sky, as a constraint.

WSDC D-T033, section 1: a polynomial for each axis "plus a skew factor applied to Y", constrained to
zero. With all linear terms in both polynomials the skew is no additional parameter: a solution (u,
v) = S(skew) w, whose w has perpendicular axes at the reference pixel, is again a polynomial of the
same order. The skew is a function of four linear coefficients. To fit it is to leave them free, and
both axes are fitted apart; to fix it is one condition on them, and that ties the axes.

For e_x, e_y, the images of one pixel along x and along y at the reference pixel::

    sin(skew) = - e_x . e_y / (|e_x| |e_y|)         the angle from e_x to e_y is 90 degrees + skew
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.linear import LinearFit
from bayesdist.infer.posterior import Posterior
from bayesdist.model import DistortionModel

__all__ = ["Skew", "fit_with_skew", "skew_of"]

Float = NDArray[np.float64]

SETTLED = 1e-14  # radians


@dataclass(frozen=True)
class Skew:
    """Deviation of the angle between the axes from 90 degrees.

    Parameters
    ----------
    value, sigma : float
        Radians.
    """

    value: float
    sigma: float

    @property
    def significance(self) -> float:
        """The value in units of its error; infinite where it was imposed."""
        return self.value / self.sigma if self.sigma > 0 else float("inf")


def skew_of(solution: LinearFit | Posterior, *, chip: int | None = None) -> Skew:
    """Skew in a solution's linear terms, with its error.

    Parameters
    ----------
    solution : LinearFit or Posterior
        The error of a fit with extra weight in the corners is that of its sandwich covariance.
    chip : int, optional
        Chip number; the first chip by default.

    Returns
    -------
    Skew
        At the reference pixel; drift and exposure frames are left out.
    """
    value, gradient = _skew(solution.model, solution.mean, chip)
    # rounding may leave the variance of what was imposed below zero
    return Skew(value, float(np.sqrt(max(float(gradient @ solution.cov @ gradient), 0.0))))


def fit_with_skew(
    fit: LinearFit, skew: float = 0.0, sigma: float = 0.0, *, chip: int | None = None
) -> LinearFit:
    """Linear fit under a condition on its skew, without another pass over the data.

    Chi-square is quadratic in the coefficients, so the free solution and its covariance hold all
    that the data say.  The skew is not linear in the coefficients: the condition is linearised
    where the solution lies, until it does not move.

    Parameters
    ----------
    fit : LinearFit
        With a free skew, without extra weight in the corners: its covariance is the formal one.
    skew : float
        Given value, radians.
    sigma : float
        Its standard error, radians; 0 imposes the value exactly.
    chip : int, optional
        Chip number; the first chip by default.

    Returns
    -------
    LinearFit
        `chi2` of the stars is raised by what the condition costs, and `dof` by the one number that
        the condition adds.  The stars used, `rms_u` and `rms_v` stay those of the free solution.

    Raises
    ------
    InputError
        For a skew of 90 degrees or more, or a negative error.
    DegenerateError
        When the condition cannot be met near the solution.
    """
    if not (abs(skew) < np.pi / 2 and 0 <= sigma < np.inf):
        raise InputError(
            f"the skew is {skew} +- {sigma} radians",
            where="skew",
            do="give an angle below pi / 2 and an error that is not negative",
        )
    theta = fit.mean
    for _ in range(50):
        value, gradient = _skew(fit.model, theta, chip)
        moves = fit.cov @ gradient
        variance = float(gradient @ moves) + sigma**2
        # the condition linearised at theta, evaluated at the free solution
        missing = skew - value - float(gradient @ (fit.mean - theta))
        new = fit.mean + moves * (missing / variance)
        step = abs(float(gradient @ (new - theta)))
        theta = new
        if step < SETTLED:
            break
    else:
        raise DegenerateError(
            f"no solution with a skew of {skew} radians is found",
            where="skew",
            do="give a value near that of the free solution (skew_of)",
        )
    cost = (missing / variance) ** 2 * float(gradient @ moves)
    cov = fit.cov - np.outer(moves, moves) / variance
    return replace(fit, mean=theta, cov=cov, chi2=fit.chi2 + cost, dof=fit.dof + 1)


def _skew(model: DistortionModel, theta: Float, chip: int | None) -> tuple[float, Float]:
    """Skew in radians, and its derivative (D,) with respect to theta."""
    basis = model.basis(chip)
    slices = [model.coefficient_slice(chip, axis) for axis in (0, 1)]
    rows = basis.monomial_matrix[[basis.terms.index((1, 0)), basis.terms.index((0, 1))]]
    # columns of J: images of the two axes
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
