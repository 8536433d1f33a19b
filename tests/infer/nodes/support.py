"""Small chips with a known pattern, and a dense solution that owes nothing to the library."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gamma, kv

from bayesdist.infer.nodes import Matern, NodeGrid, TableFit
from bayesdist.model import Chip, corrected
from tests.infer.support import legendre_design

SIZE = (640.0, 512.0)
CHIP = Chip(1, "A", SIZE, (320.0, 256.0))
STEP = (32.0, 32.0)
ORDER = 3
PATTERN = Matern(0.08, 70.0, 1.5)


def grid(order: int = ORDER, step: tuple[float, float] = STEP, chip: Chip = CHIP) -> NodeGrid:
    return NodeGrid(chip, order, step)


def hats(x, n: int, step: float) -> np.ndarray:
    """Linear interpolation (N, n) between nodes at bin centres, constant beyond the outer ones."""
    nodes = (step + 1) / 2 + step * np.arange(n)
    return np.stack([np.interp(x, nodes, row) for row in np.eye(n)], axis=1)


def bilinear(x, y, step=STEP, size=SIZE) -> np.ndarray:
    """W (N, ny nx) by products of hats."""
    nx, ny = (int(n / s) for n, s in zip(size, step, strict=True))
    full = hats(y, ny, step[1])[:, :, None] * hats(x, nx, step[0])[:, None, :]
    return full.reshape(len(x), ny * nx)


def node_pixels(step=STEP, size=SIZE) -> tuple[np.ndarray, np.ndarray]:
    axes = [(s + 1) / 2 + s * np.arange(int(n / s)) for n, s in zip(size, step, strict=True)]
    x, y = np.meshgrid(*axes)
    return x.ravel(), y.ravel()


def matern_covariance(prior: Matern, x, y) -> np.ndarray:
    """The general formula with Bessel functions, and the nugget that the library states."""
    r = np.hypot(x[:, None] - x, y[:, None] - y)
    nu = prior.smoothness
    t = np.sqrt(2 * nu) * np.where(r > 0, r, 1.0) / prior.length
    c = np.where(r > 0, 2 ** (1 - nu) / gamma(nu) * t**nu * kv(nu, t), 1.0)
    return prior.amplitude**2 * (c + 1e-9 * np.eye(len(x)))


def projector(order: int = ORDER, step=STEP, size=SIZE) -> np.ndarray:
    """What takes the polynomial part off node values, by least squares on the nodes."""
    phi = legendre_design(order, *node_pixels(step, size), size=size)
    return np.eye(len(phi)) - phi @ np.linalg.pinv(phi)


def pattern(rng, prior: Matern = PATTERN, order: int = ORDER) -> np.ndarray:
    """Node values (n, 2) drawn from the prior, without their polynomial part."""
    K = matern_covariance(prior, *node_pixels())
    P = projector(order)
    return P @ np.linalg.cholesky(K) @ rng.standard_normal((len(K), 2))


def places(rng, n: int, *, gradient: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of stars: even, or three times denser on the right than on the left."""
    p = rng.random(n)
    if gradient:
        p = (np.sqrt(1 + 8 * p) - 1) / 2
    return 0.5 + SIZE[0] * p, 0.5 + SIZE[1] * rng.random(n)


@dataclass(frozen=True)
class Joint:
    """Exact solution of nodes and polynomial together: one Gaussian solve for each axis."""

    mean: np.ndarray  # (n + K, 2): free nodes f, polynomial
    cov: np.ndarray  # (2, n + K, n + K)
    order: int
    step: tuple[float, float]

    def design(self, x, y) -> np.ndarray:
        W = bilinear(x, y, self.step) @ projector(self.order, self.step)
        return np.concatenate([W, legendre_design(self.order, x, y, size=SIZE)], axis=1)

    @property
    def nodes(self) -> tuple[np.ndarray, np.ndarray]:
        """Node values (n, 2) and their covariance (2, n, n)."""
        P = projector(self.order, self.step)
        n = len(P)
        return P @ self.mean[:n], P @ self.cov[:, :n, :n] @ P

    def at(self, x, y) -> tuple[np.ndarray, np.ndarray]:
        """Shift and its sigma (N, 2) at pixels: table and polynomial."""
        D = self.design(x, y)
        return D @ self.mean, np.sqrt(np.einsum("ni,aij,nj->na", D, self.cov, D))


def joint_solution(x, y, r, variance, priors, order: int = ORDER, step=STEP) -> Joint:
    """Dense solution with a flat prior on the polynomial; variance (N,) or (N, 2)."""
    out = Joint(np.zeros((0, 2)), np.zeros((2, 0, 0)), order, step)
    D = out.design(x, y)
    n = len(node_pixels(step)[0])
    means, covs = [], []
    for a, prior in enumerate(priors):
        v = np.asarray(variance)
        w = 1 / (v[:, a] if v.ndim == 2 else v)
        H = (D * w[:, None]).T @ D
        H[:n, :n] += np.linalg.inv(matern_covariance(prior, *node_pixels(step)))
        covs.append(np.linalg.inv(H))
        means.append(covs[-1] @ (D.T @ (w * r[:, a])))
    return Joint(np.stack(means, axis=1), np.stack(covs), order, step)


def predict(fit: TableFit, x, y, *, chip: int, **where) -> np.ndarray:
    """Positions (u, v) of raw pixels: tables, then polynomial."""
    px, py = corrected(fit.tables, x, y, chip=chip, filter=fit.filter)
    return fit.solution.model.predict(fit.solution.mean, px, py, chip=chip, **where)


def table_sigma(fit: TableFit, x, y, *, chip: int, **where) -> np.ndarray:
    """Standard error of (u, v) by the tables alone."""
    px, py = corrected(fit.tables, x, y, chip=chip, filter=fit.filter)
    J = fit.solution.model.slopes(fit.solution.mean, px, py, chip=chip, **where)
    return np.sqrt(np.einsum("nab,nb->na", J**2, fit.shift_variance(x, y, chip=chip)))


def position_sigma(fit: TableFit, x, y, *, chip: int, **where) -> np.ndarray:
    """Standard error of (u, v): polynomial with all its terms, and tables."""
    px, py = corrected(fit.tables, x, y, chip=chip, filter=fit.filter)
    D = fit.solution.model.jacobian(fit.solution.mean, px, py, chip=chip, **where)
    formal = np.einsum("nap,pq,naq->na", D, fit.solution.cov, D, optimize=True)
    return np.sqrt(table_sigma(fit, x, y, chip=chip, **where) ** 2 + formal)
