"""Prior of the node values: a Matern random field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.nodes.grid import NodeGrid

__all__ = ["SMOOTHNESS", "Matern"]

Float = NDArray[np.float64]

SMOOTHNESS = (0.5, 1.5, 2.5)

# Fraction of the variance that each node has independently: a field that is very smooth on the grid
# has a covariance that no computer can factor. 1e-9 is 3e-5 of the amplitude.
NUGGET = 1e-9


@dataclass(frozen=True)
class Matern:
    """Stationary Gaussian random field (Rasmussen and Williams 2006, Equation 4.14)."""

    amplitude: float  # standard deviation, pixels
    length: float  # correlation length, pixels
    smoothness: float  # 1/2, 3/2 or 5/2: a rough field, one with a slope, one with a curvature

    def correlation(self, distance: Float) -> Float:
        """Correlation of two points at a distance in pixels."""
        t = np.sqrt(2 * self.smoothness) * np.asarray(distance, float) / self.length
        shape = {0.5: 1.0, 1.5: 1.0 + t, 2.5: 1.0 + t + t**2 / 3}[self.smoothness]
        return shape * np.exp(-t)

    def covariance(self, grid: NodeGrid) -> Float:
        """Covariance (n_nodes, n_nodes) of free node values."""
        by_lag = self.amplitude**2 * self.correlation(grid.lags)
        by_lag[0] += self.amplitude**2 * NUGGET
        return by_lag[grid.lag]

    def restricted(self, grid: NodeGrid) -> Float:
        """Covariance (n_nodes, n_nodes) of node values without their polynomial part."""
        C, Q = self.covariance(grid), grid.polynomials
        CQ = C @ Q
        Z = CQ - 0.5 * Q @ (Q.T @ CQ)
        return C - np.concatenate([Z, Q], axis=1) @ np.concatenate([Q, Z], axis=1).T
