"""P-values, their correction for the number of tests, and confidence intervals of fractions."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.utils.arrays import Float
from bayesdist.utils.distributions import beta_ppf, beta_sf, chi2_isf

MIN_P = 1e-300  # avoids underflow: no p-value is zero


def holm(p_values: ArrayLike) -> Float:
    """P-values (m,) corrected for their number (Holm 1979).

    A test is significant at a level, among all tests, if its corrected value does not exceed the
    level.
    """
    p = np.asarray(p_values, float)
    order = np.argsort(p, kind="stable")
    out = np.empty(len(p))
    steps = np.arange(len(p), 0, -1) * p[order]
    out[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return out


def hotelling_p(statistic: float, dof: float, n: float) -> float:
    """P-value of a chi-square statistic with a covariance estimated from the squares of n vectors.

    The squares are taken about zero (Hotelling 1931).  `dof` is the number of directions, `n` that
    of stars or other independent vectors.
    """
    return float(beta_sf(min(statistic / n, 1.0), dof / 2, max(n - dof, 1) / 2))


def chi_square_of(p: float, dof: float) -> float:
    """Chi-square with the p-value `p`, for combining tests that have other distributions."""
    return float(chi2_isf(max(p, MIN_P), dof))


def clopper_pearson(fraction: float, n: float, confidence: float) -> tuple[float, float]:
    """Exact central confidence interval of a fraction, given the observed fraction in n trials.

    Clopper & Pearson 1934, Biometrika 26, 404, in its form with quantiles of the beta distribution:
    neither the number of trials nor that of successes needs to be an integer.
    """
    tail, k = (1.0 - confidence) / 2.0, fraction * n
    low = float(beta_ppf(tail, k, n - k + 1.0)) if k > 0 else 0.0
    high = float(beta_ppf(1.0 - tail, k + 1.0, n - k)) if k < n else 1.0
    return low, high
