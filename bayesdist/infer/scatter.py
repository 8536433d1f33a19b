"""The scatter of deviations, from what the data say of each of them.

Deviations b ~ N(0, T), T = diag(tau^2) with one tau for each kind, and data that say of them, with
everything else integrated out, the quadratic form b^T S b - 2 s^T b.  Then

    log p(data | tau) = -1/2 log |1 + T^1/2 S T^1/2| + 1/2 s^T (S + T^-1)^-1 s

the restricted likelihood (REML: the coefficients are integrated out, not maximised).  Its maximum
is the fixed point tau_k^2 = mean over e of (b_ek^2 + var b_ek) of the EM algorithm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize
from scipy.special import logsumexp

from bayesdist.errors import DegenerateError

__all__ = ["Scatter"]

Float = NDArray[np.float64]

DEGREES = 4.0  # of freedom of the prior on tau, a half-Student-t
PROPOSAL_DEGREES = 5.0
SMALLEST = 1e-6  # of the prior's scale: where the search for tau ends


@dataclass(frozen=True, eq=False)
class Scatter:
    """What the data say of the deviations, and hence of their scatter.

    Parameters
    ----------
    kinds : tuple of str, length k
        Kinds of deviation.
    kind : ndarray of int, shape (n,)
        Kind of each deviation.
    information : ndarray, shape (n, n)
        S; everything that is not a deviation is integrated out.
    pull : ndarray, shape (n,)
        s.
    scale : float
        Of the half-Student-t prior on each tau, with 4 degrees of freedom.
    """

    kinds: tuple[str, ...]
    kind: NDArray[np.int64]
    information: Float
    pull: Float
    scale: float

    def _factor(self, tau: Float) -> tuple[tuple[Float, bool], Float]:
        root = tau[self.kind]
        inner = root[:, None] * self.information * root
        inner[np.diag_indices_from(inner)] += 1.0
        return cho_factor(inner, lower=True), root

    def moments(self, tau: Float) -> tuple[Float, Float]:
        """Mean (n,) and covariance (n, n) of the deviations where their scatter is tau (k,)."""
        factor, root = self._factor(tau)
        cov = root[:, None] * cho_solve(factor, np.diag(root))
        return cov @ self.pull, (cov + cov.T) / 2

    def log_density(self, tau: Float) -> float:
        """Log posterior density of log tau, up to a constant."""
        factor, root = self._factor(tau)
        half = solve_triangular(factor[0], root * self.pull, lower=True)
        value = 0.5 * half @ half - np.log(np.diag(factor[0])).sum()
        prior = -0.5 * (DEGREES + 1) * np.log1p((tau / self.scale) ** 2 / DEGREES)
        return float(value + (prior + np.log(tau)).sum())

    def gradient(self, tau: Float) -> Float:
        """Derivative of `log_density` by log tau, shape (k,)."""
        mean, cov = self.moments(tau)
        second = np.bincount(self.kind, mean**2 + np.diag(cov), len(self.kinds))
        ratio = (tau / self.scale) ** 2
        prior = 1.0 - (DEGREES + 1) * ratio / (DEGREES + ratio)
        return np.asarray(second / tau**2 - np.bincount(self.kind) + prior)

    def mode(self) -> Float:
        """The most probable log tau, shape (k,)."""
        first = np.full(len(self.kinds), np.log(self.scale) - 2.0)
        bounds = [(np.log(SMALLEST * self.scale), np.log(self.scale) + 12.0)] * len(first)
        found = minimize(
            lambda x: -self.log_density(np.exp(x)),
            first,
            jac=lambda x: -self.gradient(np.exp(x)),
            method="L-BFGS-B",
            bounds=bounds,
            options={"gtol": 1e-4, "ftol": 1e-12},
        )
        return np.asarray(found.x)

    def over(self, taus: Float) -> tuple[Float, Float]:
        """Mean and covariance of the deviations, averaged over draws of tau (n, k)."""
        means, within = np.zeros((len(taus), len(self.pull))), np.zeros_like(self.information)
        for t, tau in enumerate(taus):
            means[t], cov = self.moments(tau)
            within += cov
        spread = means - means.mean(axis=0)
        return means.mean(axis=0), (within + spread.T @ spread) / len(taus)

    def draws(self, n: int, rng: np.random.Generator) -> Float:
        """Draws of tau from its posterior, shape (n, k), of equal weight.

        Importance sampling of log tau: Student-t proposals about the mode, resampled.  The factor
        tau that belongs to log tau makes a mode even where the data allow no scatter at all.

        Raises
        ------
        DegenerateError
            When the proposals do not reach the posterior.
        """
        x = self.mode()
        step = 1e-3
        curvature = np.array(
            [
                (self.gradient(np.exp(x - step * e)) - self.gradient(np.exp(x + step * e)))
                / (2 * step)
                for e in np.eye(len(x))
            ]
        )
        values, vectors = np.linalg.eigh((curvature + curvature.T) / 2)
        # a tail towards zero falls as exp(x): no wider than a few units of log tau
        root = vectors / np.sqrt(np.maximum(values, 0.2))
        z = rng.standard_normal((2 * n, len(x)))
        z *= np.sqrt(PROPOSAL_DEGREES / rng.chisquare(PROPOSAL_DEGREES, (2 * n, 1)))
        points = np.exp(np.clip(x + z @ root.T, -80.0, 5.0))
        log_q = -0.5 * (PROPOSAL_DEGREES + len(x)) * np.log1p((z**2).sum(axis=1) / PROPOSAL_DEGREES)
        log_w = np.array([self.log_density(t) for t in points]) - log_q
        w = np.exp(log_w - logsumexp(log_w))
        if 1 / (w**2).sum() < 0.05 * len(w):
            raise DegenerateError(
                "the posterior of the scatter between exposures has no simple shape",
                where="model.frames",
                do="fit fewer deviations (frames 'shift_rotation_scale') or give more exposures",
            )
        # systematic resampling
        at = (np.arange(n) + rng.uniform()) / n
        return points[np.minimum(np.searchsorted(np.cumsum(w), at), len(w) - 1)]
