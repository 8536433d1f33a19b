"""Correlated deviations of successive exposures, for predictions beyond the series.

In addition to a trend of few columns each coefficient deviates by a first-order
(Ornstein-Uhlenbeck) process of variance a^2 and memory tau, and each exposure by an independent
scatter.  The trend's parameters are integrated out; memory, total variance and the process's
fraction of it are summed over a grid with the weight of their marginal likelihood.  A memory far
longer than the series makes a random walk, a fraction of zero the scatter alone.  Closed forms
throughout: nothing to converge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Correlated", "Shared"]

Float = NDArray[np.float64]

VAGUE = 100.0  # prior standard deviation of the trend's parameters, in units of the spread
MEMORIES, TOTALS = 9, 9
FRACTIONS = np.array([0.0, 0.2, 0.4, 0.6, 0.8, 0.95])
LONGEST = 10.0  # memory, in spans of the series
RANGE = 0.2, 20.0  # total variance, in units of that about the trend
MAX_POINTS = 300  # exposures, or means of successive ones


@dataclass(frozen=True, eq=False)
class Shared:
    """Prediction of a coefficient at M epochs: a mixture of P normal distributions."""

    weight: Float  # of each process (P,)
    means: Float  # of trend and correlated deviation (P, M)
    variances: Float  # of trend and correlated deviation (P, M)
    own: Float  # independent variance (P,) of each exposure, in addition to its formal one

    @property
    def mean(self) -> Float:
        """Mean (M,) over all processes."""
        return self.weight @ self.means

    @property
    def variance(self) -> Float:
        """Variance (M,) over all processes."""
        return self.weight @ (self.variances + (self.means - self.mean) ** 2)

    def drawn(self, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
        """Process of each of some draws (n,)."""
        return rng.choice(len(self.weight), size=n, p=self.weight)


@dataclass(frozen=True, eq=False)
class Correlated:
    """Correlated deviations of one coefficient, over a grid of processes."""

    epoch: Float
    y: Float  # (E,) in units of the spread
    noise: Float  # formal variances (E,)
    columns: Float  # of the trend (E, p)
    count: Float  # number (E,) of exposures of which each of these is the mean

    @classmethod
    def of(cls, epoch: Float, y: Float, noise: Float, columns: Float) -> Correlated:
        """Deviations of single exposures, or of means of successive ones if they are very many."""
        order = np.argsort(epoch, kind="stable")
        groups = np.array_split(order, min(len(order), MAX_POINTS))
        mean = [np.stack([values[group].mean(axis=0) for group in groups]) for values in (epoch, y)]
        count = np.array([float(len(group)) for group in groups])
        of_mean = np.array([noise[group].mean() for group in groups]) / count
        rows = np.stack([columns[group].mean(axis=0) for group in groups])
        return cls(mean[0], mean[1], of_mean, rows, count)

    def predict(self, epoch: Float, columns: Float) -> Shared:
        """Trend and correlated deviation at other epochs (M,), with the trend's columns there."""
        points = self._grid()
        solved = [self._at(*point, epoch, columns) for point in points]
        log_weight = np.array([one[0] for one in solved])
        weight = np.exp(log_weight - log_weight.max())
        weight /= weight.sum()
        means, variances = (np.stack([one[i] for one in solved]) for i in (1, 2))
        own = np.array([total * (1.0 - fraction) for _, total, fraction in points])
        return Shared(weight, means, variances, own)

    def _grid(self) -> list[tuple[float, float, float]]:
        """Memory, total variance and the process's fraction of it."""
        order = np.sort(self.epoch)
        gap = float(np.median(np.diff(order))) or float(np.ptp(order)) / len(order)
        memories = np.geomspace(gap, LONGEST * float(np.ptp(order)), MEMORIES)
        fit = np.linalg.lstsq(self.columns, self.y, rcond=None)[0]
        left = self.y - self.columns @ fit
        spread = float(np.median(np.abs(left)) * 1.4826) ** 2 or float(left.var()) or 1.0
        totals = spread * np.geomspace(*RANGE, TOTALS)
        out = []
        for total in totals:
            out += [(1.0, float(total), 0.0)] * MEMORIES  # as many, for the same prior weight
            for memory in memories:
                out += [(float(memory), float(total), float(f)) for f in FRACTIONS[1:]]
        return list(dict.fromkeys(out))

    def _at(
        self, memory: float, total: float, fraction: float, epoch: Float, columns: Float
    ) -> tuple[float, Float, Float]:
        """Log marginal likelihood of one process, and its mean and variance at other epochs."""
        process = fraction * total

        def shared(a: Float, b: Float) -> Float:
            return process * np.exp(-np.abs(a[:, None] - b) / memory)

        cov = shared(self.epoch, self.epoch) + VAGUE**2 * self.columns @ self.columns.T
        cov[np.diag_indices_from(cov)] += self.noise + (total - process) / self.count
        factor = np.linalg.cholesky(cov)
        white = np.linalg.solve(factor, self.y)
        across = shared(self.epoch, epoch) + VAGUE**2 * self.columns @ columns.T
        gain = np.linalg.solve(factor, across)
        value = -0.5 * float(white @ white) - float(np.log(np.diag(factor)).sum())
        own = process + VAGUE**2 * (columns**2).sum(axis=1)
        return value, gain.T @ white, np.maximum(own - (gain**2).sum(axis=0), 0.0)
