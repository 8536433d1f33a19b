"""Intrinsic covariance of the exposures: its prior, and draws given the deviations.

The prior is the hierarchical inverse Wishart distribution of Huang and Wand (2013, Bayesian
Analysis 8, 439) with nu = 2.  The standard deviation of each coefficient has a half-Student-t prior
with two degrees of freedom and the scale `PRIOR_SCALE`, in units of the spread of the series; each
correlation is uniform.  Conditional on half-normal scales, the covariance is inverse Wishart.
"""

from __future__ import annotations

import numpy as np

from bayesdist.utils.arrays import Float

NU = 2.0  # degrees of freedom of the prior on the standard deviations
PRIOR_SCALE = 1.0  # scale of this prior, in units of the spread
FRACTION_PRIOR = (1.0, 9.0)  # Beta prior of the fraction of outliers
MAX_FRACTION = 0.25  # largest fraction of outliers
MIN_KAPPA = 3.0  # smallest inflation of the errors of outliers
KAPPA_SHAPE = 1.0  # shape of the inverse-gamma prior on kappa^2
KAPPA_RATE = KAPPA_SHAPE * 5.0**2  # rate of this prior, which puts the mode of log kappa at log 5


def draw_scales(sigma: Float, rng: np.random.Generator) -> Float:
    """Draw the scales (C, k) of the prior, given covariances (C, k, k)."""
    diagonal = np.diagonal(np.linalg.inv(sigma), axis1=1, axis2=2)
    # 1 / a of Huang and Wand has a gamma distribution
    inverse_a = rng.gamma((NU + sigma.shape[-1]) / 2, size=diagonal.shape)
    return np.sqrt(2 * NU * inverse_a / (NU * diagonal + PRIOR_SCALE**-2))


def scale_prior(k: int) -> tuple[float, float]:
    """Prior variance of the scales, and degrees of freedom of the inverse Wishart prior."""
    return NU * PRIOR_SCALE**2, NU + k - 1


def draw_scatter(scale: Float, scatter: Float, count: Float, rng: np.random.Generator) -> Float:
    """Draw covariances (C, k, k), given the deviations and the scales (C, k) of the prior.

    `scatter` (C, k, k) is the sum of the outer products of `count` (C,) deviations.
    """
    n_chains, k = scale.shape
    psi = scatter + scale[:, :, None] ** 2 * np.eye(k)
    dof = scale_prior(k)[1] + count
    bartlett = np.zeros((n_chains, k, k))
    for i in range(k):
        bartlett[:, i, i] = np.sqrt(2 * rng.standard_gamma((dof - i) / 2))
        bartlett[:, i, :i] = rng.standard_normal((n_chains, i))
    # if A A' has a standard Wishart distribution and U U' = psi, U A'^-1 A^-1 U' is inverse Wishart
    half = np.linalg.cholesky(psi) @ np.linalg.inv(np.swapaxes(bartlett, 1, 2))
    return half @ np.swapaxes(half, 1, 2)
