"""Differences between all pairs of some values, without a list of them.

45 x 45 bins have four million ordered pairs.  Their mean, sigma and extremes have closed forms; an
order statistic is found by counting: how many differences lie below a limit is one search in a
sorted list for each value.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["pair_statistics"]

Float = NDArray[np.float64]


def pair_statistics(values: Float, *, tolerance: float = 0.0) -> dict[str, float]:
    """Statistics of v_i - v_j over all i and j: the columns of Table 5-3 of WSDC D-T033.

    The n^2 differences contain each value against itself, and are as often the one way as the
    other: mean and median vanish.

    `values` (n,) are finite and not empty, `tolerance` is the allowed error of percentiles, 0 for
    rounding. By name: mean, sigma (about the mean, over n^2), min, max, median, p01, p99;
    percentiles interpolate between neighbours as `numpy.percentile` does.
    """
    a = np.sort(values)
    extent, p99 = float(a[-1] - a[0]), _percentile(a, 99, tolerance)
    return {
        "mean": 0.0,
        "sigma": float(np.hypot(a.std(), a.std())),
        "min": -extent,
        "max": extent,
        "median": 0.0,
        "p01": -p99,
        "p99": p99,
    }


def _percentile(a: Float, percent: int, tolerance: float) -> float:
    whole, part = divmod((a.size**2 - 1) * percent, 100)
    low = _order_statistic(a, whole, tolerance)
    if not part:
        return low
    return low + (_order_statistic(a, whole + 1, tolerance) - low) * part / 100


def _order_statistic(a: Float, rank: int, tolerance: float) -> float:
    """Difference with so many others at or below it, by bisection; a is sorted."""
    low, high = a[0] - a[-1], a[-1] - a[0]
    finest = np.spacing(max(high, abs(a[0]), abs(a[-1])))
    if _count(a, low) > rank:
        return float(low)
    while high - low > max(tolerance, 2 * finest):
        middle = (low + high) / 2
        if _count(a, middle) > rank:
            high = middle
        else:
            low = middle
    return float(high)


def _count(a: Float, limit: float) -> int:
    """Number of differences at or below a limit."""
    return int(a.size**2 - np.searchsorted(a, a - limit, side="left").sum())
