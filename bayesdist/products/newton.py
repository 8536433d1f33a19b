"""Newton's method from undistorted positions back to the pixels of a chip."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.calibration import Calibration
from bayesdist.errors import InputError

__all__ = ["newton"]

Float = NDArray[np.float64]

# Converged when a step is this short in pixels, which rounding allows everywhere.
_STEP, _MOST = 1e-9, 30


def newton(chip: Calibration, w: Float) -> tuple[Float, Float]:
    """Pixels whose polynomials have given values.

    Parameters
    ----------
    chip : Calibration
    w : ndarray, shape (2, N)
        In the unit of the calibration.

    Returns
    -------
    pixels : ndarray, shape (2, N)
        NaN where the iteration does not end.
    slope : ndarray, shape (N, 2, 2)
        d(u, v) / d(x, y) there.

    Raises
    ------
    InputError
        When the linear part at the zero point is singular.
    """
    zero = np.array(chip.basis.reference_pixel)[:, None]
    value, slope = _values_and_slopes(chip, zero)
    if abs(np.linalg.det(slope[0])) <= 1e-12 * np.abs(slope[0]).max() ** 2:
        raise InputError(
            "maps its zero point to a line, so that it has no inverse",
            where=f"{chip.name}, chip {chip.chip}",
            do="check the linear coefficients",
        )
    pixels = zero + np.linalg.solve(slope[0], w - value)
    moving = np.isfinite(pixels).all(axis=0)
    pixels[:, ~moving] = np.nan
    far = 3.0 * max(chip.basis.size)  # where a polynomial means nothing any more
    for _ in range(_MOST):
        if not moving.any():
            break
        value, slope = _values_and_slopes(chip, pixels[:, moving])
        with np.errstate(all="ignore"):
            step = np.squeeze(_solve(slope, (w[:, moving] - value).T[..., None]), -1).T
        at = pixels[:, moving] + step
        lost = ~np.isfinite(at).all(axis=0) | (np.abs(at - zero).max(axis=0) > far)
        at[:, lost] = np.nan
        pixels[:, moving] = at
        moving[moving] = ~lost & (np.hypot(*step) > _STEP)
    pixels[:, moving] = np.nan
    slope = np.full((w.shape[1], 2, 2), np.nan)
    good = np.isfinite(pixels[0])
    if good.any():
        slope[good] = _values_and_slopes(chip, pixels[:, good])[1]
    return pixels, slope


def _solve(a: Float, b: Float) -> Float:
    """Solutions of 2 x 2 systems; infinite where one is singular."""
    det = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
    x = a[:, 1, 1] * b[:, 0, 0] - a[:, 0, 1] * b[:, 1, 0]
    y = a[:, 0, 0] * b[:, 1, 0] - a[:, 1, 0] * b[:, 0, 0]
    return (np.stack([x, y], axis=1) / det[:, None])[..., None]


def _values_and_slopes(chip: Calibration, pixels: Float) -> tuple[Float, Float]:
    """Values (2, N) and derivatives (N, 2, 2) by the pixel."""
    phi = chip.basis.evaluate(*pixels)
    by_x, by_y = chip.basis.derivatives
    along = [phi @ (by @ chip.coefficients.T) for by in (by_x, by_y)]
    return (phi @ chip.coefficients.T).T, np.stack(along, axis=-1)
