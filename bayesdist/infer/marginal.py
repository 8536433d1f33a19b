"""Density of the grid's coordinates, interpolated between the nodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from bayesdist.infer.mixture import TAILS
from bayesdist.infer.piecewise import PiecewiseExponential

__all__ = ["Marginal", "cardinal"]

Float = NDArray[np.float64]

MESH = {1: 4001, 2: 401}  # points of each axis, by their number


def cardinal(axis: Float) -> CubicSpline:
    """Splines (len(axis),) that are one at their own node and zero at the others."""
    return CubicSpline(axis, np.eye(len(axis)))


@dataclass(frozen=True, eq=False)
class Marginal:
    """A normalised density in no, one or two dimensions, to be drawn from and evaluated.

    Parameters
    ----------
    first : PiecewiseExponential or None
        Of the first coordinate.
    second : tuple of PiecewiseExponential
        Of the second one, in the neighbourhood of each mesh point of the first.
    """

    first: PiecewiseExponential | None
    second: tuple[PiecewiseExponential, ...] = ()

    @classmethod
    def of(cls, names: Sequence[str], axes: Sequence[Float], values: Float) -> Marginal:
        """Interpolate log densities at the nodes of a product grid.

        Parameters
        ----------
        names : sequence of str
            Hyperparameters of the axes: what is known of their tails.
        axes : sequence of ndarray
        values : ndarray, one dimension for each axis
        """
        meshes = []
        for k, axis in enumerate(axes):
            meshes.append(np.linspace(axis[0], axis[-1], MESH[len(axes)]))
            along = np.tensordot(cardinal(axis)(meshes[-1]), values, axes=(1, k))
            values = np.moveaxis(along, 0, k)
        if not meshes:
            return cls(None)
        if len(meshes) == 1:
            return cls(_with_tails(names[0], meshes[0], values))
        second = tuple(_with_tails(names[1], meshes[1], row) for row in values)
        masses = np.array([density.log_mass for density in second])
        return cls(_with_tails(names[0], meshes[0], masses), second)

    def draw(self, p: Float) -> Float:
        """Points (n, g) from uniform random numbers (n, g)."""
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

    def _conditionals(self, at: Float) -> Iterator[tuple[NDArray[np.bool_], PiecewiseExponential]]:
        """Which points have which density of their second coordinate."""
        if self.first is None or not self.second:
            return
        mesh = self.first.mesh
        nearest = np.searchsorted((mesh[1:] + mesh[:-1]) / 2, at[:, 0])
        for k in np.unique(nearest):
            yield nearest == k, self.second[k]


def _with_tails(name: str, mesh: Float, values: Float) -> PiecewiseExponential:
    step = mesh[1] - mesh[0]
    left = max(values[1] - values[0], 1e-3) / step
    right = min(values[-1] - values[-2], -1e-3) / step
    end, slope = TAILS[name]
    return PiecewiseExponential(
        mesh,
        values,
        left_slope=slope if end == "left" else left,
        right_slope=slope if end == "right" else right,
    )
