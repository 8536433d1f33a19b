"""Independence proposal: a Laplace approximation at each node of a grid.

If the quoted errors are right, the posterior of the jitter is concentrated at its lower bound, and
a single Gaussian misses the tail of log j although its acceptance still looks good.  Therefore
log j is drawn from its marginal density, interpolated over about 25 values, with the exact
exponential tail of prior and Jacobian at small j.  All other parameters are drawn from the
conditional Gaussian.

A table with hardly any false matches does not determine their scale, and the outlier fraction that
is compatible with the data depends on that scale by orders of magnitude.  In this case log s_out is
the second axis of the grid, and the conditional density of f has heavier tails than a Gaussian,
since a single doubtful star skews it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from bayesdist.infer.density.coordinates import Split
from bayesdist.infer.density.laplace import Node
from bayesdist.infer.density.marginal import Marginal, cardinal
from bayesdist.infer.equations.arrow import Arrow
from bayesdist.utils.arrays import Float, Int

Random = np.random.Generator | np.random.RandomState

WIDE, SHARE = 2.0, 0.1  # heavier tails of f: a fraction SHARE of the draws is WIDE times wider


class Proposal(Protocol):
    """Approximation of the posterior density that can be sampled and evaluated."""

    @property
    def best(self) -> Node:
        """Laplace approximation at the most probable grid point."""

    def draw(self, n: int, rng: Random) -> Float:
        """Points (n, D) in sampled coordinates; NaN where a draw falls outside the support."""

    def log_density(self, psi: Float) -> Float:
        """Log density (n,) of points (n, D), up to a constant."""


@dataclass(frozen=True, eq=False)
class GridProposal:
    """Proposal density q(psi) from Laplace approximations at the nodes of a grid.

    The nodes form a product grid over the hyperparameters `split.held`, the last axis varying
    fastest; there is a single node if no hyperparameter is on the grid.
    """

    split: Split
    nodes: tuple[Node, ...]

    @cached_property
    def best(self) -> Node:
        """Node with the largest marginal density."""
        return max(self.nodes, key=lambda node: node.log_marginal)

    @cached_property
    def _at(self) -> Float:
        return np.array([node.at for node in self.nodes])

    @cached_property
    def _axes(self) -> tuple[Float, ...]:
        """Coordinates of the nodes along each axis."""
        return tuple(np.unique(column) for column in self._at.T)

    @cached_property
    def _shape(self) -> tuple[int, ...]:
        return tuple(len(axis) for axis in self._axes)

    @cached_property
    def _modes(self) -> Float:
        return np.array([node.mode for node in self.nodes])

    @cached_property
    def _marginal(self) -> Marginal:
        values = np.array([node.log_marginal for node in self.nodes]).reshape(self._shape)
        return Marginal.of(self.split.held, self._axes, values)

    @cached_property
    def _between(self) -> Float:
        """Quantities (nodes, 2 D') to interpolate: conditional means and log standard deviations.

        For hyperparameters, which change by orders of magnitude, it is the logarithm of the mean.
        """
        means, n = self._modes.copy(), self.split.n_theta
        means[:, n:] = np.log(means[:, n:])
        log_sd = np.array([0.5 * np.log(node.factor.variances()) for node in self.nodes])
        return np.concatenate([means, log_sd], axis=1)

    @property
    def _n_wide(self) -> int:
        """Number of coordinates, at the end of y, that have heavier tails than a Gaussian."""
        return len(self.split.rest) if "s_out" in self.split.held else 0

    def _conditional(self, at: Float) -> tuple[Float, Float, Int]:
        """Conditional Gaussians at grid coordinates (n, g), interpolated between the nodes.

        Returns the means (n, D'), the log ratios (n, D') of the standard deviations to those of the
        nearest node, and the indices (n,) of the nearest nodes.  The correlations of the nearest
        node are used, since they hardly change from node to node.
        """
        weights, nearest = np.ones((len(at), 1)), np.zeros(len(at), np.int64)
        local = len(self._axes) > 1
        for axis, x in zip(self._axes, at.T, strict=True):
            along = cardinal(axis, local=local)(np.clip(x, axis[0], axis[-1]))
            size = weights.shape[1] * len(axis)
            weights = (weights[:, :, None] * along[:, None]).reshape(len(at), size)
            middles = (axis[1:] + axis[:-1]) / 2
            nearest = nearest * len(axis) + np.searchsorted(middles, x)
        mean, log_sd = np.split(weights @ self._between, 2, axis=1)
        mean[:, self.split.n_theta :] = np.exp(mean[:, self.split.n_theta :])
        return mean, log_sd - self._between[nearest, mean.shape[1] :], nearest

    def draw(self, n: int, rng: Random) -> Float:
        """Points (n, D) in sampled coordinates; NaN where a draw falls outside the support."""
        z = rng.standard_normal(size=(n, len(self.nodes[0].mode)))
        at = self._marginal.draw(rng.uniform(size=(n, len(self._axes))))
        if k := self._n_wide:
            z[:, -k:] *= np.where(rng.uniform(size=(n, k)) < SHARE, WIDE, 1.0)
        y, log_scale, nearest = self._conditional(at)
        for k in np.unique(nearest):
            rows = nearest == k
            y[rows] += np.exp(log_scale[rows]) * self.nodes[k].factor.colour(z[rows])
        ok = self.split.contains(y)
        out = np.full((n, self.split.n_theta + len(self.split.hyper)), np.nan)
        out[ok] = self.split.to_psi(y[ok], at[ok])
        return out

    def log_density(self, psi: Float) -> Float:
        """Log q (n,) of points (n, D); the mass outside the support is not renormalised."""
        y, at = self.split.from_psi(psi)
        centre, log_scale, nearest = self._conditional(at)
        shift = (y - centre) * np.exp(-log_scale)
        out = self._marginal.log_density(at) - log_scale.sum(axis=1) - self.split.log_jacobian(y)
        for k in np.unique(nearest):
            rows = nearest == k
            factor = self.nodes[k].factor
            white = factor.whiten(shift[rows])
            out[rows] += 0.5 * factor.logdet - 0.5 * (white**2).sum(axis=1)
            tail = white[:, white.shape[1] - self._n_wide :]
            wide = np.log(SHARE / WIDE) + 0.5 * (1 - WIDE**-2) * tail**2
            out[rows] += np.logaddexp(np.log(1 - SHARE), wide).sum(axis=1)
        return out - 0.5 * y.shape[1] * np.log(2 * np.pi)

    # -- as arrays, for checkpoints ---------------------------------------------------------------

    def to_arrays(self) -> dict[str, Float]:
        """Arrays by name; `from_arrays` restores the proposal from them, bit for bit."""
        return {
            "at": self._at,
            "held": np.array(self.split.columns[0], float),
            "mode": self._modes,
            "log_marginal": np.array([n.log_marginal for n in self.nodes]),
            "border": np.array([n.factor.matrix.border for n in self.nodes]),
            "edge": np.array([n.factor.matrix.edge for n in self.nodes]),
            "blocks": np.array([n.factor.matrix.blocks for n in self.nodes]),
        }

    @classmethod
    def from_arrays(
        cls, n_theta: int, hyper: tuple[str, ...], arrays: Mapping[str, Float]
    ) -> GridProposal:
        """Restore a proposal from the arrays of `to_arrays`; see `Split` for `n_theta`, `hyper`."""
        split = Split(n_theta, hyper, tuple(hyper[int(k)] for k in arrays["held"]))
        n_tail = len(split.rest)
        matrices = zip(arrays["border"], arrays["edge"], arrays["blocks"], strict=True)
        factors = [Arrow(*parts, n_tail=n_tail).factor() for parts in matrices]
        values = map(float, arrays["log_marginal"])
        nodes = zip(arrays["at"], arrays["mode"], factors, values, strict=True)
        return cls(split, tuple(Node(*node) for node in nodes))
