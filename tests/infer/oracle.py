"""What the library must find, by other routes: one posterior in closed form, one star in numpy.

`JitterOracle` is a posterior known in closed form that is not Gaussian: the jitter of a linear
model.  With equal errors s and no outliers, theta given j is Gaussian about the least-squares
solution with covariance v (X^T X)^-1, v = s^2 + j^2; integrating it out leaves one dimension,

    p(log j | data) = p(log j) (2 pi v)^(K - N) exp(-RSS / 2v) / det(X^T X)

(N stars, K terms, two axes).  When the errors are right, j piles up at its bound: log j has a long
exponential tail to the left.

`star_terms` are value and derivatives of each star's log-likelihood, written down in numpy.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import stats
from scipy.special import expit

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


@dataclass(frozen=True)
class StarTerms:
    """First and second derivatives of each star's log-likelihood, by residual and hyperparameters.

    Hyperparameters are log j, logit f, log s_out, all three whatever the mixture.

    Parameters
    ----------
    loglik, outlier : ndarray, shape (n,)
        The log-likelihood, and the probability of being an outlier.
    pull : ndarray, shape (n, 2)
        Minus the gradient by the residual: what a weighted residual is in least squares.
    weight, safe_weight : ndarray, shape (n, 3)
        Minus the Hessian by the residual (uu, uv, vv), and the same at fixed memberships.
    gradient : ndarray, shape (n, 3)
    cross : ndarray, shape (n, 3, 2)
        Mixed derivative by hyperparameter and residual.
    curvature : ndarray, shape (n, 3, 3)
        Minus the Hessian by the hyperparameters.
    """

    loglik: np.ndarray
    outlier: np.ndarray
    pull: np.ndarray
    weight: np.ndarray
    safe_weight: np.ndarray
    gradient: np.ndarray
    cross: np.ndarray
    curvature: np.ndarray


def star_terms(model, residual, var_u, var_v, *, j=0.0, f=0.0, s_out=1.0, radius=1.0) -> StarTerms:
    """Of log[(1 - f) N(r; s^2 + j^2) + f p_out(r)], p_out 'gaussian', 'uniform' or 'none'.

    With g and b the logarithms of the two parts and p = expit(b - g), derivatives of the sum are
    means over the two parts; second ones have the variance p (1 - p) (g' - b')^2 besides.
    """
    ru, rv = residual.T
    n, j2, out = len(ru), j**2, s_out**2
    au, av = var_u + j2, var_v + j2
    eu, ev, e = ru**2 / au, rv**2 / av, (ru**2 + rv**2) / out
    good = -0.5 * (eu + ev + np.log(au) + np.log(av)) - np.log(2 * np.pi)
    zero = np.zeros(n)
    if model == "none":
        p, q, loglik, bad_by, bad_weight = zero, zero + 1, good, np.zeros((n, 5)), 0.0
        f = 0.0
    else:
        good = good + np.log1p(-f)
        if model == "gaussian":
            bad = np.log(f) - 0.5 * e - np.log(2 * np.pi * out)
            bad_by = np.stack([-ru / out, -rv / out, zero, zero + 1 - f, e - 2], axis=1)
            bad_weight = 1 / out
        else:
            bad = zero + np.log(f) - np.log(np.pi * radius**2)
            bad_by = np.stack([zero, zero, zero, zero + 1 - f, zero], axis=1)
            bad_weight = 0.0
        p, q, loglik = expit(bad - good), expit(good - bad), np.logaddexp(good, bad)
    by_j = j2 * ((eu - 1) / au + (ev - 1) / av)
    good_by = np.stack([-ru / au, -rv / av, by_j, zero - f, zero], axis=1)
    gradient = q[:, None] * good_by + p[:, None] * bad_by
    D = good_by - bad_by
    wavering = (p * q)[:, None, None] * D[:, :, None] * D[:, None, :]
    own = np.zeros((n, 5, 5))  # mean Hessian of the parts
    own[:, 0, 0], own[:, 1, 1] = -(q / au + p * bad_weight), -(q / av + p * bad_weight)
    for axis, (r, a) in enumerate(((ru, au), (rv, av))):
        own[:, 2, axis] = q * 2 * j2 * r / a**2
        own[:, 4, axis] = p * 2 * r * bad_weight
    own[:, 2, 2] = q * (2 * by_j + 2 * j2**2 * ((1 - 2 * eu) / au**2 + (1 - 2 * ev) / av**2))
    own[:, 3, 3] = -f * (1 - f)
    own[:, 4, 4] = -2 * p * e if model == "gaussian" else 0.0
    hessian = own + wavering
    return StarTerms(
        loglik,
        p,
        -gradient[:, :2],
        -np.stack([hessian[:, 0, 0], hessian[:, 0, 1], hessian[:, 1, 1]], axis=1),
        -np.stack([own[:, 0, 0], zero, own[:, 1, 1]], axis=1),
        gradient[:, 2:],
        hessian[:, 2:, :2],
        -hessian[:, 2:, 2:],
    )
