"""Probabilities of what is found by chance, in words and corrected for the number of tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import beta, chi2

__all__ = ["chi_square_of", "holm", "hotelling_p", "p_words"]

Float = NDArray[np.float64]

MIN_P = 1e-300  # tails underflow: no probability is zero


def p_words(p: float) -> str:
    """Words for a probability: 'p = 0.02'."""
    return f"p < {MIN_P:g}" if p < MIN_P else f"p = {p:.1g}"


def holm(p_values: ArrayLike) -> Float:
    """Probabilities (m,) corrected for their number (Holm 1979).

    They are at or under a level where the test is significant at that level among all of them.
    """
    p = np.asarray(p_values, float)
    order = np.argsort(p, kind="stable")
    out = np.empty(len(p))
    steps = np.arange(len(p), 0, -1) * p[order]
    out[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return out


def hotelling_p(statistic: float, dof: float, n: float) -> float:
    """Probability of a larger chi-square whose covariance is the sum of squares of n vectors.

    For squares about zero (Hotelling 1931).

    `dof` is the number of directions, `n` that of stars, or other vectors that are independent of
    each other.
    """
    return float(beta.sf(min(statistic / n, 1.0), dof / 2, max(n - dof, 1) / 2))


def chi_square_of(p: float, dof: float) -> float:
    """Chi-square of a probability, for sums of tests that have other distributions."""
    return float(chi2.isf(max(p, MIN_P), dof))
