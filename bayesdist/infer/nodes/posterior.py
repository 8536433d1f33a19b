"""Posterior of a look-up table: node values, their covariance, errors in between."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.linalg import LinearOperator, cg

from bayesdist.infer.kernel.blocks import at_once
from bayesdist.infer.kernel.lapack import cholesky, divided
from bayesdist.infer.nodes.grid import NodeGrid
from bayesdist.infer.nodes.hyperparameters import Evidence, FittedField, Matern
from bayesdist.infer.nodes.sums import NodeSums
from bayesdist.model.lookup import LookupTable
from bayesdist.utils.arrays import Float

BLOCK = 2048  # pixels whose rows over all nodes are in memory at once
COLUMNS = 512  # of a symmetric product, of which no more than one triangle is made
SOLVED = 1e-10  # relative error of nodes that follow a change of the stars' weights


@dataclass(frozen=True, eq=False)
class NodeCovariance:
    """Posterior covariance of the node values of one axis, the polynomial being integrated out."""

    grid: NodeGrid
    sums: NodeSums  # normal equations of the stars
    prior: Matern

    @cached_property
    def root(self) -> Float:
        """R (n, n) with R R^T the covariance.

        With d = L z, z ~ N(0, 1) and L the polynomial-free part of the Cholesky factor of the
        prior, the precision of z is 1 + L^T A L: never singular, whatever bins are empty.
        """
        L = self.grid.without_polynomials(cholesky(self.prior.covariance(self.grid)))
        informed = self.sums.informed(L)
        M = np.zeros(L.shape)
        for start in range(0, len(L), COLUMNS):
            M[start : start + COLUMNS, start:] = (
                L[:, start : start + COLUMNS].T @ informed[:, start:]
            )
        M[np.diag_indices_from(M)] += 1.0
        # R^T = K^-1 L^T with K K^T = M
        root = divided(cholesky(M), np.asfortranarray(L.T)).T
        # the prior's factor has rounding errors of 1e-16 of its size in the polynomial space
        return self.grid.without_polynomials(root)

    def mean(self, sums: NodeSums) -> Float | None:
        """Node values (n,) from sums of nearly the same stars; None where they differ too much.

        With d = R z the precision of z is 1 + R^T dA R, dA being the change of the information:
        near 1, so that a few products with R are enough.
        """
        R = self.root

        def precision(z: Float) -> Float:
            d = R @ z
            return z + R.T @ (sums.informed(d) - self.sums.informed(d))

        right = R.T @ sums.marginal_right
        z, unsolved = cg(LinearOperator(R.shape, precision, dtype=float), right, right, rtol=SOLVED)
        return None if unsolved else R @ z


@dataclass(frozen=True, eq=False)
class AxisField:
    """Posterior of the node values of one axis: Gaussian, the polynomial being integrated out."""

    covariance: NodeCovariance
    field: FittedField  # hyperparameters
    mean: Float  # (n,) pixels
    n_effective: float  # number of parameters, nodes and polynomial, that the stars determine

    @classmethod
    def of(cls, evidence: Evidence, field: FittedField) -> AxisField:
        """Posterior at the hyperparameters of a field of the same stars."""
        sums = evidence.sums
        n = len(sums.polynomial) + field.n_effective
        return cls(NodeCovariance(evidence.grid, sums, field.prior), field, field.mean, n)

    def at_same_prior(self, sums: NodeSums) -> AxisField:
        """Posterior from other sums, at these hyperparameters."""
        evidence = Evidence(self.covariance.grid, sums)
        return AxisField.of(evidence, evidence.at(self.field.prior))

    def following(self, sums: NodeSums) -> AxisField:
        """Posterior from sums of nearly the same stars, at these hyperparameters.

        Its covariance stays: the weights of the stars change by a part in a thousand.
        """
        mean = self.covariance.mean(sums)
        return self.at_same_prior(sums) if mean is None else replace(self, mean=mean)

    @property
    def sums(self) -> NodeSums:
        """Normal equations of the stars that the covariance is from."""
        return self.covariance.sums

    @property
    def root(self) -> Float:
        """R (n, n) with R R^T the covariance."""
        return self.covariance.root

    @property
    def sigma(self) -> Float:
        """Standard error (n,) of each node, pixels."""
        return np.sqrt(np.einsum("ij,ij->i", self.root, self.root))

    @property
    def cov(self) -> Float:
        """Covariance (n, n), square pixels."""
        return self.root @ self.root.T

    def gain(self, rows: Float) -> Float:
        """Part of an error beneath this table that it absorbs: rows (N, n) times S A, (N, n)."""
        return self.sums.informed(self.root @ (self.root.T @ rows.T)).T


@dataclass(frozen=True, eq=False)
class TablePosterior:
    """Posterior of one look-up table.

    The two axes are independent.

    Parameters
    ----------
    grid : NodeGrid
    axes : tuple of AxisField
        Of the x and of the y plane.
    filter : str
        The table's filter; '' for the detector's own.
    jitter : float
        Error of the stars beyond the quoted ones, pixels.
    jitter_sigma : float
        Its standard error, pixels.
    n_stars : float
        Number of stars, each counted by its weight.
    """

    grid: NodeGrid
    axes: tuple[AxisField, AxisField]
    filter: str
    jitter: float
    jitter_sigma: float
    n_stars: float

    @property
    def means(self) -> LookupTable:
        """Table of the posterior means, without their errors, which take time."""
        return self.grid.table(np.stack([axis.mean for axis in self.axes]), filter=self.filter)

    @cached_property
    def table(self) -> LookupTable:
        """Table of the posterior means, with the standard error of each node."""
        sigma = np.stack(at_once(lambda axis: axis.sigma, self.axes))
        return replace(self.means, sigma=sigma.reshape(2, *self.grid.shape))

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
