"""The mean square of something small, measured with an error that may be as large as itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, truncnorm

__all__ = ["MeanSquare"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MeanSquare:
    """Mean squares of two axes, given their measurements and that none is negative."""

    measured: Float  # (2,) of u and v; noise may have carried one below zero
    error: Float  # (2,) standard deviations of these numbers, independent of each other

    @property
    def mean(self) -> Float:
        """Mean (2,) of N(measured, error^2) cut off below zero.

        The less is known, the larger it is: ignorance of an error does not make it smaller.
        """
        return self._moments[0]

    @property
    def relative_error(self) -> float:
        """Relative error of the radial rms."""
        mean, variance = self._moments
        whole = mean.sum()
        return float(np.sqrt(variance.sum()) / (2 * whole)) if whole > 0 else 0.0

    def relative_draws(self, n: int, rng: np.random.Generator) -> Float:
        """Draws (n, 2) of the mean squares relative to their mean."""
        mean, variance = self._moments
        out = np.ones((n, 2))
        for axis in np.flatnonzero(variance > 0):
            centre, width = self.measured[axis], self.error[axis]
            cut = truncnorm(-centre / width, np.inf, centre, width)
            out[:, axis] = cut.rvs(n, random_state=rng) / mean[axis]
        return out

    @property
    def _moments(self) -> tuple[Float, Float]:
        exact = self.error <= 0
        error = np.where(exact, 1.0, self.error)
        z = self.measured / error
        # density over probability, in logarithms: z is far below zero where errors are too small
        ratio = np.exp(norm.logpdf(z) - norm.logcdf(z))
        mean = np.where(exact, np.maximum(self.measured, 0.0), error * (z + ratio))
        variance = error**2 * np.maximum(1 - ratio * (z + ratio), 0.0)
        return mean, np.where(exact, 0.0, variance)
