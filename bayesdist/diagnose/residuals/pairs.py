"""Differences between all pairs of two sets of values, without a list of them.

45 x 45 bins have four million ordered pairs.  Their mean, sigma and extremes have closed forms; an
order statistic is found by counting: how many differences lie below a limit is one search in a
sorted list for each value.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["pair_statistics"]

Float = NDArray[np.float64]


def pair_statistics(a: Float, b: Float, *, tolerance: float = 0.0) -> dict[str, float]:
    """Statistics of a_i - b_j over all i and j.

    With b the same as a these are the columns of Table 5-3 of WSDC D-T033, whose n^2 differences
    contain each bin against itself.

    `a` (n,) and `b` (m,) are finite and not empty, `tolerance` is the allowed error of median and
    percentiles, 0 for rounding. By name: mean, sigma (about the mean, over n m), min, max, median,
    p01, p99; percentiles interpolate between neighbours as `numpy.percentile` does.
    """
    same = a is b
    a = np.sort(a)
    b = a if same else np.sort(b)
    out = {
        "mean": 0.0 if same else float(a.mean() - b.mean()),
        "sigma": float(np.hypot(a.std(), b.std())),
        "min": float(a[0] - b[-1]),
        "max": float(a[-1] - b[0]),
    }
    p99 = _percentile(a, b, 99, tolerance)
    # differences of a set from itself are as often the one way as the other
    out["median"] = 0.0 if same else _percentile(a, b, 50, tolerance)
    out["p01"] = -p99 if same else _percentile(a, b, 1, tolerance)
    out["p99"] = p99
    return out


def _percentile(a: Float, b: Float, percent: int, tolerance: float) -> float:
    whole, part = divmod((a.size * b.size - 1) * percent, 100)
    low = _order_statistic(a, b, whole, tolerance)
    if not part:
        return low
    return low + (_order_statistic(a, b, whole + 1, tolerance) - low) * part / 100


def _order_statistic(a: Float, b: Float, rank: int, tolerance: float) -> float:
    """Difference with so many others at or below it, by bisection; a and b are sorted."""
    low, high = a[0] - b[-1], a[-1] - b[0]
    finest = np.spacing(max(abs(low), abs(high), abs(a[0]), abs(a[-1]), abs(b[0]), abs(b[-1])))
    if _count(a, b, low) > rank:
        return float(low)
    while high - low > max(tolerance, 2 * finest):
        middle = (low + high) / 2
        if _count(a, b, middle) > rank:
            high = middle
        else:
            low = middle
    return float(high)


def _count(a: Float, b: Float, limit: float) -> int:
    """Number of differences a_i - b_j at or below a limit."""
    return int(a.size * b.size - np.searchsorted(b, a - limit, side="left").sum())
