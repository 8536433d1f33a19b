"""Intrinsic covariance of the exposures: its prior, and draws given their deviations.

The prior is the hierarchical inverse Wishart of Huang and Wand (2013, Bayesian Analysis 8, 439)
with nu = 2: the standard deviation of each coefficient is half-Student-t with two degrees of
freedom and scale `PRIOR_SCALE` in units of the series' spread, and each correlation is uniform.
So the covariance is inverse Wishart given scales that are half-normal.
"""

from __future__ import annotations

import numpy as np

from bayesdist.utils.arrays import Float

NU = 2.0
PRIOR_SCALE = 1.0
FRACTION_PRIOR = (1.0, 9.0)
MAX_FRACTION = 0.25
MIN_KAPPA = 3.0
KAPPA_SHAPE = 1.0
KAPPA_RATE = KAPPA_SHAPE * 5.0**2  # log kappa is most probable at log 5


def draw_scales(sigma: Float, rng: np.random.Generator) -> Float:
    """Scales (C, k) of the prior given covariances (C, k, k)."""
    diagonal = np.diagonal(np.linalg.inv(sigma), axis1=1, axis2=2)
    # 1 / a of Huang and Wand, gamma with this rate
    inverse_a = rng.gamma((NU + sigma.shape[-1]) / 2, size=diagonal.shape)
    return np.sqrt(2 * NU * inverse_a / (NU * diagonal + PRIOR_SCALE**-2))


def scale_prior(k: int) -> tuple[float, float]:
    """Variance of the scales, and degrees of freedom of the covariance given them."""
    return NU * PRIOR_SCALE**2, NU + k - 1


def draw_scatter(scale: Float, scatter: Float, count: Float, rng: np.random.Generator) -> Float:
    """New covariances (C, k, k) given the exposures' deviations and the scales (C, k) of the prior.

    `scatter` (C, k, k) is the sum of the outer products of `count` (C,) deviations.
    """
    n_chains, k = scale.shape
    psi = scatter + scale[:, :, None] ** 2 * np.eye(k)
    dof = scale_prior(k)[1] + count
    bartlett = np.zeros((n_chains, k, k))
    for i in range(k):
        bartlett[:, i, i] = np.sqrt(2 * rng.standard_gamma((dof - i) / 2))
        bartlett[:, i, :i] = rng.standard_normal((n_chains, i))
    # if A A' is standard Wishart and U U' = psi, then U A'^-1 A^-1 U' is inverse Wishart
    half = np.linalg.cholesky(psi) @ np.linalg.inv(np.swapaxes(bartlett, 1, 2))
    return half @ np.swapaxes(half, 1, 2)
