"""Irregular or smooth drift: a Wiener process, plain or integrated once, seen at knots.

With a free level (and, integrated, a free slope) in addition, the date at which such a process
starts does not matter; here it is the middle of the series.  Given its values at the knots the
process is known exactly there, and its conditional mean runs between them: linear or cubic.  The
integrated process is the smoothing spline of Wahba (1978).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Drift"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Drift:
    """A process of unit amplitude: about one at the ends of the series."""

    origin: float  # middle of the series
    years: float  # half its span
    knots: Float  # (Q,) in units of half the span from the middle, none of them zero
    smooth: bool  # integrated once

    @classmethod
    def over(cls, epoch: Float, n_knots: int, *, smooth: bool) -> Drift:
        """Process over a series.

        A smooth one has its knots at even distances, an irregular one where the exposures are.
        """
        first, last = epoch.min(), epoch.max()
        origin, years = (first + last) / 2, (last - first) / 2
        if smooth:
            places = np.linspace(-1, 1, n_knots)
        else:
            places = np.quantile((np.unique(epoch) - origin) / years, np.linspace(0, 1, n_knots))
        places = np.unique(np.round(places, 9))
        return cls(float(origin), float(years), places[np.abs(places) > 1e-6], smooth)

    @property
    def n_columns(self) -> int:
        """Number of knots."""
        return len(self.knots)

    def kernel(self, a: Float, b: Float) -> Float:
        """Covariance (..., n, m) of the process at dates (n,) and (m,), in half spans."""
        same = np.sign(a)[:, None] == np.sign(b)
        x, y = np.abs(a)[:, None], np.abs(b)
        low, high = np.minimum(x, y), np.maximum(x, y)
        values = 3 * low**2 * (high - low / 3) / 2 if self.smooth else low
        return np.where(same, values, 0.0)

    def columns(self, epoch: ArrayLike) -> Float:
        """Columns (E, Q) whose parameters are independent and of one variance.

        Their sum with such parameters is the conditional mean given the process at the knots.
        """
        places = (np.asarray(epoch, float) - self.origin) / self.years
        factor = np.linalg.cholesky(self.kernel(self.knots, self.knots))
        return np.linalg.solve(factor, self.kernel(self.knots, places)).T

    def unseen(self, epoch: ArrayLike) -> Float:
        """Variance (E,) of the process about that mean, of unit amplitude."""
        places = (np.asarray(epoch, float) - self.origin) / self.years
        total = np.abs(places) ** 3 if self.smooth else np.abs(places)
        return np.maximum(total - (self.columns(epoch) ** 2).sum(axis=1), 0.0)
