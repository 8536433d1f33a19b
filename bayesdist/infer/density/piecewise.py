"""Piecewise exponential densities in one dimension, sampled and evaluated exactly."""

from __future__ import annotations

import numpy as np

from bayesdist.utils.arrays import Float


class PiecewiseExponential:
    """Density with a piecewise linear logarithm.

    `mesh` (m,) are ascending points and `values` (m,) the log densities there, up to a constant.
    The logarithm is linear between them and, with `left_slope` > 0 and `right_slope` < 0, beyond
    the first and last point.
    """

    def __init__(self, mesh: Float, values: Float, left_slope: float, right_slope: float) -> None:
        self.mesh = mesh
        self.slopes = np.concatenate([[left_slope], np.diff(values) / np.diff(mesh), [right_slope]])
        self.top = values.max()
        heights = np.exp(values - self.top)
        # mass of each cell relative to its higher end, so that nothing overflows
        fall = np.abs(np.diff(values))
        inner = np.maximum(heights[1:], heights[:-1]) * np.diff(mesh) * _mean_of_fall(fall)
        mass = np.concatenate([[heights[0] / left_slope], inner, [-heights[-1] / right_slope]])
        self.cumulative = np.concatenate([[0.0], np.cumsum(mass)])
        self.total = mass.sum()
        self.values = values - self.log_mass

    @property
    def log_mass(self) -> float:
        """Logarithm of the integral of exp(values)."""
        return float(self.top + np.log(self.total))

    def log_density(self, x: Float) -> Float:
        """Normalised log density (n,) at points (n,)."""
        k = np.searchsorted(self.mesh, x)  # 0: left of the mesh
        anchor = np.maximum(k - 1, 0)
        return self.values[anchor] + self.slopes[k] * (x - self.mesh[anchor])

    def quantile(self, p: Float) -> Float:
        """Quantiles (n,) of probabilities (n,)."""
        m = np.clip(p, 1e-300, 1 - 1e-16) * self.total
        k = np.clip(np.searchsorted(self.cumulative, m, side="right") - 1, 0, len(self.slopes) - 1)
        share = (m - self.cumulative[k]) / (self.cumulative[k + 1] - self.cumulative[k])
        share = np.clip(share, 1e-300, 1.0)
        last = len(self.slopes) - 1
        left_end, right = self.mesh[np.maximum(k - 1, 0)], self.mesh[np.minimum(k, last - 1)]
        rise = self.slopes[k] * (right - left_end)  # of the cell; 0 for the tails
        # measured from the higher end of the cell: fraction of its mass, and of its width, up to x
        beyond = np.where(rise > 0, 1 - share, share)
        fall = np.abs(rise)
        flat = fall < 1e-9
        safe = np.where(flat, 1.0, fall)
        down = np.where(flat, beyond, -np.log1p(beyond * np.expm1(-safe)) / safe)
        inside = np.where(
            rise > 0, right - down * (right - left_end), left_end + down * (right - left_end)
        )
        with np.errstate(divide="ignore"):
            below = self.mesh[0] + np.log(share) / self.slopes[0]
            above = self.mesh[-1] + np.log1p(-np.minimum(share, 1 - 1e-16)) / self.slopes[-1]
        return np.where(k == 0, below, np.where(k == last, above, inside))


def _mean_of_fall(fall: Float) -> Float:
    """Mean of exp(-fall t) over t from 0 to 1."""
    flat = fall < 1e-9
    safe = np.where(flat, 1.0, fall)
    return np.where(flat, 1.0, -np.expm1(-safe) / safe)
