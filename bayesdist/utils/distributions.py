"""Tail probabilities and quantiles of common distributions.

The functions have the names and values of scipy.stats, but are computed with scipy.special because
scipy.stats takes a second to import.  `sf` is the survival function, the probability of a larger
value; `isf` is its inverse; `ppf` is the quantile function.  As in scipy.stats, the result is NaN
for a chi-square distribution without degrees of freedom.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from bayesdist.utils.arrays import Float, Int


def _where(known: ArrayLike, values: ArrayLike) -> Float:
    """Values where the mask is True, otherwise NaN."""
    return np.where(known, values, np.nan)[()]


def norm_sf(z: ArrayLike) -> Float:
    """Probability that a standard normal variable exceeds z."""
    return special.ndtr(-np.asarray(z, float))


def norm_isf(p: ArrayLike) -> Float:
    """Value that a standard normal variable exceeds with probability p."""
    return -special.ndtri(p)


def chi2_sf(x: ArrayLike, dof: ArrayLike) -> Float:
    """Probability that a chi-square variable with `dof` degrees of freedom exceeds x."""
    return _where(np.asarray(dof) > 0, special.chdtrc(dof, np.maximum(x, 0.0)))


def chi2_cdf(x: ArrayLike, dof: ArrayLike) -> Float:
    """Probability that a chi-square variable with `dof` degrees of freedom is at most x."""
    return _where(np.asarray(dof) > 0, special.chdtr(dof, np.maximum(x, 0.0)))


def chi2_isf(p: ArrayLike, dof: ArrayLike) -> Float:
    """Value that a chi-square variable with `dof` degrees of freedom exceeds with probability p."""
    return _where(np.asarray(dof) > 0, special.chdtri(dof, p))


def chi2_ppf(p: ArrayLike, dof: ArrayLike) -> Float:
    """Quantile at probability p of the chi-square distribution with `dof` degrees of freedom."""
    return _where(np.asarray(dof) > 0, 2 * special.gammaincinv(np.asarray(dof) / 2, p))


def gamma_sf(x: ArrayLike, shape: ArrayLike) -> Float:
    """Probability that a gamma variable of the given shape and unit scale exceeds x."""
    return special.gammaincc(shape, np.maximum(x, 0.0))


def gamma_cdf(x: ArrayLike, shape: ArrayLike) -> Float:
    """Probability that a gamma variable of the given shape and unit scale is at most x."""
    return special.gammainc(shape, np.maximum(x, 0.0))


def f_sf(x: ArrayLike, more: ArrayLike, free: ArrayLike) -> Float:
    """Probability that an F variable exceeds x.

    `more` and `free` are the degrees of freedom of the numerator and the denominator.
    """
    return special.fdtrc(more, free, np.maximum(x, 0.0))


def f_isf(p: ArrayLike, more: ArrayLike, free: ArrayLike) -> Float:
    """Value that an F variable exceeds with probability p.

    `more` and `free` are the degrees of freedom of the numerator and the denominator.
    """
    a, b = np.asarray(free, float), np.asarray(more, float)
    y = special.betaincinv(a / 2, b / 2, p)  # unlike `fdtri` accurate for small probabilities
    return a * (1 - y) / (b * y)


def t_sf(t: ArrayLike, dof: ArrayLike) -> Float:
    """Probability that Student's t with `dof` degrees of freedom exceeds t."""
    return special.stdtr(dof, -np.asarray(t, float))


def t_ppf(p: ArrayLike, dof: ArrayLike) -> Float:
    """Quantile at probability p of Student's t distribution with `dof` degrees of freedom."""
    return special.stdtrit(dof, p)


def beta_sf(x: ArrayLike, a: ArrayLike, b: ArrayLike) -> Float:
    """Probability that a beta variable with shape parameters a and b exceeds x."""
    return special.betaincc(a, b, x)


def beta_ppf(p: ArrayLike, a: ArrayLike, b: ArrayLike) -> Float:
    """Quantile at probability p of the beta distribution with shape parameters a and b."""
    return special.betaincinv(a, b, p)


def beta_std(a: float, b: float) -> float:
    """Standard deviation of the beta distribution with shape parameters a and b."""
    return float(np.sqrt(a * b / (a + b + 1)) / (a + b))


def binom_ppf(p: ArrayLike, n: int, each: float) -> Int:
    """Quantiles of the number of successes in n trials, at the probabilities `p` (any shape).

    Each trial succeeds with probability `each`.
    """
    return np.searchsorted(special.bdtr(np.arange(n + 1.0), n, each), p)
