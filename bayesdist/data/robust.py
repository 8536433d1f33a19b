"""Least-squares fits of any kind that reject outlying pairs of positions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from bayesdist.utils.arrays import Bool, Float

Solution = TypeVar("Solution")
_CLIP = 3.0  # median distances; 3.5 sigma of a circular normal distribution


class RobustFit(NamedTuple, Generic[Solution]):
    """A fit, the distances (N,) of all pairs from it, and a mask (N,) of the pairs near it."""

    solution: Solution
    away: Float
    use: Bool


def robust_fit(
    fit: Callable[[Bool], tuple[Solution, Float] | None],
    n: int,
    *,
    least: int,
    rounds: int = 5,
    slack: float = 0.0,
    reach: float = np.inf,
) -> RobustFit[Solution] | None:
    """Fit N pairs repeatedly, rejecting pairs beyond three median distances, until none changes.

    `fit` takes a mask (N,) of pairs and returns the solution and the distances (N,) of all pairs
    from it, or None if the pairs do not determine it.  The result is None in that case, and if
    there are fewer than `least` pairs.  There are at most `rounds` fits.  `slack` is the rounding
    error of a distance of zero; pairs beyond `reach` are not used.
    """
    robust, use = None, np.ones(n, bool)
    for _ in range(rounds):
        if use.sum() < least:
            break
        fitted = fit(use)
        if fitted is None:
            return None
        solution, away = fitted
        near = away <= min(_CLIP * float(np.median(away[use])) + slack, reach)
        robust = RobustFit(solution, away, near)
        if (near == use).all():
            break
        use = near
    return robust
