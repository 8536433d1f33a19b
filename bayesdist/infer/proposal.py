"""The independence proposal: a grid over log j, with a Laplace approximation at each value.

When the quoted errors are right, the jitter piles up at its bound and a single Gaussian misses the
tail of log j while its acceptance still looks fine.  Here log j is drawn from its marginal,
interpolated over about 25 values, with the exact exponential tail that prior and Jacobian give at
small j; everything else is drawn from the conditional Gaussian.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from bayesdist.errors import DegenerateError
from bayesdist.infer.arrow import Arrow
from bayesdist.infer.coordinates import from_cube_root, inside, to_cube_root
from bayesdist.infer.laplace import (
    Conditional,
    conditional_mode,
    expected_mode,
    split_hyper,
    starting_point,
    to_psi,
)
from bayesdist.infer.linear import LinearFit
from bayesdist.infer.target import Target

__all__ = ["GridProposal", "Proposal", "Random", "build_proposal"]

Float = NDArray[np.float64]
Random = np.random.Generator | np.random.RandomState

N_NODES = 25
DROP = 18.0  # how far (in log density) the grid reaches below the top: beyond lies 1e-8
MESH = 4001


class Proposal(Protocol):
    """A density near the posterior, to be drawn from and evaluated."""

    @property
    def best(self) -> Conditional:
        """The Laplace approximation at the most probable jitter."""

    def draw(self, n: int, rng: Random) -> Float:
        """Points (n, D) in sampled coordinates; NaN where a draw falls outside the support."""

    def log_density(self, psi: Float) -> Float:
        """Log density (n,) of points (n, D), up to a constant."""


@dataclass(frozen=True, eq=False)
class GridProposal:
    """Proposal density q(psi), to be drawn from and evaluated.

    Parameters
    ----------
    target : Target
    nodes : tuple of Conditional
        Rising in log j; a single one where the jitter is not sampled.
    """

    target: Target
    nodes: tuple[Conditional, ...]

    @cached_property
    def best(self) -> Conditional:
        """The node with the largest marginal density."""
        return max(self.nodes, key=lambda node: node.log_marginal)

    @cached_property
    def _grid(self) -> Float:
        return np.array([node.log_j for node in self.nodes], float)

    @cached_property
    def _middles(self) -> Float:
        return (self._grid[1:] + self._grid[:-1]) / 2

    @cached_property
    def _modes(self) -> Float:
        return np.array([node.mode for node in self.nodes])

    @cached_property
    def _marginal(self) -> _PiecewiseExponential:
        values = np.array([node.log_marginal for node in self.nodes])
        mesh = np.linspace(self._grid[0], self._grid[-1], MESH)
        smooth = CubicSpline(self._grid, values)(mesh)
        right = min(smooth[-1] - smooth[-2], -1e-3) / (mesh[1] - mesh[0])
        # at small j the likelihood forgets j: density of log j ~ p(j) j ~ exp(log j)
        return _PiecewiseExponential(mesh, smooth, left_slope=1.0, right_slope=right)

    @cached_property
    def _between(self) -> CubicSpline:
        """Conditional mean and logarithm of the standard deviations, (2, D') at each log j."""
        log_sd = np.array([0.5 * np.log(node.factor.variances()) for node in self.nodes])
        return CubicSpline(self._grid, np.stack([self._modes, log_sd], axis=1))

    def _at(self, log_j: Float) -> tuple[Float, Float, NDArray[np.int64]]:
        """Conditional mean (n, D'), and the nearest node (n,) with the factors (n, D').

        By these its standard deviations are to be multiplied: correlations hardly change from node
        to node.
        """
        nearest = np.searchsorted(self._middles, log_j)
        here = self._between(np.clip(log_j, self._grid[0], self._grid[-1]))
        there = self._between(self._grid)[nearest]
        return here[:, 0], here[:, 1] - there[:, 1], nearest

    def draw(self, n: int, rng: Random) -> Float:
        """Points (n, D) in sampled coordinates; NaN where a draw falls outside the support."""
        z = rng.standard_normal(size=(n, len(self.nodes[0].mode)))
        if len(self.nodes) == 1:
            log_j = None
            y = self.nodes[0].mode + self.nodes[0].factor.colour(z)
        else:
            log_j = self._marginal.quantile(rng.uniform(size=n))
            y, log_scale, nearest = self._at(log_j)
            for k in np.unique(nearest):
                rows = nearest == k
                y[rows] += np.exp(log_scale[rows]) * self.nodes[k].factor.colour(z[rows])
        _, rest = split_hyper(self.target)
        ok = inside(rest, y[:, self.target.n_theta :])
        out = np.full((n, self.target.n_theta + len(self.target.mixture.hyper)), np.nan)
        out[ok] = to_psi(self.target, y[ok], None if log_j is None else log_j[ok])
        return out

    def log_density(self, psi: Float) -> Float:
        """Log q (n,) of points (n, D), normalised up to the mass outside the support."""
        has_j, rest = split_hyper(self.target)
        n = self.target.n_theta
        z_rest = to_cube_root(rest, psi[:, n + int(has_j) :])
        y = np.concatenate([psi[:, :n], z_rest], axis=1)
        out = np.zeros(len(psi))
        if rest:
            out -= np.log(np.abs(from_cube_root(rest, z_rest)[1])).sum(axis=1)
        if has_j:
            out += self._marginal.log_density(psi[:, n])
            centre, log_scale, nearest = self._at(psi[:, n])
            shift = (y - centre) * np.exp(-log_scale)
            out -= log_scale.sum(axis=1)
        else:
            nearest = np.zeros(len(psi), np.int64)
            shift = y - self.nodes[0].mode
        for k in np.unique(nearest):
            rows = nearest == k
            factor = self.nodes[k].factor
            white = factor.whiten(shift[rows])
            out[rows] += 0.5 * factor.logdet - 0.5 * (white**2).sum(axis=1)
        return out - 0.5 * y.shape[1] * np.log(2 * np.pi)

    # -- as arrays, for checkpoints ---------------------------------------------------------------

    def to_arrays(self) -> dict[str, Float]:
        """Everything needed to build it again, bit for bit."""
        return {
            "log_j": self._grid,
            "mode": self._modes,
            "log_marginal": np.array([n.log_marginal for n in self.nodes]),
            "border": np.array([n.factor.matrix.border for n in self.nodes]),
            "edge": np.array([n.factor.matrix.edge for n in self.nodes]),
            "blocks": np.array([n.factor.matrix.blocks for n in self.nodes]),
        }

    @classmethod
    def from_arrays(cls, target: Target, arrays: Mapping[str, Float]) -> GridProposal:
        """The proposal that `to_arrays` stored."""
        has_j, rest = split_hyper(target)
        nodes = tuple(
            Conditional(
                float(arrays["log_j"][k]) if has_j else None,
                arrays["mode"][k],
                Arrow(
                    arrays["border"][k], arrays["edge"][k], arrays["blocks"][k], n_tail=len(rest)
                ).factor(),
                float(arrays["log_marginal"][k]),
            )
            for k in range(len(arrays["mode"]))
        )
        return cls(target, nodes)


def build_proposal(target: Target, fit: LinearFit) -> GridProposal:
    """Conditional modes over a grid of jitters that carries all but 1e-8 of the posterior.

    Parameters
    ----------
    target : Target
    fit : LinearFit
        Where the search starts.

    Returns
    -------
    GridProposal

    Raises
    ------
    DegenerateError
        When no mode is found, or the posterior of the jitter has no end.
    """
    y, log_j = starting_point(target, fit)
    first = conditional_mode(target, y, log_j)
    if log_j is None:
        return GridProposal(target, (first,))
    first, log_j = _climb(target, first, log_j)
    nodes = {log_j: first}
    _walk(target, nodes, direction=1.0)
    _walk(target, nodes, direction=-1.0)
    nodes = _worth_keeping(nodes)
    while len(nodes) < N_NODES:
        _refine(target, nodes)
    return GridProposal(target, tuple(nodes[k] for k in sorted(nodes)))


def _climb(target: Target, node: Conditional, log_j: float) -> tuple[Conditional, float]:
    """Up along the modes to where log j is about most probable."""
    for _ in range(30):
        # where the curvature is not that of a peak, steps of a size that leaves the plateau
        curvature = max(node.curvature, abs(node.slope), 1e-3)
        step = float(np.clip(node.slope / curvature, -1.0, 1.0))
        if step**2 * curvature < 0.1:
            break
        start, log_j = expected_mode(target, node, step), log_j + step
        node = conditional_mode(target, start, log_j, tolerance=1e-4)
    return node, log_j


def _walk(target: Target, nodes: dict[float, Conditional], direction: float) -> None:
    """Step along log j until the marginal has dropped, or is the pure tail of the prior."""
    edge = max(nodes) if direction > 0 else min(nodes)
    step = 1.0 / np.sqrt(np.clip(nodes[edge].curvature, 1.0, 1e12))
    for _ in range(200):
        edge = max(nodes) if direction > 0 else min(nodes)
        here = nodes[edge]
        stride = direction * step
        start = expected_mode(target, here, stride)
        there = conditional_mode(target, start, edge + stride, tolerance=1e-4)
        nodes[edge + stride] = there
        top = max(node.log_marginal for node in nodes.values())
        change = there.log_marginal - here.log_marginal
        if there.log_marginal < top - DROP:
            return
        forgotten = direction < 0 and abs(-change / step - 1.0) < 2e-3
        if forgotten and np.exp(edge) < 0.3 * target.hyper.scale:
            return
        # steps that change the density by about 2: neither creeping nor leaping
        step = float(
            np.clip(step * np.clip((2.0 / max(abs(change), 0.25)) ** 0.7, 0.2, 4.0), 1e-7, 1.0)
        )
    raise DegenerateError(
        "the posterior of the jitter has no end",
        where="outliers",
        do="check the units of the errors",
    )


def _worth_keeping(nodes: dict[float, Conditional]) -> dict[float, Conditional]:
    """Without the nodes far below the top, but for one on either side."""
    top = max(node.log_marginal for node in nodes.values())
    grid = sorted(nodes)
    good = [k for k, x in enumerate(grid) if nodes[x].log_marginal > top - DROP]
    keep = grid[max(good[0] - 1, 0) : good[-1] + 2]
    return {x: nodes[x] for x in keep}


def _refine(target: Target, nodes: dict[float, Conditional]) -> None:
    """Halve the interval that carries most of the posterior."""
    grid = np.array(sorted(nodes))
    values = np.array([nodes[x].log_marginal for x in grid])
    density = np.exp(values - values.max())
    width = np.diff(grid)
    k = int(np.argmax(width**2 * np.maximum(density[1:], density[:-1]) + 1e-3 * width))
    middle = float((grid[k] + grid[k + 1]) / 2)
    low, high = nodes[grid[k]], nodes[grid[k + 1]]
    ends = expected_mode(target, low, width[k] / 4), expected_mode(target, high, -width[k] / 4)
    start = (ends[0] + ends[1]) / 2  # cubic Hermite
    nodes[middle] = conditional_mode(target, start, middle, tolerance=1e-4)


class _PiecewiseExponential:
    """A density whose logarithm is linear between mesh points and beyond them."""

    def __init__(self, mesh: Float, values: Float, left_slope: float, right_slope: float) -> None:
        self.mesh = mesh
        self.slopes = np.concatenate([[left_slope], np.diff(values) / np.diff(mesh), [right_slope]])
        top = values.max()
        heights = np.maximum(np.exp(values - top), 1e-300)
        width = np.diff(mesh)
        rise = self.slopes[1:-1] * width
        flat = np.abs(rise) < 1e-9
        safe = np.where(flat, 1.0, rise)
        inner = heights[:-1] * width * np.where(flat, 1.0, np.expm1(safe) / safe)
        mass = np.concatenate([[heights[0] / left_slope], inner, [-heights[-1] / right_slope]])
        self.cumulative = np.concatenate([[0.0], np.cumsum(mass)])
        self.heights, self.total = heights, mass.sum()
        self.values = values - top - np.log(self.total)

    def log_density(self, x: Float) -> Float:
        k = np.searchsorted(self.mesh, x)  # 0: left of the mesh
        anchor = np.maximum(k - 1, 0)
        return self.values[anchor] + self.slopes[k] * (x - self.mesh[anchor])

    def quantile(self, p: Float) -> Float:
        m = np.clip(p, 1e-300, 1 - 1e-16) * self.total
        k = np.clip(np.searchsorted(self.cumulative, m, side="right") - 1, 0, len(self.slopes) - 1)
        anchor = np.maximum(k - 1, 0)
        slope, height = self.slopes[k], self.heights[anchor]
        inside_mass = m - self.cumulative[k]
        # left tail: mass up to x is h exp(s (x - x0)) / s
        left = (
            self.mesh[0]
            + np.log(np.maximum(m * self.slopes[0] / self.heights[0], 1e-300)) / (self.slopes[0])
        )
        flat = np.abs(slope) < 1e-9
        safe = np.where(flat, 1.0, slope)
        grown = np.log1p(np.maximum(inside_mass * safe / height, -1 + 1e-16)) / safe
        right = self.mesh[anchor] + np.where(flat, inside_mass / height, grown)
        return np.where(k == 0, left, right)
