"""Intrinsic covariance of the exposures: its prior, and draws given their deviations.

The prior is the hierarchical inverse Wishart of Huang and Wand (2013, Bayesian Analysis 8, 439)
with nu = 2: the standard deviation of each coefficient is half-Student-t with two degrees of
freedom and scale `PRIOR_SCALE` in units of the series' spread, and each correlation is uniform.

Given each exposure's deviation the draws are exact.  They mix slowly where the intrinsic scatter is
small against the formal errors; there the steps of walk.py help.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.series.small import cholesky, precision_of

__all__ = ["draw_scatter", "from_coordinates", "log_prior", "to_coordinates"]

Float = NDArray[np.float64]

NU = 2.0
PRIOR_SCALE = 1.0


def log_prior(sigma: Float) -> Float:
    """Log prior density (C,) of covariances (k, k, C) in units of the spread, up to a constant."""
    k = len(sigma)
    factor = cholesky(sigma)
    precision = precision_of(factor)
    diagonal = np.array([precision[j, j] for j in range(k)])
    log_det = 2 * sum(np.log(factor[j, j]) for j in range(k))
    tails = np.log(NU * diagonal + PRIOR_SCALE**-2).sum(axis=0)
    return -(NU + 2 * k) / 2 * log_det - (NU + k) / 2 * tails


def draw_scatter(sigma: Float, scatter: Float, count: Float, rng: np.random.Generator) -> Float:
    """New covariances (k, k, C) given the exposures' deviations.

    `scatter` (C, k, k) is the sum of the outer products of `count` (C,) deviations; the present
    covariances `sigma` (k, k, C) are used only to draw the scales of the prior.
    """
    k, _, n_chains = sigma.shape
    precision = precision_of(cholesky(sigma))
    diagonal = np.array([precision[j, j] for j in range(k)])
    # 1 / a of Huang and Wand, gamma with this rate
    inverse_a = rng.gamma((NU + k) / 2, size=(k, n_chains)) / (NU * diagonal + PRIOR_SCALE**-2)
    psi = scatter + 2 * NU * inverse_a.T[:, :, None] * np.eye(k)
    dof = NU + k - 1 + count
    bartlett = np.zeros((n_chains, k, k))
    for i in range(k):
        bartlett[:, i, i] = np.sqrt(2 * rng.standard_gamma((dof - i) / 2))
        bartlett[:, i, :i] = rng.standard_normal((n_chains, i))
    # if A A' is standard Wishart and U U' = psi, then U A'^-1 A^-1 U' is inverse Wishart
    half = np.linalg.cholesky(psi) @ np.linalg.inv(np.swapaxes(bartlett, 1, 2))
    return np.moveaxis(half @ np.swapaxes(half, 1, 2), 0, -1)


def to_coordinates(sigma: Float) -> Float:
    """Unbounded coordinates (C, k (k + 1) / 2) of covariances (k, k, C).

    With L the Cholesky factor: log L_ii, and L_ij / L_ii below the diagonal.
    """
    factor = cholesky(sigma)
    k = len(factor)
    diagonal = [factor[i, i] for i in range(k)]
    below = [factor[i, j] / factor[i, i] for i in range(k) for j in range(i)]
    return np.stack([*np.log(diagonal), *below], axis=-1)


def from_coordinates(x: Float) -> tuple[Float, Float]:
    """Covariances (k, k, C) at coordinates (C, d), and the log Jacobian (C,) of the map."""
    k = int((np.sqrt(8 * x.shape[-1] + 1) - 1) / 2)
    scale = np.exp(x[:, :k].T)
    factor = np.zeros((k, k, len(x)))
    place = k
    for i in range(k):
        factor[i, i] = scale[i]
        for j in range(i):
            factor[i, j] = scale[i] * x[:, place]
            place += 1
    sigma = np.einsum("imc,jmc->ijc", factor, factor)
    # d sigma / d L is 2^k prod L_ii^(k + 1 - i), and row i of L carries its scale i times
    return sigma, (k + 1) * x[:, :k].sum(axis=1)
