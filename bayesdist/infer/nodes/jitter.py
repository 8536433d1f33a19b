"""Error of the stars in excess of the quoted one, after the table and the polynomial."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

__all__ = ["jitter_variance"]

Float = NDArray[np.float64]


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
