"""A posterior known in closed form that is not Gaussian: the jitter of a linear model.

With equal errors s and no outliers, theta given j is Gaussian about the least-squares solution with
covariance v (X^T X)^-1, v = s^2 + j^2; integrating it out leaves one dimension,

    p(log j | data) = p(log j) (2 pi v)^(K - N) exp(-RSS / 2v) / det(X^T X)

(N stars, K terms, two axes).  When the errors are right, j piles up at its bound: log j has a long
exponential tail to the left.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import stats

from .support import legendre_design


@dataclass(frozen=True)
class JitterOracle:
    order: int
    x: np.ndarray
    y: np.ndarray
    data: np.ndarray  # (N, 2)
    sigma: float
    mesh = np.linspace(-20.0, 7.0, 60_001)  # log j / sigma

    @classmethod
    def of(cls, order, matches):
        sigma = float(matches.sigma_u[0])
        assert (matches.sigma_u == sigma).all() and (matches.sigma_v == sigma).all()
        return cls(order, matches.x, matches.y, np.column_stack([matches.u, matches.v]), sigma)

    @cached_property
    def design(self) -> np.ndarray:
        return legendre_design(self.order, self.x, self.y)

    @cached_property
    def centre(self) -> np.ndarray:
        """Least-squares coefficients, shape (2 K,)."""
        return np.linalg.lstsq(self.design, self.data)[0].T.ravel()

    @cached_property
    def unit_cov(self) -> np.ndarray:
        """Covariance at v = 1, shape (2 K, 2 K)."""
        return np.kron(np.eye(2), np.linalg.inv(self.design.T @ self.design))

    @cached_property
    def log_j(self) -> np.ndarray:
        return self.mesh + np.log(self.sigma)

    @cached_property
    def variance(self) -> np.ndarray:
        return self.sigma**2 + np.exp(2 * self.log_j)

    @cached_property
    def log_joint(self) -> np.ndarray:
        """log p(log j, data) on the mesh."""
        N, K = self.design.shape
        rss = ((self.data - self.design @ self.centre.reshape(2, K).T) ** 2).sum()
        prior = np.log(2) + stats.t(4, scale=self.sigma).logpdf(np.exp(self.log_j)) + self.log_j
        det = np.linalg.slogdet(self.design.T @ self.design)[1]
        v = self.variance
        return prior + (K - N) * np.log(2 * np.pi * v) - rss / (2 * v) - det

    @cached_property
    def log_evidence(self) -> float:
        top = self.log_joint.max()
        return top + np.log(np.trapezoid(np.exp(self.log_joint - top), self.log_j))

    @cached_property
    def density(self) -> np.ndarray:
        return np.exp(self.log_joint - self.log_evidence)

    def expect(self, values: np.ndarray) -> float:
        """Posterior mean of a function of log j given on the mesh."""
        return float(np.trapezoid(self.density * values, self.log_j))

    def cdf(self, log_j: np.ndarray) -> np.ndarray:
        steps = (self.density[1:] + self.density[:-1]) / 2 * np.diff(self.log_j)
        return np.interp(log_j, self.log_j, np.concatenate([[0.0], np.cumsum(steps)]))

    def draw(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Exact draws of (theta, log j), shape (n, 2 K + 1)."""
        t = np.interp(rng.uniform(size=n), self.cdf(self.log_j), self.log_j)
        root = np.linalg.cholesky(self.unit_cov)
        wide = np.sqrt(self.sigma**2 + np.exp(2 * t))
        theta = self.centre + wide[:, None] * (rng.standard_normal((n, len(root))) @ root.T)
        return np.column_stack([theta, t])
