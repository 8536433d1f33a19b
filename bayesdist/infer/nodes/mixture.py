"""Outlier mixture of given residuals: memberships of the stars, and their jitter.

The mixture of `bayesdist.infer.stars.mixture`, with its priors, fitted by EM.  It uses residuals
only, so that the polynomial and the tables can be fitted in turn with its weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from bayesdist.infer.stars.likelihood import good_probability
from bayesdist.infer.stars.mixture import OUTLIER_MODE, OUTLIER_SHAPE, OutlierMixture
from bayesdist.utils.arrays import Float

SAMPLE = 200_000  # stars from which the mixture's three numbers are estimated
STEPS = 200
WIDER = 3.0  # smallest ratio of the standard deviations of false matches and true ones
CONVERGED = 1e-3  # relative change of the expected number of false matches


@dataclass(frozen=True, eq=False)
class ResidualMixture:
    """Outlier mixture of the matches, with the probability of each to be true."""

    probability: Float  # of each star (N,) to be a true match
    fraction: float  # of false matches
    jitter: float  # error in excess of the quoted one, in the unit of the residuals
    outlier_scale: float  # standard deviation of false matches on each axis


def fit_mixture(residual: Float, variance: Float) -> ResidualMixture:
    """Most probable values of the mixture, and each star's membership at them.

    From residuals (N, 2) and the squares of their quoted errors (N, 2).
    """
    every = max(1, len(residual) // SAMPLE)
    some, var = residual[::every], variance[::every]
    a, b = OutlierMixture().fraction_prior
    scale2 = float(np.median(var))
    rate = OUTLIER_SHAPE * OUTLIER_MODE**2 * scale2
    r2 = (some**2).sum(axis=1)

    seen = float(np.median(r2)) / (2 * np.log(2))  # for a round Gaussian, insensitive to outliers
    f, j2, out2 = 0.05, max(seen - scale2, 0.0), OUTLIER_MODE**2 * max(seen, scale2)
    before = np.inf
    for _ in range(STEPS):
        p = _true(some, var, f, j2, out2)
        false = float((1 - p).sum())
        f = (false + a) / (len(some) + a + b)
        j2, _ = jitter_variance(some, var, p, 0.0)
        out2 = (0.5 * float((r2 * (1 - p)).sum()) + rate) / (false + OUTLIER_SHAPE)
        # where the quoted errors are too large, or the pattern is still in the residuals, a second
        # Gaussian of about the same width fits the bulk better, and nearly all would be false
        out2 = max(out2, WIDER**2 * (scale2 + j2))
        if abs(false - before) < CONVERGED * (1.0 + false):
            break
        before = false
    return ResidualMixture(
        _true(residual, variance, f, j2, out2), f, float(np.sqrt(j2)), float(np.sqrt(out2))
    )


def _true(residual: Float, variance: Float, f: float, j2: float, out2: float) -> Float:
    """Probability (N,) of being a true match."""
    return good_probability((residual**2).T, (variance + j2).T, f, out2)


def jitter_variance(
    residual: Float, variance: Float, weight: Float, n_effective: float
) -> tuple[float, float]:
    """Most probable variance of the jitter, shared by both axes, and its standard error.

    From residuals (N, 2), their quoted variances (N, 2) and the probabilities (N,) of true matches;
    `n_effective` is the number of fitted parameters, both axes together.  The variance is 0 where
    the quoted errors are right or too large.

    The derivative of the marginal likelihood, with the variance of the fitted values spread over
    the stars as their information is: exact for equal errors.
    """
    w = np.broadcast_to(weight[:, None], residual.shape)
    free = 1.0 - min(n_effective / float(w.sum()), 0.99)

    def slope(j2: float) -> float:
        precision = 1.0 / (variance + j2)
        return float((w * (residual * precision) ** 2).sum() - free * (w * precision).sum())

    j2 = 0.0
    if slope(0.0) > 0:
        high = float((w * residual**2).sum() / w.sum()) / free
        while slope(high) > 0:
            high *= 2
        j2 = float(brentq(slope, 0.0, high, rtol=1e-6, xtol=1e-6 * high))
    information = 0.5 * free * float((w / (variance + j2) ** 2).sum())
    return j2, information**-0.5
