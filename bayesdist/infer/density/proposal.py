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

The weight of a draw is w = target / proposal density.  An independence chain at a point of
weight w rejects a proposal of weight w' with probability 1 - min(1, w'/w).  Efficiency, warm-up
and autocorrelation time therefore follow from the weights alone.

Log weights are NaN for draws outside the support, which are not evaluated; they have weight zero.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline, PchipInterpolator

from bayesdist.infer.convergence import importance_efficiency, pareto_k
from bayesdist.infer.density.laplace import Node, Split
from bayesdist.infer.equations.arrow import Arrow
from bayesdist.infer.stars.likelihood import TAILS
from bayesdist.utils.arrays import Bool, Float, Int

Random = np.random.Generator | np.random.RandomState
WIDE, SHARE = 2.0, 0.1  # heavier tails of f: a fraction SHARE of the draws is WIDE times wider
MESH = {1: 4001, 2: 401}  # interpolation points per axis, by the number of axes

CLOSE = 0.02  # total variation distance from the posterior at which warm-up ends
MOST_WARMUP = 10_000


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
            "order": np.array([n.factor.matrix.entries for n in self.nodes]),
        }

    @classmethod
    def from_arrays(
        cls, n_theta: int, hyper: tuple[str, ...], arrays: Mapping[str, Float]
    ) -> GridProposal:
        """Restore a proposal from the arrays of `to_arrays`; see `Split` for `n_theta`, `hyper`."""
        split = Split(n_theta, hyper, tuple(hyper[int(k)] for k in arrays["held"]))
        n_tail = len(split.rest)
        stored = (arrays[name] for name in ("border", "edge", "blocks", "order"))
        factors = [
            Arrow(border, edge, blocks, n_tail, order=order).factor()
            for border, edge, blocks, order in zip(*stored, strict=True)
        ]
        values = map(float, arrays["log_marginal"])
        nodes = zip(arrays["at"], arrays["mode"], factors, values, strict=True)
        return cls(split, tuple(Node(*node) for node in nodes))


# -- marginal density of the grid coordinates ------------------------------------------------------


def cardinal(axis: Float, *, local: bool) -> CubicSpline | CubicHermiteSpline:
    """Cardinal splines (len(axis),): spline k is one at node k and zero at the other nodes.

    If `local` is True, slopes are those of parabolas through three adjacent nodes, so that a node
    has no effect beyond the second node to either side.  Otherwise cubic splines, which are
    smoother.
    """
    unit = np.eye(len(axis))
    if not local:
        return CubicSpline(axis, unit)
    return CubicHermiteSpline(axis, unit, np.gradient(unit, axis, axis=0, edge_order=2))


@dataclass(frozen=True, eq=False)
class Marginal:
    """Normalised density in zero, one or two dimensions that can be sampled and evaluated."""

    first: PiecewiseExponential | None  # marginal density of the first coordinate
    # density of the second coordinate, conditional on each mesh point of the first
    second: tuple[PiecewiseExponential, ...] = ()

    @classmethod
    def of(cls, names: Sequence[str], axes: Sequence[Float], values: Float) -> Marginal:
        """Interpolate log densities `values` at the nodes of a product grid with these `axes`.

        `names` are the hyperparameters of the axes; their priors determine the slopes of the tails.
        """
        # nodes of a single axis follow the density; a product grid has nodes of negligible density,
        # where a cubic spline would overshoot
        kind = CubicSpline if len(axes) == 1 else PchipInterpolator
        meshes = [np.linspace(axis[0], axis[-1], MESH[len(axes)]) for axis in axes]
        for k, (axis, mesh) in enumerate(zip(axes, meshes, strict=True)):
            values = kind(axis, values, axis=k)(mesh)
        if not meshes:
            return cls(None)
        if len(meshes) == 1:
            return cls(_with_tails(names[0], meshes[0], values))
        second = tuple(_with_tails(names[1], meshes[1], row) for row in values)
        masses = np.array([density.log_mass for density in second])
        return cls(_with_tails(names[0], meshes[0], masses), second)

    def draw(self, p: Float) -> Float:
        """Convert uniform random numbers `p` (n, g) to draws (n, g) of the density."""
        out = np.empty_like(p)
        if self.first is not None:
            out[:, 0] = self.first.quantile(p[:, 0])
        for rows, density in self._conditionals(out):
            out[rows, 1] = density.quantile(p[rows, 1])
        return out

    def log_density(self, at: Float) -> Float:
        """Log density (n,) of points (n, g)."""
        out = np.zeros(len(at))
        if self.first is not None:
            out += self.first.log_density(at[:, 0])
        for rows, density in self._conditionals(at):
            out[rows] += density.log_density(at[rows, 1])
        return out

    def _conditionals(self, at: Float) -> Iterator[tuple[Bool, PiecewiseExponential]]:
        """Yield Boolean masks (n,) of points and the density of their second coordinate."""
        if self.first is None or not self.second:
            return
        mesh = self.first.mesh
        nearest = np.searchsorted((mesh[1:] + mesh[:-1]) / 2, at[:, 0])
        for k in np.unique(nearest):
            yield nearest == k, self.second[k]


