"""Simulated pattern in the residuals due to the partition of the point-spread function.

According to WSDC D-T033, section 5, point sources are fitted with a template that differs between
blocks of the array.  The residuals show the blocks: 5 x 5 in W1 and W2, 2 x 2 in W3, none in W4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from bayesdist.model import PolynomialBasis
from bayesdist.model.grid import mesh
from bayesdist.utils.arrays import Float

BLOCKS = {"W1": 5, "W2": 5, "W3": 2}  # per axis


@dataclass(frozen=True, eq=False)
class PartitionPattern:
    """Offsets that are linear within blocks and discontinuous at their edges.

    The polynomial `smooth` is subtracted, so that the pattern is orthogonal to polynomials and the
    true coefficients are unique.
    """

    basis: PolynomialBasis
    local: Float  # (2, k, k, 3), by axis, row and column: offset, tilt along x, along y; pixels
    smooth: Float  # (2, n_terms), Legendre coefficients along x and y

    @property
    def blocks(self) -> int:
        """Number of blocks per axis."""
        return self.local.shape[1]

    def offsets(self, x: Float, y: Float) -> Float:
        """Offsets (N, 2) in pixels at FITS 1-based pixels (N,)."""
        return self.blocked(x, y) - self.basis.evaluate(x, y) @ self.smooth.T

    def blocked(self, x: Float, y: Float) -> Float:
        """Offsets (N, 2) without the subtracted polynomial, at pixels (N,)."""
        k = self.blocks
        at = []
        for scaled in self.basis.scaled(x, y):
            within = (scaled + 1.0) * (k / 2)
            block = np.clip(within.astype(np.int64), 0, k - 1)
            at.append((block, 2.0 * (within - block) - 1.0))
        (column, dx), (row, dy) = at
        offset, tilt_x, tilt_y = np.moveaxis(self.local[:, row, column], 2, 0)
        return (offset + tilt_x * dx + tilt_y * dy).T


def partition_pattern(
    basis: PolynomialBasis, blocks: int, sigma: tuple[float, float], rng: np.random.Generator
) -> PartitionPattern:
    """Random pattern with `blocks` blocks per axis and an rms of `sigma` pixels on x and y."""
    local = rng.standard_normal((2, blocks, blocks, 3))
    raw = PartitionPattern(basis, local, np.zeros((2, basis.n_terms)))
    x, y, weight = _nodes(basis, blocks)
    phi = basis.evaluate(x, y)
    weighted = phi * weight[:, None]
    normal, right = weighted.T @ phi, weighted.T @ raw.offsets(x, y)
    smooth = np.asarray(np.linalg.solve(normal, right).T, np.float64)
    square: Float = np.square(PartitionPattern(basis, local, smooth).offsets(x, y))
    rms = np.sqrt(weight @ square)
    factor = np.asarray(sigma) / rms
    return PartitionPattern(basis, local * factor[:, None, None, None], smooth * factor[:, None])


def _nodes(basis: PolynomialBasis, blocks: int) -> tuple[Float, Float, Float]:
    """Pixels x, y, and weights with sum 1 that integrate polynomials exactly in all blocks."""
    nodes, weights = legendre.leggauss(basis.order + 1)
    within = ((np.arange(blocks)[:, None] + (nodes + 1.0) / 2.0) / blocks).ravel()
    axis_weights = np.tile(weights / (2.0 * blocks), blocks)
    nx, ny = basis.size
    return *mesh(0.5 + nx * within, 0.5 + ny * within), np.outer(axis_weights, axis_weights).ravel()
