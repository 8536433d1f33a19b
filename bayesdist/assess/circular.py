"""Radius of the circle that holds a given probability of a Gaussian error in two dimensions."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

__all__ = ["circular_error", "per_axis"]

Float = NDArray[np.float64]

NODES = 33  # ratios of the axes between which radii are interpolated: to 1e-4
ANGLES = 256


def per_axis(sigma_u: ArrayLike, sigma_v: ArrayLike) -> Float:
    """Rms of the standard deviations of both axes: 1 sigma of one axis, whatever its direction.

    Parameters
    ----------
    sigma_u, sigma_v : array_like
        In one unit, which is that of the result.
    """
    return np.asarray(np.hypot(sigma_u, sigma_v) / np.sqrt(2.0))


def circular_error(
    sigma_u: ArrayLike, sigma_v: ArrayLike, correlation: ArrayLike, probability: float
) -> Float:
    """Radius of the circle about the true position that holds a probability: CE68, CE95.

    Parameters
    ----------
    sigma_u, sigma_v : array_like
        Standard deviations, in one unit, which is that of the result.
    correlation : array_like
        Between u and v.
    probability : float
        Between 0 and 1.

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
    """Radius over the major axis, as a function of minor over major axis."""
    ratios = np.linspace(0.0, 1.0, NODES)
    angle = (np.arange(ANGLES) + 0.5) * np.pi / (2 * ANGLES)

    def outside(radius: float, ratio: float) -> float:
        square = np.cos(angle) ** 2 + (ratio * np.sin(angle)) ** 2
        return float(np.exp(-0.5 * radius**2 / square).mean())

    return CubicSpline(
        ratios,
        [brentq(lambda r, k=k: outside(r, k) - (1 - probability), 1e-3, 10.0) for k in ratios],
    )