def _with_tails(name: str, mesh: Float, values: Float) -> PiecewiseExponential:
    step = mesh[1] - mesh[0]
    left_slope = max(values[1] - values[0], 1e-3) / step
    right = min(values[-1] - values[-2], -1e-3) / step
    end, slope = TAILS[name]
    return PiecewiseExponential(
        mesh,
        values,
        left_slope=slope if end == "left" else left_slope,
        right_slope=slope if end == "right" else right,
    )


class PiecewiseExponential:
    """Density with a piecewise linear logarithm.

    `mesh` (m,) are ascending points and `values` (m,) the log densities there, up to a constant.
    The logarithm is linear between them and, with `left_slope` > 0 and `right_slope` < 0, beyond
    the first and last point.
    """

    def __init__(self, mesh: Float, values: Float, left_slope: float, right_slope: float) -> None:
        self.mesh = mesh
        self.slopes = np.concatenate([[left_slope], np.diff(values) / np.diff(mesh), [right_slope]])
        self.top = values.max()
        heights = np.exp(values - self.top)
        # mass of each cell relative to its higher end, so that nothing overflows
        fall = np.abs(np.diff(values))
        inner = np.maximum(heights[1:], heights[:-1]) * np.diff(mesh) * _mean_of_fall(fall)
        mass = np.concatenate([[heights[0] / left_slope], inner, [-heights[-1] / right_slope]])
        self.cumulative = np.concatenate([[0.0], np.cumsum(mass)])
        self.total = mass.sum()
        self.values = values - self.log_mass

    @property
    def log_mass(self) -> float:
        """Logarithm of the integral of exp(values)."""
        return float(self.top + np.log(self.total))

    def log_density(self, x: Float) -> Float:
        """Normalised log density (n,) at points (n,)."""
        k = np.searchsorted(self.mesh, x)  # 0: left of the mesh
        anchor = np.maximum(k - 1, 0)
        return self.values[anchor] + self.slopes[k] * (x - self.mesh[anchor])

    def quantile(self, p: Float) -> Float:
        """Quantiles (n,) of the density at probabilities p (n,)."""
        m = np.clip(p, 1e-300, 1 - 1e-16) * self.total
        k = np.clip(np.searchsorted(self.cumulative, m, side="right") - 1, 0, len(self.slopes) - 1)
        share = (m - self.cumulative[k]) / (self.cumulative[k + 1] - self.cumulative[k])
        share = np.clip(share, 1e-300, 1.0)
        last = len(self.slopes) - 1
        left_end, right = self.mesh[np.maximum(k - 1, 0)], self.mesh[np.minimum(k, last - 1)]
        rise = self.slopes[k] * (right - left_end)  # of the cell; 0 for the tails
        # measured from the higher end of the cell: fraction of its mass, and of its width, up to x
        beyond = np.where(rise > 0, 1 - share, share)
        fall = np.abs(rise)
        flat = fall < 1e-9
        safe = np.where(flat, 1.0, fall)
        down = np.where(flat, beyond, -np.log1p(beyond * np.expm1(-safe)) / safe)
        inside = np.where(
            rise > 0, right - down * (right - left_end), left_end + down * (right - left_end)
        )
        with np.errstate(divide="ignore"):
            below = self.mesh[0] + np.log(share) / self.slopes[0]
            above = self.mesh[-1] + np.log1p(-np.minimum(share, 1 - 1e-16)) / self.slopes[-1]
        return np.where(k == 0, below, np.where(k == last, above, inside))


