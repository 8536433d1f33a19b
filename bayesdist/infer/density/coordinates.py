"""Coordinates in which the conditional posterior of f and s_out is nearly Gaussian.

With few outliers logit f and log s_out are skewed, with exponential tails that a Gaussian proposal
does not cover. The cube root of a gamma variable is nearly Gaussian (Wilson and Hilferty 1931), so
proposals are made in

    f^(1/3)     and     s_out^(-2/3)  (the cube root of the outliers' precision)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.utils.arrays import Bool, Float


def to_cube_root(names: tuple[str, ...], h: Float) -> Float:
    """Convert sampled coordinates h (..., k) to cube-root coordinates (..., k).

    `names` are the hyperparameters along the last axis of h: 'f' (logit f), 's_out' (log s_out).
    """
    out = np.empty_like(h)
    for k, name in enumerate(names):
        t = h[..., k]
        out[..., k] = (1 + np.exp(-t)) ** (-1 / 3) if name == "f" else np.exp(-2 * t / 3)
    return out


def inside(names: tuple[str, ...], z: Float) -> Bool:
    """Boolean mask (...) that is True for cube-root coordinates z (..., k) in the support."""
    ok = np.all(z > 0, axis=-1)
    if "f" in names:
        ok &= z[..., names.index("f")] < 1
    return np.asarray(ok)


def from_cube_root(names: tuple[str, ...], z: Float) -> tuple[Float, Float, Float, Float, Float]:
    """Convert cube-root coordinates to sampled coordinates, with derivatives.

    `z` (..., k) are points in the support, `names` the hyperparameter ('f' or 's_out') of each
    coordinate.  Returns h (logit f or log s_out), its first and second derivatives h1 and h2 with
    respect to z, and the first and second derivatives of log |h1|, each of shape (..., k).
    """
    h, h1, h2 = np.empty_like(z), np.empty_like(z), np.empty_like(z)
    g1, g2 = np.empty_like(z), np.empty_like(z)
    for k, name in enumerate(names):
        t = z[..., k]
        if name == "f":
            a, b = 1 - 4 * t**3, t - t**4
            h[..., k] = 3 * np.log(t) - np.log1p(-(t**3))
            h1[..., k], h2[..., k] = 3 / b, -3 * a / b**2
            g1[..., k], g2[..., k] = -a / b, (12 * t**2 * b + a**2) / b**2
        else:
            h[..., k] = -1.5 * np.log(t)
            h1[..., k], h2[..., k] = -1.5 / t, 1.5 / t**2
            g1[..., k], g2[..., k] = -1 / t, 1 / t**2
    return h, h1, h2, g1, g2


@dataclass(frozen=True)
class Split:
    """Division of the sampled coordinates into those on a grid and those that are Gaussian.

    Points psi (..., D) are split into the coordinates `at` (..., g) on the grid, such as log j and
    log s_out, and y (..., D'): theta and the other hyperparameters in cube-root coordinates.
    """

    n_theta: int
    hyper: tuple[str, ...]  # hyperparameters that are sampled, in the order 'j', 'f', 's_out'
    held: tuple[str, ...]  # hyperparameters on the grid; includes 'j' if it is sampled

    @property
    def rest(self) -> tuple[str, ...]:
        """Hyperparameters that are not on the grid."""
        return tuple(name for name in self.hyper if name not in self.held)

    @property
    def columns(self) -> tuple[list[int], list[int]]:
        """Indices in `hyper` of the hyperparameters on the grid, and of the remaining ones."""
        held = [self.hyper.index(name) for name in self.held]
        return held, [self.hyper.index(name) for name in self.rest]

    def contains(self, y: Float) -> Bool:
        """Boolean mask (...) that is True for points y (..., D') in the support."""
        return np.isfinite(y).all(axis=-1) & inside(self.rest, y[..., self.n_theta :])

    def to_psi(self, y: Float, at: Float) -> Float:
        """Sampled coordinates psi (..., D) from y (..., D') and grid coordinates (..., g)."""
        n, (held, off_grid) = self.n_theta, self.columns
        out = np.empty((*y.shape[:-1], n + len(self.hyper)))
        out[..., :n] = y[..., :n]
        out[..., [n + k for k in held]] = at
        out[..., [n + k for k in off_grid]] = from_cube_root(self.rest, y[..., n:])[0]
        return out

    def from_psi(self, psi: Float) -> tuple[Float, Float]:
        """Split psi (..., D) into y (..., D') and the grid coordinates (..., g)."""
        n, (held, off_grid) = self.n_theta, self.columns
        z = to_cube_root(self.rest, psi[..., [n + k for k in off_grid]])
        return np.concatenate([psi[..., :n], z], axis=-1), psi[..., [n + k for k in held]]

    def log_jacobian(self, y: Float) -> Float:
        """Log |d psi / d y| (...)."""
        h1 = from_cube_root(self.rest, y[..., self.n_theta :])[1]
        return np.asarray(np.log(np.abs(h1)).sum(axis=-1))
