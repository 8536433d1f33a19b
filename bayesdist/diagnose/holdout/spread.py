"""Moments of the scores of the scale of errors, and tails of their sums."""

from __future__ import annotations

import numpy as np

from bayesdist.arrays import Float
from bayesdist.diagnose.holdout.predictive import SCALES, Predictive
from bayesdist.distributions import gamma_cdf, gamma_sf, norm_sf

KNOTS, POINTS, LAST = 48, 2000, 60.0
MIN_SKEW = 1e-4


class SpreadMoments:
    """Second and third moments of the score w (q - 2) of one star, and of one axis, w (q_u - 1).

    w is the probability of a true match and q its chi-square.  They are integrals over t = q / 2,
    in which true matches fall as exp(-t) and false ones as k exp(-k t) or not at all, tabulated in
    k, the ratio of their variances; errors that differ between the axes count as their geometric
    mean.
    """

    def __init__(self, predictive: Predictive) -> None:
        self._predictive = predictive
        self._log_k = np.linspace(np.log(1e-8), np.log(4.0), KNOTS)
        t = np.linspace(0.0, LAST, POINTS)
        f, k = predictive.fraction, np.exp(self._log_k)[:, None]
        core = (1 - f) * np.exp(-t)
        if predictive.outliers == "gaussian":
            far = f * k * np.exp(-k * t)
        elif predictive.outliers == "uniform":
            far = f * k * (t <= 1 / k)
        else:
            far = np.zeros((KNOTS, POINTS))
        w = core / np.maximum(core + far, 1e-300)
        score = w * (2 * t - 2)
        density = core + far
        # q_u = 2 t cos^2 of an angle of which nothing is known: means of its powers
        square, cube = 1.5 * t**2 - 2 * t + 1, 2.5 * t**3 - 4.5 * t**2 + 3 * t - 1
        self._tables = [
            np.trapezoid(values * density, t, axis=1)
            for values in (score**2, score**3, w**2 * square, w**3 * cube)
        ]

    def of(self, cov: Float) -> Float:
        """Moments (2, 2, n) of stars with covariances uu, vv, uv (n, 3): of both axes, of one."""
        var = np.sqrt(cov[:, 0] * cov[:, 1] - cov[:, 2] ** 2)
        factor = 2.0 if self._predictive.outliers == "uniform" else 1.0
        log_k = np.log(factor * var / self._predictive.scale**2)
        found = [np.interp(log_k, self._log_k, table) for table in self._tables]
        return np.array(found).reshape(2, 2, -1)


def sum_tails(value: float, variance: float, third: float) -> float:
    """Two-sided probability of a sum of mean zero: by a gamma distribution of the same moments.

    It is exact for sums of squares of normal variables.
    """
    if variance <= 0:
        return 1.0
    z = value / np.sqrt(variance)
    skew = third / variance**1.5
    if abs(skew) < MIN_SKEW:
        return float(2 * norm_sf(abs(z)))
    shape = 4 / skew**2
    x = shape + np.sign(skew) * z * np.sqrt(shape)
    below, above = float(gamma_cdf(x, shape)), float(gamma_sf(x, shape))
    return float(min(1.0, 2 * min(below, above)))


def scale_of(scores: Float) -> float:
    """Factor on the errors at which the sum of scores (SCALES,) is zero: the most likely one."""
    if not np.any(scores < 0):
        return float(SCALES[-1])
    k = int(np.argmax(scores < 0))
    if k == 0:
        return float(SCALES[0])
    a, b = scores[k - 1], scores[k]
    steps = np.log(SCALES)
    # nearly a straight line in the inverse square of the factor
    x = np.exp(-2 * steps)
    zero = x[k - 1] + (x[k] - x[k - 1]) * a / (a - b)
    return float(1 / np.sqrt(zero))
