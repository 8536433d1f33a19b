"""Position errors of a solution as fields over the detector, part by part, by draws.

Every error field is a polynomial of the pixel position, so a draw is kept as 2 K coefficients and
evaluated where and when it is wanted: memory does not grow with draws times grid points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.assess.moments import position_moments
from bayesdist.assess.solution import Solution, place_of, point_blocks
from bayesdist.errors import InputError
from bayesdist.model import DistortionModel, PolynomialBasis

__all__ = [
    "COEFFICIENTS",
    "EXPOSURE_FRAME",
    "MODEL",
    "TIME_DEPENDENCE",
    "ErrorFields",
    "draw_solution",
    "error_fields",
    "error_fields_of",
]

Float = NDArray[np.float64]

COEFFICIENTS = "coefficients"
TIME_DEPENDENCE = "time dependence"
EXPOSURE_FRAME = "exposure frame"
MODEL = "model"


@dataclass(frozen=True, eq=False)
class ErrorFields:
    """Draws of the position error over the detector.

    Parameters
    ----------
    x, y : ndarray, shape (N,)
        FITS 1-based pixels.
    polynomials : dict of str to ndarray, shape (n, 2, K)
        For each part, the Legendre coefficients of the error of each draw: "coefficients" and,
        where the model has them, "time dependence" and "exposure frame"; "model" is the joint error
        of all.
    basis : PolynomialBasis
    unit : str
    chip : int
    epoch : float or None
    """

    x: Float
    y: Float
    polynomials: dict[str, Float]
    basis: PolynomialBasis
    unit: str
    chip: int
    epoch: float | None

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts; "model", the joint error, is the last one."""
        return tuple(self.polynomials)

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return len(self.polynomials[MODEL])

    def field(self, part: str, draws: slice = slice(None)) -> Float:
        """The error of some draws at all points, shape (n, N, 2), in `unit`."""
        e = self.polynomials[part][draws]
        out = np.empty((len(e), self.x.size, 2))
        for rows in point_blocks(self.x.size):
            phi = self.basis.evaluate(self.x[rows], self.y[rows])
            out[:, rows] = np.swapaxes(e @ phi.T, -1, -2)
        return out

    def sigma(self, part: str) -> tuple[Float, Float]:
        """Root mean square over the draws at each point, (N,) for u and for v."""
        e = self.polynomials[part]
        flat = e.reshape(len(e), -1)
        second = (flat.T @ flat / len(e)).reshape(*e.shape[1:], *e.shape[1:])
        uu, vv, _ = position_moments(second, self.basis, self.x, self.y)
        return np.sqrt(uu), np.sqrt(vv)


def error_fields(
    solution: Solution,
    x: ArrayLike,
    y: ArrayLike,
    *,
    epoch: float | None = None,
    chip: int | None = None,
    n_draws: int = 1000,
    rng: np.random.Generator,
) -> ErrorFields:
    """Draws of the position error, by part and jointly.

    Each error is a draw minus the solution's mean.  A star is taken to lie in an exposure chosen at
    random, for each draw, among those whose frame was fitted (all but the first), and its error is
    given along the axes of the first exposure, which define the gauge: so the parts add up to
    "model" (to first order) however the field turned between exposures.  They are correlated, hence
    the sigma of "model" is not their quadrature sum.

    Parameters
    ----------
    solution : LinearFit or Posterior
    x, y : array_like, shape (N,)
        FITS 1-based pixels.
    epoch : float, optional
        Decimal years; needed by a model with time dependence.
    chip : int, optional
        Chip number; the first chip by default.
    n_draws : int
    rng : numpy.random.Generator

    Returns
    -------
    ErrorFields

    Raises
    ------
    InputError
        For an unknown chip, a missing epoch, or fewer than two draws.
    """
    theta, exposures = draw_solution(solution, n_draws, rng)
    return error_fields_of(solution, theta, exposures, x, y, epoch=epoch, chip=chip)


def draw_solution(
    solution: Solution, n_draws: int, rng: np.random.Generator
) -> tuple[Float, NDArray[np.int64]]:
    """Draws of a solution, each with an exposure.

    Parameters
    ----------
    solution : LinearFit or Posterior
    n_draws : int
    rng : numpy.random.Generator

    Returns
    -------
    theta : ndarray, shape (n, D)
    exposures : ndarray of int, shape (n,)
        Code of a random exposure with a fitted frame; 0 where no frame was fitted.

    Raises
    ------
    InputError
        For fewer than two draws.
    """
    if n_draws < 2:
        raise InputError(f"the number of draws is {n_draws}", do="ask for at least 2")
    theta = np.asarray(solution.draws(n_draws, rng), float)
    model = solution.model
    if model.n_frame and len(model.exposures) > 1:
        return theta, rng.integers(1, len(model.exposures), size=len(theta))
    return theta, np.zeros(len(theta), np.int64)


def error_fields_of(
    solution: Solution,
    theta: Float,
    exposures: NDArray[np.int64],
    x: ArrayLike,
    y: ArrayLike,
    *,
    epoch: float | None = None,
    chip: int | None = None,
) -> ErrorFields:
    """Error fields of given draws: the same draws may serve several epochs.

    Parameters
    ----------
    solution : LinearFit or Posterior
    theta : ndarray, shape (n, D)
    exposures : ndarray of int, shape (n,)
        Code of the exposure of each draw; 0 is the gauge, whose frame has no error.
    x, y, epoch, chip
        As in `error_fields`.

    Returns
    -------
    ErrorFields
    """
    model = solution.model
    mean = np.asarray(solution.mean, float)
    gauge = place_of(model, epoch=epoch, chip=chip)
    number = gauge.chip.number
    joint = gauge.polynomial(theta) - gauge.polynomial(mean)
    static = _static(model, theta - mean, number)
    parts = {COEFFICIENTS: static}
    if model.time is not None:
        parts[TIME_DEPENDENCE] = joint - static
    if np.any(exposures > 0):
        frame = np.zeros_like(joint)
        for e in np.unique(exposures[exposures > 0]):
            rows = np.flatnonzero(exposures == e)
            place = place_of(model, epoch=epoch, exposure=int(e), chip=chip)
            expected = place.polynomial(mean)
            matrix, _ = model.frame(mean, int(e))
            joint[rows] = _along_gauge(matrix, place.polynomial(theta[rows]) - expected)
            block = model.frame_slice(int(e))
            only_frame = np.tile(mean, (rows.size, 1))
            only_frame[:, block] = theta[rows, block]
            frame[rows] = _along_gauge(matrix, place.polynomial(only_frame) - expected)
        parts[EXPOSURE_FRAME] = frame
    parts[MODEL] = joint
    return ErrorFields(
        x=np.atleast_1d(np.asarray(x, float)),
        y=np.atleast_1d(np.asarray(y, float)),
        polynomials=parts,
        basis=gauge.basis,
        unit=model.unit,
        chip=number,
        epoch=gauge.epoch,
    )


def _static(model: DistortionModel, theta: Float, chip: int) -> Float:
    """Legendre coefficients (..., 2, K) of a chip without drift."""
    return np.stack([theta[..., model.coefficient_slice(chip, axis)] for axis in (0, 1)], axis=-2)


def _along_gauge(matrix: Float, error: Float) -> Float:
    """Error polynomials (n, 2, K) of an exposure, along the axes of the first one."""
    return np.linalg.solve(matrix, error)
