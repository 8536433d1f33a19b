"""Independence proposal: a Laplace approximation at each node of a grid.

When the quoted errors are right, the jitter piles up at its bound and a single Gaussian misses the
tail of log j while its acceptance still looks fine.  Here log j is drawn from its marginal,
interpolated over about 25 values, with the exact exponential tail that prior and Jacobian give at
small j; everything else is drawn from the conditional Gaussian.

A table with next to no false matches hardly determines their scale, and the fraction that it allows
depends on that scale by orders of magnitude.  Then the grid has log s_out as its second axis, and
the conditional of f has heavier tails than a Gaussian: one doubtful star skews it.
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

WIDE, SHARE = 2.0, 0.1  # draws of an uncertain f are so much wider, so often


class Proposal(Protocol):
    """A density near the posterior, to be drawn from and evaluated."""

    @property
    def best(self) -> Node:
        """Laplace approximation where the grid's coordinates are most probable."""

    def draw(self, n: int, rng: Random) -> Float:
        """Points (n, D) in sampled coordinates; NaN where a draw falls outside the support."""

    def log_density(self, psi: Float) -> Float:
        """Log density (n,) of points (n, D), up to a constant."""


@dataclass(frozen=True, eq=False)
class GridProposal:
    """Proposal density q(psi), to be drawn from and evaluated.

    The nodes are on the product of the axes of `split`, the last of them running fastest; a single
    one where no hyperparameter is on the grid.
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
        """Values of the nodes along each axis."""
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
        """Interpolated quantities (nodes, 2 D'): means, and logarithms of the standard deviations.

        The means of the hyperparameters, which change by orders of magnitude, are logarithms too.
        """
        means, n = self._modes.copy(), self.split.n_theta
        means[:, n:] = np.log(means[:, n:])
        log_sd = np.array([0.5 * np.log(node.factor.variances()) for node in self.nodes])
        return np.concatenate([means, log_sd], axis=1)

    @property
    def _n_wide(self) -> int:
        """Number of the last coordinates that have heavier tails."""
        return len(self.split.rest) if "s_out" in self.split.held else 0

    def _conditional(self, at: Float) -> tuple[Float, Float, Int]:
        """Conditional mean (n, D'), and nearest node (n,) with factors (n, D') on its sigma.

        Correlations hardly change from node to node, so only standard deviations are scaled.
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
        """Log q (n,) of points (n, D), normalised up to the mass outside the support."""
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
        """Arrays by name from which `from_arrays` builds it again, bit for bit."""
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
        """Proposal from the arrays of `to_arrays`; other arguments as in `Split`."""
        split = Split(n_theta, hyper, tuple(hyper[int(k)] for k in arrays["held"]))
        n_tail = len(split.rest)
        matrices = zip(arrays["border"], arrays["edge"], arrays["blocks"], strict=True)
        factors = [Arrow(*parts, n_tail=n_tail).factor() for parts in matrices]
        values = map(float, arrays["log_marginal"])
        nodes = zip(arrays["at"], arrays["mode"], factors, values, strict=True)
        return cls(split, tuple(Node(*node) for node in nodes))
