"""The same posterior in plain numpy, as users write it down today.

The design matrix (products of Legendre polynomials, total order up to n) is computed once; each
evaluation multiplies it with one parameter vector.  Nothing here comes from the library, so that
equal densities mean something.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.polynomial.legendre import legvander2d
from numpy.typing import NDArray

from tests.benchmarks.problem import SIZE, Problem

__all__ = ["PlainDensity", "legendre_design"]

Float = NDArray[np.float64]


def legendre_design(x: Float, y: Float, order: int) -> Float:
    """P_i(X) P_j(Y), i + j <= order, by total order, then falling power of x; shape (N, K)."""
    X, Y = 2 * (x - 0.5) / SIZE[0] - 1, 2 * (y - 0.5) / SIZE[1] - 1
    full = legvander2d(X, Y, [order, order])
    pairs = [(total - j, j) for total in range(order + 1) for j in range(total + 1)]
    return full[:, [i * (order + 1) + j for i, j in pairs]]


class PlainDensity:
    """Log posterior of one parameter vector at a time.

    Parameters
    ----------
    problem : Problem
    """

    def __init__(self, problem: Problem) -> None:
        m = problem.matches
        self.order = problem.model.order
        self.x, self.y = m.x, m.y
        self.data = np.column_stack([m.u, m.v])
        self.variance = np.column_stack([m.sigma_u, m.sigma_v]) ** 2
        self.scale = problem.scale

    @cached_property
    def design(self) -> Float:
        """Legendre design matrix, shape (N, K)."""
        return legendre_design(self.x, self.y, self.order)

    def __call__(self, psi: Float) -> float:
        K = self.design.shape[1]
        log_j, logit_f, log_s = psi[2 * K :]
        j2, excess2 = np.exp(2 * log_j), np.exp(2 * log_s)
        core2 = self.scale**2 + j2
        s2 = core2 + excess2
        log_f, log_1f = -np.logaddexp(0, -logit_f), -np.logaddexp(0, logit_f)
        square = (self.data - self.design @ psi[: 2 * K].reshape(2, K).T) ** 2
        width = self.variance + j2
        good = log_1f - 0.5 * (square / width + np.log(width)).sum(axis=1)
        bad = log_f - 0.5 * square.sum(axis=1) / s2 - np.log(s2)
        # half-Student-t(4), Beta(1, 9), inverse gamma on the excess; Jacobians of log, logit, log
        prior = log_j - 2.5 * np.log1p(j2 / (4 * self.scale**2))
        prior += log_f + 9 * log_1f + np.log(core2) - 2 * log_s - 25 * core2 / excess2
        value = float(np.logaddexp(good, bad).sum() + prior)
        return value if np.isfinite(value) else -np.inf
