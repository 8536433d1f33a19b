"""Did the pattern of residuals change?  Each period against all the others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bayesdist.arrays import Float
from bayesdist.diagnose.residuals.binned import BAND_AXES, BinnedSums, BinValues
from bayesdist.distributions import chi2_isf, chi2_sf, f_sf
from bayesdist.errors import DegenerateError

__all__ = ["PatternChange", "pattern_changes"]

_FEWEST_STARS = 5


@dataclass(frozen=True)
class PatternChange:
    """Means of bins in one period against those in all other periods."""

    period: str
    axis: str
    p_value: float  # probability of as large differences by chance
    rms: float  # of the differences, their noise subtracted; 0 where noise alone is larger
    # between the two patterns, noise included: near 1 where the same structure stays and noise is
    # small
    correlation: float
    n_bins: int  # bins that hold five stars or more in both


def pattern_changes(periods: Mapping[str, BinnedSums]) -> tuple[PatternChange, ...]:
    """Pattern of every period against that of the rest.

    A single period shares its stars with the combined set, the rest does not: differences from the
    rest have independent errors, and those from the combined set are the same, made smaller by the
    share of the rest.

    Periods are disjoint in their stars, two or more, all against one model in pixels; changes are
    those in X and Y of each. Raises DegenerateError when fewer than three bins hold five stars in a
    period and in the rest.
    """
    out = []
    for name in periods:
        one, *others = (sums for other, sums in periods.items() if other != name)
        rest = sum(others, start=one)
        out += [
            _change(name, axis, periods[name].values(axis), rest.values(axis))
            for axis in BAND_AXES[:2]
        ]
    return tuple(out)


def _change(period: str, axis: str, one: BinValues, rest: BinValues) -> PatternChange:
    good = one.good & rest.good & (np.minimum(one.dof, rest.dof) >= _FEWEST_STARS - 1)
    n = int(good.sum())
    if n < 3:
        raise DegenerateError(
            f"only {n} bins hold {_FEWEST_STARS} stars in this period and in the others",
            where=f"period {period!r}",
            do="take fewer bins",
        )
    a, b = one.mean[good], rest.mean[good]
    variance = one.sem[good] ** 2 + rest.sem[good] ** 2
    p_value = _p_value((a - b) ** 2 / variance, one.minus(rest).dof[good])
    excess = float(np.mean((a - b) ** 2 - variance))
    alike = float(np.corrcoef(a, b)[0, 1]) if a.std() > 0 and b.std() > 0 else float("nan")
    return PatternChange(period, axis, p_value, float(np.sqrt(max(excess, 0.0))), alike, n)


def _p_value(t2: Float, dof: Float) -> float:
    """Probability of larger squared t variables (n,), each by its normal variable."""
    z2 = chi2_isf(f_sf(t2, 1, dof), 1)
    return float(chi2_sf(z2.sum(), z2.size))
