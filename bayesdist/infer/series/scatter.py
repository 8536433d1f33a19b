"""Intrinsic covariance of the exposures: its prior, and draws given their deviations.

The prior is the hierarchical inverse Wishart of Huang and Wand (2013, Bayesian Analysis 8, 439)
with nu = 2: the standard deviation of each coefficient is half-Student-t with two degrees of
freedom and scale `PRIOR_SCALE` in units of the series' spread, and each correlation is uniform.

Given each exposure's deviation the draws are exact.  They mix slowly where the intrinsic scatter is
small against the formal errors, and where it is not clear which exposures lie off, so that a narrow
scatter with many outliers and a wide one with few both fit.  There random-walk steps of the scatter
and of the outlier mixture help, all memberships and deviations being summed out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, log_expit, logit

from bayesdist.infer.series.small import cholesky, precision_of, solve_factor

__all__ = [
    "FRACTION_PRIOR",
    "KAPPA_RATE",
    "KAPPA_SHAPE",
    "MAX_FRACTION",
    "MIN_KAPPA",
    "RandomWalk",
    "draw_scatter",
    "from_coordinates",
    "log_mixture",
    "log_prior",
    "to_coordinates",
]

Float = NDArray[np.float64]

NU = 2.0
PRIOR_SCALE = 1.0
FRACTION_PRIOR = (1.0, 9.0)
MAX_FRACTION = 0.25
MIN_KAPPA = 3.0
KAPPA_SHAPE = 1.0
KAPPA_RATE = KAPPA_SHAPE * 5.0**2  # log kappa is most probable at log 5
STEPS = 6
SHRINK = 0.3  # every other step is this much shorter


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


def log_mixture(distance: Float, log_det: Float, k: int, fraction: Float, kappa2: Float) -> Float:
    """Log density (C, E) of exposures of which some lie off.

    `distance` (C, E) is squared, in the metric of the covariance of an exposure that does not lie
    off, `log_det` (C, E) is of that covariance; `fraction` and `kappa2` are (C,).
    """
    base = -0.5 * (k * np.log(2 * np.pi) + log_det)
    f, inflation = fraction[:, None], kappa2[:, None]
    with np.errstate(divide="ignore"):  # f = 0 where nothing may lie off
        good = np.log1p(-f) - 0.5 * distance
        bad = np.log(f) - 0.5 * distance / inflation - 0.5 * k * np.log(inflation)
    return base + np.logaddexp(good, bad)


@dataclass(frozen=True, eq=False)
class RandomWalk:
    """Steps of a covariance that is fixed beforehand.

    The coordinates are those of the scatter, then logit f and log kappa^2 where exposures may lie
    off.
    """

    factor: Float  # Cholesky factor (d, d) of the covariance of a step
    outliers: bool

    @classmethod
    def learn(cls, sigma: Float, fraction: Float, kappa2: Float, *, outliers: bool) -> RandomWalk:
        """Random walk with the covariance of past states: (k, k, n), (n,) and (n,)."""
        x = _coordinates(sigma, fraction, kappa2, outliers)
        d = x.shape[1]
        cov = np.atleast_2d(np.cov(x, rowvar=False)) + 1e-8 * np.eye(d)
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
        """Scatter (k, k, C), fraction and inflation (C,) after some steps.

        `residual` is (k, C, E), `formal` (k, k, E); `included` (C, E) is 0 for exposures that are
        held out, else 1.
        """
        x = _coordinates(sigma, fraction, kappa2, self.outliers)
        value = self._log_density(x, residual, formal, included)
        for step in range(STEPS):
            length = SHRINK if step % 2 else 1.0
            trial = x + length * rng.standard_normal(x.shape) @ self.factor.T
            new = self._log_density(trial, residual, formal, included)
            taken = np.log(rng.random(len(x))) < new - value
            x = np.where(taken[:, None], trial, x)
            value = np.where(taken, new, value)
        n = x.shape[1] - 2 * self.outliers
        sigma = from_coordinates(x[:, :n])[0]
        if not self.outliers:
            return sigma, fraction, kappa2
        return sigma, expit(x[:, n]), np.exp(x[:, n + 1])

    def _log_density(self, x: Float, residual: Float, formal: Float, included: Float) -> Float:
        n = x.shape[1] - 2 * self.outliers
        # a large step makes a numerically singular matrix, which is rejected as NaN
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            sigma, out = from_coordinates(x[:, :n])
            out = out + log_prior(sigma)
            factor = cholesky(formal[:, :, None] + sigma[..., None])
            distance = (solve_factor(factor, residual) ** 2).sum(axis=0)
            k = len(sigma)
            log_det = 2 * sum(np.log(factor[j, j]) for j in range(k))
            if self.outliers:
                f, log_kappa2 = x[:, n], x[:, n + 1]
                a, b = FRACTION_PRIOR
                out = out + a * log_expit(f) + b * log_expit(-f)
                kappa2 = np.exp(log_kappa2)
                out = out - KAPPA_SHAPE * log_kappa2 - KAPPA_RATE / kappa2
                inside = (kappa2 >= MIN_KAPPA**2) & (expit(f) <= MAX_FRACTION)
                out = np.where(inside, out, -np.inf)
                each = log_mixture(distance, log_det, k, expit(f), kappa2)
            else:
                each = -0.5 * (distance + log_det)
            out = out + (included * each).sum(axis=1)
        return np.where(np.isfinite(out), out, -np.inf)


def _coordinates(sigma: Float, fraction: Float, kappa2: Float, outliers: bool) -> Float:
    x = to_coordinates(sigma)
    if not outliers:
        return x
    return np.column_stack([x, logit(fraction), np.log(kappa2)])
