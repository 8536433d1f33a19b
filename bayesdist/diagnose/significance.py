"""Probabilities: of what is found by chance, corrected for the number of tests, and counted."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.utils.arrays import Float
from bayesdist.utils.distributions import beta_ppf, beta_sf, chi2_isf

MIN_P = 1e-300  # tails underflow: no probability is zero


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
    return float(beta_sf(min(statistic / n, 1.0), dof / 2, max(n - dof, 1) / 2))


def chi_square_of(p: float, dof: float) -> float:
    """Chi-square of a probability, for sums of tests that have other distributions."""
    return float(chi2_isf(max(p, MIN_P), dof))


def clopper_pearson(fraction: float, n: float, confidence: float) -> tuple[float, float]:
    """Exact central interval of a binomial probability, by the fraction of successes in n trials.

    Clopper & Pearson 1934, Biometrika 26, 404, in its form with quantiles of the beta distribution:
    neither the trials nor the successes need be whole.
    """
    tail, k = (1.0 - confidence) / 2.0, fraction * n
    low = float(beta_ppf(tail, k, n - k + 1.0)) if k > 0 else 0.0
    high = float(beta_ppf(1.0 - tail, k + 1.0, n - k)) if k < n else 1.0
    return low, high
