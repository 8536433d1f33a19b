"""Validity period of a calibration: until when a requirement is met by the extrapolated drift."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.requirements.margins import domains_of
from bayesdist.assess.requirements.requirement import Requirement
from bayesdist.assess.units import convert
from bayesdist.diagnose.statistics import clopper_pearson
from bayesdist.model.grid import DEFAULT_GRID
from bayesdist.utils.arrays import Float

BAND = 0.95  # level of the interval of a probability


@dataclass(frozen=True, eq=False)
class ValidityPeriod:
    """Probability of meeting a requirement as a function of epoch."""

    requirement: Requirement
    epoch: Float  # (n,), decimal years, ascending
    probability: Float  # (n,), fraction of draws that meet the limit
    low: Float  # (n,), central 95 % interval for the number of draws (Clopper-Pearson)
    high: Float  # (n,)
    value: Float  # (n,), median of the statistic, in the unit of the requirement

    @property
    def date(self) -> float | None:
        """Date at which the probability falls below the required one; None if it does not."""
        return self._fall(self.probability)

    @property
    def interval(self) -> tuple[float | None, float | None]:
        """Such dates for both ends of the interval of the probability, the earlier one first."""
        return self._fall(self.low), self._fall(self.high)

    @property
    def sentence(self) -> str:
        """The date in one sentence."""
        name, asked = self.requirement.name, self.requirement.probability
        first, last = float(self.epoch[0]), float(self.epoch[-1])
        if self.date is None:
            return f"{name}: the probability stays at {asked:g} or more until {last:.1f}"
        if self.date == first:
            p_first = float(self.probability[0])
            return (
                f"{name}: the probability is below {asked:g} already at {first:.1f} ({p_first:.2g})"
            )
        early, late = self.interval
        until = f"{late:.1f}" if late is not None else f"after {last:.1f}"
        since = first if early is None else early
        return f"{name}: recalibrate before {self.date:.1f} ({since:.1f} to {until})"

    def _fall(self, probability: Float) -> float | None:
        below = probability < self.requirement.probability
        if not below.any():
            return None
        k = int(np.argmax(below))
        if k == 0:
            return float(self.epoch[0])
        ends = slice(k - 1, k + 1)
        return float(
            np.interp(
                -self.requirement.probability,  # `interp` needs ascending values
                -probability[ends],
                self.epoch[ends],
            )
        )


def validity_period(
    errors: DrawnErrors,
    requirement: Requirement,
    epochs: ArrayLike,
    *,
    grid: tuple[int, int] = DEFAULT_GRID,
    pixel_scale: float | None = None,
) -> ValidityPeriod:
    """Follow a requirement through time.

    The error at each epoch is that of the drift in the model, extrapolated with its covariance. It
    includes the curvature of the drift that data and prior allow, if the errors contain it.

    `errors`: draws for a model that depends on time; the same draws are used at all epochs, so the
    curve has no Monte-Carlo noise between epochs. `requirement`: its epoch is ignored. `epochs`:
    decimal years, ascending, shape (n,), at least two. `grid`: number of points along x and y of a
    chip. `pixel_scale`: see `check_requirements`.
    """
    at = np.asarray(epochs, float)
    requirement = requirement.in_unit_of(errors.unit)
    factor = convert(1.0, errors.unit, requirement.unit, pixel_scale, where=requirement.where)
    n = errors.n_effective
    single_epoch = replace(requirement, epoch=float(at[0]), epochs=None)
    (domain,) = domains_of(single_epoch, errors.solution.model, grid)
    statistics = errors.over_epochs(domain, [float(epoch) for epoch in at], [requirement.statistic])
    draws = factor * np.array([by_name[requirement.statistic] for by_name in statistics])
    met, value = np.mean(draws <= requirement.limit, axis=1), np.median(draws, axis=1)
    low, high = np.array([clopper_pearson(p, n, BAND) for p in met]).T
    return ValidityPeriod(requirement, at, met, low, high, value)
