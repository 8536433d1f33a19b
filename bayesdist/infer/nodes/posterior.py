"""Posterior of a look-up table: node values, their covariance, errors in between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from bayesdist.infer.nodes.grid import NodeGrid
from bayesdist.infer.nodes.hyperparameters import FittedField, Matern, cholesky
from bayesdist.infer.nodes.sums import NodeSums
from bayesdist.model.lookup import LookupTable
from bayesdist.utils.arrays import Float

BLOCK = 2048  # pixels whose rows over all nodes are in memory at once
COLUMNS = 512  # of a symmetric product, of which no more than one triangle is made


@dataclass(frozen=True, eq=False)
class AxisField:
    """Posterior of the node values of one axis: Gaussian, the polynomial being integrated out."""

    mean: Float  # (n,) pixels
    root: Float  # R (n, n) with R R^T the covariance
    field: FittedField  # hyperparameters
    sums: NodeSums  # normal equations of the stars

    @property
    def sigma(self) -> Float:
        """Standard error (n,) of each node, pixels."""
        return np.sqrt(np.einsum("ij,ij->i", self.root, self.root))

    @property
    def cov(self) -> Float:
        """Covariance (n, n), square pixels."""
        return self.root @ self.root.T

    @property
    def n_effective(self) -> float:
        """Number of parameters, nodes and polynomial, that the stars determine."""
        nodes = float((self.sums.informed(self.root) * self.root).sum())
        return len(self.sums.polynomial) + nodes

    def gain(self, rows: Float) -> Float:
        """Part of an error beneath this table that it absorbs: rows (N, n) times S A, (N, n)."""
        return self.sums.informed(self.root @ (self.root.T @ rows.T)).T


@dataclass(frozen=True, eq=False)
class TablePosterior:
    """Posterior of one look-up table.

    The two axes are independent.

    Parameters
    ----------
    table : LookupTable
        Posterior means, with the standard error of each node.
    grid : NodeGrid
    axes : tuple of AxisField
        Of the x and of the y plane.
    jitter : float
        Error of the stars beyond the quoted ones, pixels.
    jitter_sigma : float
        Its standard error, pixels.
    n_stars : float
        Number of stars, each counted by its weight.
    """

    table: LookupTable
    grid: NodeGrid
    axes: tuple[AxisField, AxisField]
    jitter: float
    jitter_sigma: float
    n_stars: float

    @property
    def priors(self) -> tuple[Matern, Matern]:
        """Prior fields of the two planes."""
        return self.axes[0].field.prior, self.axes[1].field.prior

    @property
    def cov(self) -> Float:
        """Covariance (2, n_nodes, n_nodes) of the node values, square pixels."""
        return np.stack([axis.cov for axis in self.axes])

    def position_sigma(self, x: ArrayLike, y: ArrayLike, *, refitted: bool = False) -> Float:
        """Standard error of the interpolated shift.

        Parameters
        ----------
        x, y : array_like, shape (N,)
            Raw pixels.
        refitted : bool
            True for the part that is left after the polynomial has followed the table's errors.
            Its square, and the square of the formal error of a polynomial that was fitted with the
            table fixed, add up to the total variance: exactly, not only where the two are nearly
            independent.

        Returns
        -------
        ndarray, shape (N, 2)
            Pixels.
        """
        x, y = (np.atleast_1d(np.asarray(p, float)) for p in (x, y))
        out = np.empty((len(x), 2))
        for start in range(0, len(x), BLOCK):
            rows = slice(start, start + BLOCK)
            weights = self.grid.interpolation(x[rows], y[rows])
            phi = self.grid.basis.evaluate(x[rows], y[rows])
            for a, axis in enumerate(self.axes):
                response = weights @ axis.root
                if refitted:
                    response -= phi @ (axis.sums.absorbed @ axis.root)
                out[rows, a] = np.linalg.norm(response, axis=1)
        return out

    def rows(self, x: Float, y: Float, axis: int, *, refitted: bool = False) -> Float:
        """Derivatives (N, n_nodes) of the shift along an axis by the node values.

        Parameters
        ----------
        x, y : ndarray, shape (N,)
        axis : int
        refitted : bool
            As in `position_sigma`.
        """
        out: Float = self.grid.interpolation(x, y).toarray()
        if refitted:
            out -= self.grid.basis.evaluate(x, y) @ self.axes[axis].sums.absorbed
        return out


def axis_posterior(grid: NodeGrid, sums: NodeSums, field: FittedField) -> AxisField:
    """Posterior of the node values of one axis at given hyperparameters.

    With d = L z, z ~ N(0, 1) and L the polynomial-free part of the Cholesky factor of the prior,
    the precision of z is 1 + L^T A L: never singular, whatever bins are empty.
    """
    L = grid.without_polynomials(cholesky(field.prior.covariance(grid)))
    informed = sums.informed(L)
    M = np.zeros_like(L)
    for start in range(0, len(L), COLUMNS):
        M[start : start + COLUMNS, start:] = L[:, start : start + COLUMNS].T @ informed[:, start:]
    M[np.diag_indices_from(M)] += 1.0
    # R^T = K^-1 L^T with K K^T = M
    root = scipy.linalg.blas.dtrsm(1.0, cholesky(M), L.T, lower=1, overwrite_b=1).T
    # the prior's factor has rounding errors of 1e-16 of its size in the polynomial space
    root = grid.without_polynomials(root)
    return AxisField(root @ (root.T @ sums.marginal_right), root, field, sums)
