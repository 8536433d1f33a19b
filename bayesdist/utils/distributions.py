"""Tail probabilities and quantiles of the usual distributions.

By scipy.special: scipy.stats, where they have the same names and values, takes a second to import.
`sf` is the probability of more, `isf` the value that is exceeded with a probability.  As there, a
distribution without degrees of freedom has NaN.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from bayesdist.utils.arrays import Float, Int


def _where(known: ArrayLike, values: ArrayLike) -> Float:
    """Values where they are known, else NaN."""
    return np.where(known, values, np.nan)[()]


def norm_sf(z: ArrayLike) -> Float:
    """Probability of more than z."""
    return special.ndtr(-np.asarray(z, float))


def norm_isf(p: ArrayLike) -> Float:
    """Value of a standard normal variable that is exceeded with probability p."""
    return -special.ndtri(p)


def chi2_sf(x: ArrayLike, dof: ArrayLike) -> Float:
    """Probability of more than x."""
    return _where(np.asarray(dof) > 0, special.chdtrc(dof, np.maximum(x, 0.0)))


def chi2_cdf(x: ArrayLike, dof: ArrayLike) -> Float:
    """Probability of at most x."""
    return _where(np.asarray(dof) > 0, special.chdtr(dof, np.maximum(x, 0.0)))


def chi2_isf(p: ArrayLike, dof: ArrayLike) -> Float:
    """Chi-square that is exceeded with probability p."""
    return _where(np.asarray(dof) > 0, special.chdtri(dof, p))


def chi2_ppf(p: ArrayLike, dof: ArrayLike) -> Float:
    """Quantile of a chi-square."""
    return _where(np.asarray(dof) > 0, 2 * special.gammaincinv(np.asarray(dof) / 2, p))


def gamma_sf(x: ArrayLike, shape: ArrayLike) -> Float:
    """Probability of more than x, for unit scale."""
    return special.gammaincc(shape, np.maximum(x, 0.0))


def gamma_cdf(x: ArrayLike, shape: ArrayLike) -> Float:
    """Probability of at most x, for unit scale."""
    return special.gammainc(shape, np.maximum(x, 0.0))


def f_sf(x: ArrayLike, more: ArrayLike, free: ArrayLike) -> Float:
    """Probability of more than x, with `more` and `free` degrees of freedom."""
    return special.fdtrc(more, free, np.maximum(x, 0.0))


def f_isf(p: ArrayLike, more: ArrayLike, free: ArrayLike) -> Float:
    """F that is exceeded with probability p, with `more` and `free` degrees of freedom."""
    a, b = np.asarray(free, float), np.asarray(more, float)
    y = special.betaincinv(a / 2, b / 2, p)  # accurate for small probabilities, as `fdtri` is not
    return a * (1 - y) / (b * y)


def t_sf(t: ArrayLike, dof: ArrayLike) -> Float:
    """Probability of more than t."""
    return special.stdtr(dof, -np.asarray(t, float))


def t_ppf(p: ArrayLike, dof: ArrayLike) -> Float:
    """Quantile of Student's t."""
    return special.stdtrit(dof, p)


def beta_sf(x: ArrayLike, a: ArrayLike, b: ArrayLike) -> Float:
    """Probability of more than x."""
    return special.betaincc(a, b, x)


def beta_ppf(p: ArrayLike, a: ArrayLike, b: ArrayLike) -> Float:
    """Quantile of a beta distribution."""
    return special.betaincinv(a, b, p)


def beta_std(a: float, b: float) -> float:
    """Standard deviation of a beta distribution."""
    return float(np.sqrt(a * b / (a + b + 1)) / (a + b))


def binom_ppf(p: ArrayLike, n: int, each: float) -> Int:
    """Smallest numbers of n successes, each of probability `each`, of which there are at most p."""
    return np.searchsorted(special.bdtr(np.arange(n + 1.0), n, each), p)
