"""How far each star is to be trusted: the outlier mixture on residuals that are given.

The mixture of `bayesdist.infer.stars.mixture`, with its priors, fitted by EM.  It sees residuals
only, so that the polynomial and the tables can be fitted in turn with the weights that it gives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.nodes.jitter import jitter_variance
from bayesdist.infer.stars.mixture import OUTLIER_MODE, OUTLIER_SHAPE, OutlierMixture

__all__ = ["Trust", "fitted_trust"]

Float = NDArray[np.float64]

SAMPLE = 200_000  # stars that the mixture's three numbers are estimated from
STEPS = 200
WIDER = 3.0  # least standard deviation of false matches over that of true ones
SETTLED = 1e-3  # relative change of the expected number of false matches


@dataclass(frozen=True, eq=False)
class Trust:
    """Which stars are true matches.

    Parameters
    ----------
    probability : ndarray, shape (N,)
        Of being a true match.
    fraction : float
        Of false matches.
    jitter : float
        Error beyond the quoted one, in the unit of the residuals.
    outlier_scale : float
        Standard deviation of false matches on each axis.
    """

    probability: Float
    fraction: float
    jitter: float
    outlier_scale: float


def fitted_trust(residual: Float, variance: Float) -> Trust:
    """The mixture's most probable values, and each star's membership at them.

    Parameters
    ----------
    residual : ndarray, shape (N, 2)
    variance : ndarray, shape (N, 2)
        Square of the quoted errors.

    Returns
    -------
    Trust
    """
    every = max(1, len(residual) // SAMPLE)
    some, var = residual[::every], variance[::every]
    a, b = OutlierMixture().fraction_prior
    scale2 = float(np.median(var))
    rate = OUTLIER_SHAPE * OUTLIER_MODE**2 * scale2
    r2 = (some**2).sum(axis=1)

    seen = float(np.median(r2)) / (2 * np.log(2))  # of a round Gaussian, whatever lies far out
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
