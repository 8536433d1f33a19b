"""Probability of each star to be a true match: the outlier mixture on given residuals.

The mixture of `bayesdist.infer.stars.mixture`, with its priors, fitted by EM.  It uses residuals
only, so that the polynomial and the tables can be fitted in turn with its weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.nodes.jitter import jitter_variance
from bayesdist.infer.stars.mixture import OUTLIER_MODE, OUTLIER_SHAPE, OutlierMixture

__all__ = ["Trust", "fitted_trust"]

Float = NDArray[np.float64]

SAMPLE = 200_000  # stars from which the mixture's three numbers are estimated
STEPS = 200
WIDER = 3.0  # smallest ratio of the standard deviations of false matches and true ones
SETTLED = 1e-3  # relative change of the expected number of false matches


@dataclass(frozen=True, eq=False)
class Trust:
    """Outlier mixture of the matches, with the probability of each to be true."""

    probability: Float  # of each star (N,) to be a true match
    fraction: float  # of false matches
    jitter: float  # error in excess of the quoted one, in the unit of the residuals
    outlier_scale: float  # standard deviation of false matches on each axis


def fitted_trust(residual: Float, variance: Float) -> Trust:
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
        if abs(false - before) < SETTLED * (1.0 + false):
            break
        before = false
    return Trust(
        _true(residual, variance, f, j2, out2), f, float(np.sqrt(j2)), float(np.sqrt(out2))
    )


def _true(residual: Float, variance: Float, f: float, j2: float, out2: float) -> Float:
    """Probability (N,) of being a true match."""
    total = variance + j2
    inside = np.log1p(-f) - 0.5 * (residual**2 / total + np.log(total)).sum(axis=1)
    outside = np.log(f) - 0.5 * (residual**2).sum(axis=1) / out2 - np.log(out2)
    return np.asarray(1.0 / (1.0 + np.exp(np.clip(outside - inside, -700, 700))))
