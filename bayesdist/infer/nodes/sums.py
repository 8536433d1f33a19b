"""Normal equations of the nodes and the polynomial of one chip, accumulated over the stars.

    r = W d + Phi c + noise

r are pixel shifts, W bilinear weights, d node values, Phi the polynomials and c their coefficients.
Each star is read once, and the size of the sums does not depend on the number of stars.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.sparse

from bayesdist.errors import DegenerateError
from bayesdist.infer.nodes.grid import NodeGrid
from bayesdist.infer.stars.sums import Sums
from bayesdist.utils.arrays import Float

BLOCK = 65_536  # stars processed at a time; their polynomials take 11 MB at order 5


@dataclass(frozen=True, eq=False)
class NodeSums(Sums):
    """Normal equations of one axis, for n nodes and K polynomial terms; N is the noise variance."""

    nodes: scipy.sparse.csr_array  # W^T N^-1 W (n, n), nine entries per row
    cross: Float  # Phi^T N^-1 W (K, n)
    polynomial: Float  # Phi^T N^-1 Phi (K, K)
    right: Float  # W^T N^-1 r (n,)
    right_polynomial: Float  # Phi^T N^-1 r (K,)

    @cached_property
    def _factor(self) -> tuple[Float, bool]:
        factor: tuple[Float, bool] = scipy.linalg.cho_factor(self.polynomial, lower=True)
        return factor

    @cached_property
    def absorbed(self) -> Float:
        """Minus the derivatives (K, n) of the polynomial coefficients with respect to the nodes."""
        return scipy.linalg.cho_solve(self._factor, self.cross)

    @cached_property
    def polynomial_root(self) -> Float:
        """Matrix R (K, K) such that R R^T is the covariance of the polynomial for fixed nodes."""
        L, _ = self._factor
        return scipy.linalg.solve_triangular(L, np.eye(len(L)), lower=True).T

    def polynomial_of(self, values: Float) -> Float:
        """Best-fitting polynomial coefficients (K,) for given node values (n,)."""
        free: Float = scipy.linalg.cho_solve(self._factor, self.right_polynomial)
        return free - self.absorbed @ values

    @cached_property
    def marginal_right(self) -> Float:
        """Right-hand side (n,) of the node equations after eliminating the polynomial."""
        return self.right - self.absorbed.T @ self.right_polynomial

    def informed(self, values: Float) -> Float:
        """Multiply node values (n, ...) by `information`, without forming that matrix."""
        return self.nodes @ values - self.cross.T @ (self.absorbed @ values)

    @property
    def information(self) -> Float:
        """Information matrix (n, n) of the nodes after eliminating the polynomial."""
        return self.nodes.toarray() - self.cross.T @ self.absorbed


def node_sums(
    grid: NodeGrid, x: Float, y: Float, shift: Float, precision: Float
) -> tuple[NodeSums, NodeSums]:
    """Accumulate the normal equations of one chip, for the x and the y axis.

    `x`, `y` (N,) are raw pixel coordinates, `shift` (N, 2) the corrections to be added to them, and
    `precision` (N, 2) the inverse variances, zero for stars to ignore.  Raises DegenerateError if
    the stars do not determine the polynomial.
    """
    total = _block(grid, x[:BLOCK], y[:BLOCK], shift[:BLOCK], precision[:BLOCK])
    for start in range(BLOCK, len(x), BLOCK):
        rows = slice(start, start + BLOCK)
        part = _block(grid, x[rows], y[rows], shift[rows], precision[rows])
        total = total[0] + part[0], total[1] + part[1]
    for sums in total:
        scale = np.sqrt(np.diag(sums.polynomial))
        values = (
            np.linalg.eigvalsh(sums.polynomial / np.outer(scale, scale)) if scale.all() else [0.0]
        )
        if values[0] < 1e-11:
            raise DegenerateError(
                f"{int((precision[:, 0] > 0).sum())} stars do not determine a polynomial of order "
                f"{grid.order}",
                where=f"look-up table of chip {grid.chip.number}",
                do="give stars over the whole chip, or a lower order",
            )
    return total


def _block(
    grid: NodeGrid, x: Float, y: Float, shift: Float, precision: Float
) -> tuple[NodeSums, NodeSums]:
    W, phi = grid.interpolation(x, y), grid.basis.evaluate(x, y)
    transposed = W.T.tocsr()

    def one(axis: int) -> NodeSums:
        w, r = precision[:, axis], shift[:, axis]
        weighted = phi * w[:, None]
        heavy = W.copy()
        heavy.data = W.data * np.repeat(w, 4)
        return NodeSums(
            nodes=(transposed @ heavy).tocsr(),
            cross=(transposed @ weighted).T,
            polynomial=phi.T @ weighted,
            right=transposed @ (w * r),
            right_polynomial=weighted.T @ r,
        )

    return one(0), one(1)
