"""Nodes of a chip's look-up table, and removal of the part that the polynomial describes.

A table and a polynomial overlap: a smooth pattern could be part of either.  It is assigned to the
polynomial by making the node values orthogonal to all polynomials of the model's order.  The inner
product is the sum over the nodes, which represent equal areas of the detector.  The normal
equations of both are sums over the stars:

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

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.stars.stars import Sums
from bayesdist.model import Chip, PolynomialBasis
from bayesdist.model.lookup import LookupTable
from bayesdist.utils.arrays import Float, Int

STEP = (64.0, 64.0)  # node distance in pixels, as in D2IMFILE and NPOLFILE

BLOCK = 65_536  # stars processed at a time; their polynomials take 11 MB at order 5


@dataclass(frozen=True)
class NodeGrid:
    """Grid of nodes at the centres of equal bins of a chip.

    Parameters
    ----------
    chip : Chip
    order : int
        Order of the polynomial that is fitted together with the table.
    step : tuple of float
        Size of a bin along x and y in pixels.

    Raises
    ------
    InputError
        If the step is not positive, or if there are too few nodes to represent more than the
        polynomial.
    """

    chip: Chip
    order: int
    step: tuple[float, float] = STEP

    def __post_init__(self) -> None:
        if not min(self.step) > 0:
            raise InputError(
                f"the nodes are {self.step} pixels apart", do="give two positive numbers"
            )
        ny, nx = self.shape
        if min(nx, ny) < 2 or nx * ny <= self.basis.n_terms:
            raise InputError(
                f"{nx} x {ny} nodes cannot describe more than a polynomial of order {self.order}",
                where=f"look-up table of chip {self.chip.number}",
                do="give a smaller step or a lower order",
            )

    @property
    def shape(self) -> tuple[int, int]:
        """Number of nodes along y and x: (ny, nx)."""
        nx, ny = (
            int(np.ceil(n / s - 1e-9)) for n, s in zip(self.chip.size, self.step, strict=True)
        )
        return ny, nx

    @property
    def n_nodes(self) -> int:
        """Number of nodes, nx * ny."""
        ny, nx = self.shape
        return ny * nx

    @property
    def basis(self) -> PolynomialBasis:
        """Polynomial basis over the chip."""
        return PolynomialBasis(self.order, self.chip.size, self.chip.reference_pixel)

    def table(self, values: Float, sigma: Float | None = None, *, filter: str = "") -> LookupTable:
        """Look-up table with values and errors (2, n_nodes) or (2, ny, nx), in pixels."""
        shape = (2, *self.shape)
        first = (self.step[0] + 1) / 2, (self.step[1] + 1) / 2
        spread = None if sigma is None else np.reshape(sigma, shape)
        number = self.chip.number
        return LookupTable(number, np.reshape(values, shape), filter, first, self.step, spread)

    @cached_property
    def blank(self) -> LookupTable:
        """Look-up table of zeros, used for its node positions and interpolation weights."""
        return self.table(np.zeros((2, self.n_nodes)))

    def interpolation(self, x: Float, y: Float) -> scipy.sparse.csr_array:
        """Bilinear weights (N, n_nodes) of the nodes at pixels (N,): four entries per row."""
        index, weight = self.blank.weights(x, y)
        starts = np.arange(0, index.size + 1, 4)
        shape = (len(x), self.n_nodes)
        return scipy.sparse.csr_array((weight.ravel(), index.ravel(), starts), shape)

    @cached_property
    def positions(self) -> tuple[Float, Float]:
        """Pixel coordinates x, y (n_nodes,) of the nodes."""
        x, y = np.meshgrid(*self.blank.nodes())
        return x.ravel(), y.ravel()

    @cached_property
    def polynomials(self) -> Float:
        """Orthonormal basis (n_nodes, K) of the polynomials at the nodes."""
        return np.linalg.qr(self.basis.evaluate(*self.positions))[0]

    def without_polynomials(self, values: Float) -> Float:
        """Node values (n_nodes, ...) without their polynomial part."""
        Q = self.polynomials
        return values - Q @ (Q.T @ values)

    def without_their_polynomials(self, matrix: Float) -> Float:
        """Project a symmetric matrix (n_nodes, n_nodes) orthogonally to the polynomials.

        Gives the covariance of node values without their polynomial part if `matrix` is the
        covariance of the node values, and likewise for an information matrix.  The matrix is
        modified in place and returned.
        """
        Q = self.polynomials
        MQ = matrix @ Q
        Z = MQ - 0.5 * Q @ (Q.T @ MQ)
        ZQ, QZ = np.concatenate([Z, Q], axis=1), np.concatenate([Q, Z], axis=1)
        matrix -= ZQ @ QZ.T
        return matrix

    @cached_property
    def lag(self) -> Int:
        """Index into `lags` for each pair of nodes, shape (n_nodes, n_nodes)."""
        ny, nx = self.shape
        row, column = np.divmod(np.arange(ny * nx), nx)
        along_y = np.abs(row[:, None] - row)
        return along_y * nx + np.abs(column[:, None] - column)

    @cached_property
    def lags(self) -> Float:
        """Distances (n_nodes,) of all nodes from the first node, in pixels."""
        x, y = self.positions
        return np.hypot(x - x[0], y - y[0])

    @cached_property
    def polynomials_by_lag(self) -> Float:
        """Projector (n_nodes,) on the polynomials, summed over pairs of nodes with equal lag."""
        Q = self.polynomials
        return np.bincount(self.lag.ravel(), (Q @ Q.T).ravel(), self.n_nodes).astype(float)


# -- normal equations of the nodes and the polynomial of one chip, accumulated over the stars ------


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
