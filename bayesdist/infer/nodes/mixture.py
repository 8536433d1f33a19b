"""Outlier mixture of given residuals: membership probabilities and jitter.

The mixture of `bayesdist.infer.stars.mixture`, with its priors, is fitted by EM.  It uses residuals
only, so that polynomial and tables can be fitted alternately with its weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from bayesdist.infer.stars.likelihood import good_probability
from bayesdist.infer.stars.mixture import OUTLIER_MODE, OUTLIER_SHAPE, OutlierMixture
from bayesdist.utils.arrays import Float

SAMPLE = 200_000  # number of stars used to estimate fraction, jitter and outlier scale
STEPS = 200  # maximum number of EM iterations
WIDER = 3.0  # smallest ratio of the standard deviation of false matches to that of true ones
CONVERGED = 1e-3  # relative change of the expected number of false matches


@dataclass(frozen=True, eq=False)
class ResidualMixture:
    """Outlier mixture of residuals, with the probability that each star is a true match.

    Parameters
    ----------
    probability : ndarray, shape (N,)
        Probability that each star is a true match.
    fraction : float
        Fraction of false matches.
    jitter : float
        Additional error in excess of the quoted one, in the unit of the residuals.
    outlier_scale : float
        Standard deviation of false matches per axis, in the unit of the residuals.
    """

    probability: Float
    fraction: float
    jitter: float
    outlier_scale: float


def fit_mixture(residual: Float, variance: Float) -> ResidualMixture:
    """Fit the outlier mixture to residuals by EM.

    Parameters
    ----------
    residual : ndarray, shape (N, 2)
    variance : ndarray, shape (N, 2)
        Squares of the quoted errors.

    Returns
    -------
    ResidualMixture
        Most probable values, and the membership probabilities for them.
    """
    stride = max(1, len(residual) // SAMPLE)
    sample, var = residual[::stride], variance[::stride]
    a, b = OutlierMixture().fraction_prior
    scale2 = float(np.median(var))
    rate = OUTLIER_SHAPE * OUTLIER_MODE**2 * scale2
    r2 = (sample**2).sum(axis=1)

    robust_variance = float(np.median(r2)) / (
        2 * np.log(2)
    )  # for a round Gaussian, insensitive to outliers
    f, j2, out2 = (
        0.05,
        max(robust_variance - scale2, 0.0),
        OUTLIER_MODE**2 * max(robust_variance, scale2),
    )
    before = np.inf
    for _ in range(STEPS):
        p = _true(sample, var, f, j2, out2)
        false = float((1 - p).sum())
        f = (false + a) / (len(sample) + a + b)
        j2, _ = jitter_variance(sample, var, p, 0.0)
        out2 = (0.5 * float((r2 * (1 - p)).sum()) + rate) / (false + OUTLIER_SHAPE)
        # If the quoted errors are too large, or the residuals still contain the pattern, a second
        # Gaussian of about the same width would fit the bulk better, and nearly all matches would
        # be declared false.
        out2 = max(out2, WIDER**2 * (scale2 + j2))
        if abs(false - before) < CONVERGED * (1.0 + false):
            break
        before = false
    return ResidualMixture(
        _true(residual, variance, f, j2, out2), f, float(np.sqrt(j2)), float(np.sqrt(out2))
    )


def _true(residual: Float, variance: Float, f: float, j2: float, out2: float) -> Float:
    """Probability (N,) that each star is a true match."""
    return good_probability((residual**2).T, (variance + j2).T, f, out2)


def jitter_variance(
    residual: Float, variance: Float, weight: Float, n_effective: float
) -> tuple[float, float]:
    """Most probable jitter variance, common to both axes, and its standard error.

    Parameters are the residuals (N, 2), their quoted variances (N, 2), the probabilities `weight`
    (N,) of true matches, and the effective number of fitted parameters of both axes together.  The
    jitter variance is 0 if the quoted errors are correct or too large.

    It is the zero of the derivative of the marginal likelihood.  The variance of the fitted values
    is distributed over the stars in proportion to their information, which is exact for equal
    errors.
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
