"""Marginal density of the grid coordinates, interpolated between the nodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline, PchipInterpolator

from bayesdist.infer.density.piecewise import PiecewiseExponential
from bayesdist.infer.stars.mixture import TAILS
from bayesdist.utils.arrays import Bool, Float

MESH = {1: 4001, 2: 401}  # interpolation points per axis, by the number of axes


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
        """Convert uniform random numbers (n, g) to draws (n, g) of the density."""
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
