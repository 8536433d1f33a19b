"""Posterior of a look-up table: node values, covariance, and errors of interpolated shifts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.linalg import LinearOperator, cg

from bayesdist.infer.kernel.blocks import at_once
from bayesdist.infer.kernel.lapack import cholesky, divided
from bayesdist.infer.nodes.grid import NodeGrid, NodeSums
from bayesdist.infer.nodes.hyperparameters import Evidence, FittedField, Matern
from bayesdist.model.lookup import LookupTable
from bayesdist.utils.arrays import Float

BLOCK = 2048  # pixels processed at a time, with dense rows over all nodes
COLUMNS = 512  # block size for computing only one triangle of a symmetric product
SOLVED = 1e-10  # relative tolerance of node values that are updated for new weights of the stars


@dataclass(frozen=True, eq=False)
class NodeCovariance:
    """Posterior covariance of the node values of one axis, with the polynomial integrated out."""

    grid: NodeGrid
    sums: NodeSums  # normal equations of the stars
    prior: Matern

    @cached_property
    def root(self) -> Float:
        """Matrix R (n, n) such that R R^T is the covariance.

        With d = L z, z ~ N(0, 1), and L the polynomial-free part of the Cholesky factor of the
        prior, the precision of z is 1 + L^T A L.  It is never singular, even with empty bins.
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
        # the factor of the prior has relative rounding errors of 1e-16 in the polynomial space
        return self.grid.without_polynomials(root)

    def mean(self, sums: NodeSums) -> Float | None:
        """Node values (n,) for slightly different sums; None if they differ too much.

        With d = R z, the precision of z is 1 + R^T dA R, where dA is the change of the information.
        It is close to the identity, so that conjugate gradients need only a few products with R.
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
    """Gaussian posterior of the node values of one axis, with the polynomial integrated out.

    Parameters
    ----------
    covariance : NodeCovariance
    field : FittedField
        Hyperparameters and their log density.
    mean : ndarray, shape (n,)
        Node values in pixels.
    n_effective : float
        Effective number of fitted parameters (nodes and polynomial).
    """

    covariance: NodeCovariance
    field: FittedField
    mean: Float
    n_effective: float

    @classmethod
    def of(cls, evidence: Evidence, field: FittedField) -> AxisField:
        """Posterior with the hyperparameters of `field`, which was fitted to the same stars."""
        sums = evidence.sums
        n = len(sums.polynomial) + field.n_effective
        return cls(NodeCovariance(evidence.grid, sums, field.prior), field, field.mean, n)

    def at_same_prior(self, sums: NodeSums) -> AxisField:
        """Posterior from other sums with the same hyperparameters."""
        evidence = Evidence(self.covariance.grid, sums)
        return AxisField.of(evidence, evidence.at(self.field.prior))

    def following(self, sums: NodeSums) -> AxisField:
        """Posterior from slightly different sums with the same hyperparameters.

        Only the mean is updated; the covariance is kept, since the weights of the stars change by
        about a part in a thousand.
        """
        mean = self.covariance.mean(sums)
        return self.at_same_prior(sums) if mean is None else replace(self, mean=mean)

    @property
    def sums(self) -> NodeSums:
        """Normal equations from which the covariance was computed."""
        return self.covariance.sums

    @property
    def root(self) -> Float:
        """Matrix R (n, n) such that R R^T is the covariance."""
        return self.covariance.root

    @property
    def sigma(self) -> Float:
        """Standard error (n,) of each node in pixels."""
        return np.sqrt(np.einsum("ij,ij->i", self.root, self.root))

    @property
    def cov(self) -> Float:
        """Covariance (n, n) of the node values in square pixels."""
        return self.root @ self.root.T

    def gain(self, rows: Float) -> Float:
        """Part of the errors of an underlying table that this table absorbs.

        `rows` (N, n) are derivatives with respect to the node values.  Returns rows S A (N, n),
        with the covariance S of this table and the information A of the stars.
        """
        return self.sums.informed(self.root @ (self.root.T @ rows.T)).T


@dataclass(frozen=True, eq=False)
class TablePosterior:
    """Posterior of one look-up table; its two axes are independent.

    Parameters
    ----------
    grid : NodeGrid
    axes : tuple of AxisField
        Posteriors of the x and y planes.
    filter : str
        Filter of the table; '' for the detector's table.
    jitter : float
        Additional error of the stars in excess of the quoted errors, in pixels.
    jitter_sigma : float
        Standard error of the jitter in pixels.
    n_stars : float
        Sum of the weights of the stars.
    """

    grid: NodeGrid
    axes: tuple[AxisField, AxisField]
    filter: str
    jitter: float
    jitter_sigma: float
    n_stars: float

    @property
    def means(self) -> LookupTable:
        """Table of the posterior means, without errors, which take time (see `table`)."""
        return self.grid.table(np.stack([axis.mean for axis in self.axes]), filter=self.filter)

    @cached_property
    def table(self) -> LookupTable:
        """Table of the posterior means, with the standard error of each node."""
        sigma = np.stack(at_once(lambda axis: axis.sigma, self.axes))
        return replace(self.means, sigma=sigma.reshape(2, *self.grid.shape))

    @property
    def priors(self) -> tuple[Matern, Matern]:
        """Hyperparameters of the x and y planes."""
        return self.axes[0].field.prior, self.axes[1].field.prior

    @property
    def cov(self) -> Float:
        """Covariance (2, n_nodes, n_nodes) of the node values in square pixels."""
        return np.stack([axis.cov for axis in self.axes])

    def position_sigma(self, x: ArrayLike, y: ArrayLike, *, refitted: bool = False) -> Float:
        """Standard error of the interpolated shift.

        Parameters
        ----------
        x, y : array_like, shape (N,)
            Raw pixel coordinates.
        refitted : bool
            True for the error that remains after the polynomial is refitted to compensate errors
            of the table. Added in quadrature to the formal error of a polynomial that was fitted
            with the table fixed, it gives exactly the total error.

        Returns
        -------
        ndarray, shape (N, 2)
            Standard errors along x and y in pixels.
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
        """Derivatives of the interpolated shift along an axis with respect to the node values.

        Parameters
        ----------
        x, y : ndarray, shape (N,)
            Raw pixel coordinates.
        axis : int
            0 for x, 1 for y.
        refitted : bool
            See `position_sigma`.

        Returns
        -------
        ndarray, shape (N, n_nodes)
        """
        out: Float = self.grid.interpolation(x, y).toarray()
        if refitted:
            out -= self.grid.basis.evaluate(x, y) @ self.axes[axis].sums.absorbed
        return out
