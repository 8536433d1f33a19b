"""Random-walk steps of the scatter and of the outlier mixture, all memberships summed out.

They are needed where the exact draws given memberships and deviations mix slowly: where it is not
clear which exposures lie off, so that a narrow scatter with many outliers and a wide one with few
both fit, and where the intrinsic scatter is small against the formal errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, log_expit, logit

from bayesdist.infer.series.scatter import from_coordinates, log_prior, to_coordinates
from bayesdist.infer.series.small import cholesky, solve_factor

__all__ = [
    "FRACTION_MOST",
    "FRACTION_PRIOR",
    "KAPPA_LEAST",
    "KAPPA_RATE",
    "KAPPA_SHAPE",
    "RandomWalk",
    "log_mixture",
]

Float = NDArray[np.float64]

FRACTION_PRIOR = (1.0, 9.0)
FRACTION_MOST = 0.25
KAPPA_LEAST = 3.0
KAPPA_SHAPE = 1.0
KAPPA_RATE = KAPPA_SHAPE * 5.0**2  # log kappa is most probable at log 5
STEPS = 6
SHRINK = 0.3  # every other step is this much shorter


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
        kept: Float,
        rng: np.random.Generator,
    ) -> tuple[Float, Float, Float]:
        """Scatter (k, k, C), fraction and inflation (C,) after some steps.

        `residual` is (k, C, E), `formal` (k, k, E); `kept` (C, E) is 0 for exposures that are held
        out, else 1.
        """
        x = _coordinates(sigma, fraction, kappa2, self.outliers)
        value = self._log_density(x, residual, formal, kept)
        for step in range(STEPS):
            length = SHRINK if step % 2 else 1.0
            trial = x + length * rng.standard_normal(x.shape) @ self.factor.T
            new = self._log_density(trial, residual, formal, kept)
            taken = np.log(rng.random(len(x))) < new - value
            x = np.where(taken[:, None], trial, x)
            value = np.where(taken, new, value)
        n = x.shape[1] - 2 * self.outliers
        sigma = from_coordinates(x[:, :n])[0]
        if not self.outliers:
            return sigma, fraction, kappa2
        return sigma, expit(x[:, n]), np.exp(x[:, n + 1])

    def _log_density(self, x: Float, residual: Float, formal: Float, kept: Float) -> Float:
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
                inside = (kappa2 >= KAPPA_LEAST**2) & (expit(f) <= FRACTION_MOST)
                out = np.where(inside, out, -np.inf)
                each = log_mixture(distance, log_det, k, expit(f), kappa2)
            else:
                each = -0.5 * (distance + log_det)
            out = out + (kept * each).sum(axis=1)
        return np.where(np.isfinite(out), out, -np.inf)


def _coordinates(sigma: Float, fraction: Float, kappa2: Float, outliers: bool) -> Float:
    x = to_coordinates(sigma)
    if not outliers:
        return x
    return np.column_stack([x, logit(fraction), np.log(kappa2)])
