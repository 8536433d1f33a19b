"""Intrinsic covariance of the exposures: its prior, and draws given their deviations.

The prior is the hierarchical inverse Wishart of Huang and Wand (2013, Bayesian Analysis 8, 439)
with nu = 2: the standard deviation of each coefficient is half-Student-t with two degrees of
freedom and scale `PRIOR_SCALE` in units of the series' spread, and each correlation is uniform.
So the covariance is inverse Wishart given scales that are half-normal.

Given each exposure's deviation the draws are exact.  Where it is not clear which exposures lie off,
a narrow scatter with many outliers and a wide one with few both fit; there random-walk steps of the
size of the scatter and of the outlier mixture help, all memberships and deviations being summed
out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, log_expit, logit

from bayesdist.infer.kernel import densities

__all__ = [
    "FRACTION_PRIOR",
    "KAPPA_RATE",
    "KAPPA_SHAPE",
    "MAX_FRACTION",
    "MIN_KAPPA",
    "RandomWalk",
    "draw_scales",
    "draw_scatter",
    "log_prior",
    "scale_prior",
]

Float = NDArray[np.float64]

NU = 2.0
PRIOR_SCALE = 1.0
FRACTION_PRIOR = (1.0, 9.0)
MAX_FRACTION = 0.25
MIN_KAPPA = 3.0
KAPPA_SHAPE = 1.0
KAPPA_RATE = KAPPA_SHAPE * 5.0**2  # log kappa is most probable at log 5
STEPS = 3
SHRINK = 0.3  # every other step is this much shorter


def log_prior(sigma: Float) -> Float:
    """Log prior density (C,) of covariances (C, k, k) in units of the spread, up to a constant."""
    k = sigma.shape[-1]
    diagonal = np.diagonal(np.linalg.inv(sigma), axis1=1, axis2=2)
    tails = np.log(NU * diagonal + PRIOR_SCALE**-2).sum(axis=1)
    return -(NU + 2 * k) / 2 * np.linalg.slogdet(sigma)[1] - (NU + k) / 2 * tails


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
    dof = NU + k - 1 + count
    bartlett = np.zeros((n_chains, k, k))
    for i in range(k):
        bartlett[:, i, i] = np.sqrt(2 * rng.standard_gamma((dof - i) / 2))
        bartlett[:, i, :i] = rng.standard_normal((n_chains, i))
    # if A A' is standard Wishart and U U' = psi, then U A'^-1 A^-1 U' is inverse Wishart
    half = np.linalg.cholesky(psi) @ np.linalg.inv(np.swapaxes(bartlett, 1, 2))
    return half @ np.swapaxes(half, 1, 2)


@dataclass(frozen=True, eq=False)
class RandomWalk:
    """Steps of a covariance that is fixed beforehand.

    The coordinates are the log of a factor on the scatter, then logit f and log kappa^2 where
    exposures may lie off.
    """

    factor: Float  # Cholesky factor (d, d) of the covariance of a step
    outliers: bool

    @classmethod
    def learn(cls, sigma: Float, fraction: Float, kappa2: Float, *, outliers: bool) -> RandomWalk:
        """Random walk with the covariance of past states: (n, k, k), (n,) and (n,)."""
        size = np.linalg.slogdet(sigma)[1] / sigma.shape[-1]
        x = np.stack([size, logit(fraction), np.log(kappa2)] if outliers else [size])
        d = len(x)
        cov = np.atleast_2d(np.cov(x)) + 1e-8 * np.eye(d)
        return cls(2.38 / np.sqrt(d) * np.linalg.cholesky(cov), outliers)

    def move(
        self,
        sigma: Float,
        fraction: Float,
        kappa2: Float,
        residual: Float,
        formal: Float,
        included: Float,
        rng: np.random.Generator,
    ) -> tuple[Float, Float, Float]:
        """Scatter (C, k, k), fraction and inflation (C,) after some steps.

        `residual` is (C, k, E), `formal` (k, k, E); `included` (C, E) is 0 for exposures that are
        held out, else 1.
        """
        zero = np.zeros(len(sigma))
        x = np.stack([zero, logit(fraction), np.log(kappa2)] if self.outliers else [zero], axis=1)
        value = self._log_density(x, sigma, residual, formal, included)
        for step in range(STEPS):
            length = SHRINK if step % 2 else 1.0
            trial = x + length * rng.standard_normal(x.shape) @ self.factor.T
            new = self._log_density(trial, sigma, residual, formal, included)
            taken = np.log(rng.random(len(x))) < new - value
            x = np.where(taken[:, None], trial, x)
            value = np.where(taken, new, value)
        sigma = np.exp(x[:, 0])[:, None, None] * sigma
        if not self.outliers:
            return sigma, fraction, kappa2
        return sigma, expit(x[:, 1]), np.exp(x[:, 2])

    def _log_density(
        self, x: Float, sigma: Float, residual: Float, formal: Float, included: Float
    ) -> Float:
        k = sigma.shape[-1]
        stretched = np.exp(x[:, 0])[:, None, None] * sigma
        out = log_prior(stretched) + k * (k + 1) / 2 * x[:, 0]
        fraction, kappa2 = np.zeros(len(x)), np.ones(len(x))
        if self.outliers:
            f, log_kappa2 = x[:, 1], x[:, 2]
            fraction, kappa2 = expit(f), np.exp(log_kappa2)
            a, b = FRACTION_PRIOR
            out += a * log_expit(f) + b * log_expit(-f)
            out -= KAPPA_SHAPE * log_kappa2 + KAPPA_RATE / kappa2
            inside = (kappa2 >= MIN_KAPPA**2) & (fraction <= MAX_FRACTION)
            out = np.where(inside, out, -np.inf)
        each = densities(formal, stretched, residual, fraction, kappa2)[0]
        return out + (included * each).sum(axis=1)
