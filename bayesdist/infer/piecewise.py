"""Densities in one dimension that are drawn from and evaluated exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["PiecewiseExponential"]

Float = NDArray[np.float64]


class PiecewiseExponential:
    """A density whose logarithm is linear between mesh points and beyond them.

    Parameters
    ----------
    mesh : ndarray, shape (m,)
        Rising.
    values : ndarray, shape (m,)
        Log density there, up to a constant.
    left_slope, right_slope : float
        Beyond the mesh: positive and negative.
    """

    def __init__(self, mesh: Float, values: Float, left_slope: float, right_slope: float) -> None:
        self.mesh = mesh
        self.slopes = np.concatenate([[left_slope], np.diff(values) / np.diff(mesh), [right_slope]])
        self.top = values.max()
        heights = np.maximum(np.exp(values - self.top), 1e-300)
        width = np.diff(mesh)
        rise = self.slopes[1:-1] * width
        flat = np.abs(rise) < 1e-9
        safe = np.where(flat, 1.0, rise)
        inner = heights[:-1] * width * np.where(flat, 1.0, np.expm1(safe) / safe)
        mass = np.concatenate([[heights[0] / left_slope], inner, [-heights[-1] / right_slope]])
        self.cumulative = np.concatenate([[0.0], np.cumsum(mass)])
        self.heights, self.total = heights, mass.sum()
        self.values = values - self.log_mass

    @property
    def log_mass(self) -> float:
        """Logarithm of the integral of exp(values)."""
        return float(self.top + np.log(self.total))

    def log_density(self, x: Float) -> Float:
        """Normalised log density of points."""
        k = np.searchsorted(self.mesh, x)  # 0: left of the mesh
        anchor = np.maximum(k - 1, 0)
        return self.values[anchor] + self.slopes[k] * (x - self.mesh[anchor])

    def quantile(self, p: Float) -> Float:
        """Where the distribution reaches probabilities."""
        m = np.clip(p, 1e-300, 1 - 1e-16) * self.total
        k = np.clip(np.searchsorted(self.cumulative, m, side="right") - 1, 0, len(self.slopes) - 1)
        anchor = np.maximum(k - 1, 0)
        slope, height = self.slopes[k], self.heights[anchor]
        inside_mass = m - self.cumulative[k]
        # left tail: mass up to x is h exp(s (x - x0)) / s
        share = np.maximum(m * self.slopes[0] / self.heights[0], 1e-300)
        left = self.mesh[0] + np.log(share) / self.slopes[0]
        flat = np.abs(slope) < 1e-9
        safe = np.where(flat, 1.0, slope)
        grown = np.log1p(np.maximum(inside_mass * safe / height, -1 + 1e-16)) / safe
        right = self.mesh[anchor] + np.where(flat, inside_mass / height, grown)
        return np.where(k == 0, left, right)