def _mean_of_fall(fall: Float) -> Float:
    """Mean of exp(-fall t) over t from 0 to 1."""
    flat = fall < 1e-9
    safe = np.where(flat, 1.0, fall)
    return np.where(flat, 1.0, -np.expm1(-safe) / safe)


# -- quality, from the importance weights ----------------------------------------------------------


@dataclass(frozen=True)
class Quality:
    """Quality of a proposal."""

    efficiency: float  # effective sample size of weighted draws over their number
    k: float  # Pareto shape of the tail of the weights
    log_weights: Float  # of the draws inside the support
    n_outside: int  # number of draws outside the support


def quality_of(log_weights: Float) -> Quality:
    """Importance efficiency and Pareto k of log weights (any shape)."""
    inside = log_weights[~np.isnan(log_weights)]
    n_outside = log_weights.size - inside.size
    if not np.isfinite(inside).any():
        return Quality(0.0, float("inf"), inside, n_outside)
    efficiency = importance_efficiency(inside, n_outside)
    return Quality(efficiency, pareto_k(inside), inside, n_outside)


def rejection(log_weights: Float) -> tuple[Float, Float]:
    """Normalised non-zero weights (m,), ascending, and the rejection rate (m,) at each of them.

    A weight is the posterior mass of its point.  The rejection rate is the mean of
    1 - min(1, w'/w) over the other draws.
    """
    flat = log_weights.ravel()
    log_w = np.sort(flat[np.isfinite(flat)])
    n_others, n_zero = flat.size - 1, flat.size - log_w.size
    w = np.exp(log_w - log_w[-1])
    below = np.cumsum(w) - w
    smaller = np.arange(log_w.size)
    # draws of smaller weight are rejected in part, those of zero weight always, larger ones never
    rate = (n_zero + smaller - below / np.maximum(w, 1e-300)) / max(n_others, 1)
    return w / w.sum(), np.clip(rate, 0.0, 1.0)


def warmup_steps(log_weights: Float) -> int:
    """Number of warm-up steps of an independence chain that starts from a draw of the proposal.

    The bound follows from a coupling argument.  A second chain starts from an exact posterior draw
    and uses the same proposals and uniform numbers.  Once the chain with the larger weight accepts
    a proposal, the other accepts it too, and the chains are identical afterwards.  Hence the total
    variation distance after t steps is at most the mean of r(max(w, w*))^t, with w drawn from the
    proposal, w* from the posterior, and r the rejection rate.  Returns the first t for which this
    bound is at most `CLOSE`.
    """
    mass, rate = rejection(log_weights)
    by_proposal = np.arange(1, len(mass) + 1) / len(mass)
    larger = np.diff(by_proposal * np.cumsum(mass), prepend=0.0)
    for t in range(1, MOST_WARMUP):
        if larger @ rate**t <= CLOSE:
            return t
    return MOST_WARMUP


def draws_per_effective(log_weights: Float) -> float:
    """Integrated autocorrelation time of an independence chain.

    For functions that do not depend on the weight, the autocorrelation at lag t is the posterior
    mean of r^t, with r the rejection rate.  The time is 1 + 2 sum_t E[r^t] = 1 + 2 E[r / (1 - r)].
    """
    mass, rate = rejection(log_weights)
    return float(1 + 2 * mass @ (rate / np.maximum(1 - rate, 1e-6)))
