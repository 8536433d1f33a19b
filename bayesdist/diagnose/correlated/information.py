"""Information of the cells about the model's parameters, and about any further functions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bayesdist.diagnose.correlated.cells import CellSums
from bayesdist.infer.equations.normal import NormalEquations
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.equations.scaled import scaled_inverse
from bayesdist.model import DistortionModel

__all__ = ["GroupCells", "Information"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

# A star that alone determines a parameter has no residual: its squared score is uninformative.
MIN_FREE = 0.1


@dataclass(frozen=True, eq=False)
class GroupCells:
    """One group of stars, cell by cell."""

    chip: int  # code
    exposure: int  # code
    epoch: float
    X: Float  # scaled positions (C,)
    Y: Float
    phi: Float  # the model's basis (C, K) there
    count: Float  # number of stars (C,)
    score: Float  # gradient (C, 2) of the log-likelihood by the model's u and v
    curvature: Float  # minus its second derivatives (C, 2, 2)
    squares: Float  # sums (C, 2, 2) of products of the stars' own gradients
    columns: Int  # indices (m,) of the parameters that move these positions
    derivative: Float  # of the effective coefficients by them (2, K, m)
    frame: Float  # matrix (2, 2) from the axes of the polynomials to those of u and v

    def onto_parameters(self, values: Float) -> Float:
        """Sums (m, q) of J^T values, given values (C, 2, q) along u and v."""
        block = np.einsum("ck,caq->akq", self.phi, values, optimize=True)
        return np.asarray(np.einsum("akm,akq->mq", self.derivative, block, optimize=True))


@dataclass(frozen=True, eq=False)
class Information:
    """Likelihood of all cells about a solution, to second order."""

    model: DistortionModel
    theta: Float
    sums: CellSums
    priors: GaussianPriors
    # variance (chips, C, 2) of the gradients relative to their curvature, by chip, cell of the
    # square grid and axis; 1 by default, as where the likelihood is right
    excess: Float | None = None

    def groups(self) -> Iterator[GroupCells]:
        """All groups, one after another."""
        groups = self.sums.groups
        jacobians = self.model.effective_jacobian(self.theta, groups)
        centres = [self.sums.centres(k) for k in range(len(self.model.chips))]
        bases = [
            self.model.basis(chip.number).evaluate_scaled(X, Y)
            for chip, (_, X, Y) in zip(self.model.chips, centres, strict=True)
        ]
        for g, (columns, derivative) in enumerate(jacobians):
            chip, exposure = int(groups.chip[g]), int(groups.exposure[g])
            cells, X, Y = centres[chip]
            sums = self.sums.sums[g, cells]
            here = np.flatnonzero(sums[:, 0])
            sums = sums[here]
            curvature = sums[:, [3, 4, 4, 5]].reshape(-1, 2, 2)
            score, squares = sums[:, 1:3], sums[:, [6, 7, 7, 8]].reshape(-1, 2, 2)
            if self.excess is not None:
                root = np.sqrt(self.excess[chip, cells[here]])
                score = score / root**2
                curvature = curvature / (root[:, :, None] * root[:, None, :])
            yield GroupCells(
                chip,
                exposure,
                float(groups.epoch[g]),
                X[here],
                Y[here],
                bases[chip][here],
                sums[:, 0],
                score,
                curvature,
                squares,
                columns,
                derivative,
                np.asarray(self.model.frame(self.theta, exposure)[0]),
            )

    def _assembled(self, weights: list[Float]) -> Float:
        """Sum (D, D) of J^T W J, given the weights (C, 2, 2) of each group."""
        K = self.model.n_terms
        moments = np.empty((len(weights), 3, K, K))
        for g, (cells, w) in enumerate(zip(self.groups(), weights, strict=True)):
            for k, (a, b) in enumerate(((0, 0), (0, 1), (1, 1))):
                moments[g, k] = cells.phi.T @ (w[:, a, b, None] * cells.phi)
        nothing = np.zeros((len(weights), 2, K))
        equations = NormalEquations(
            moments, nothing, nothing, 0.0, nothing[:, None][:, :0], np.zeros(0), self.sums.groups
        )
        matrix, _ = equations.assemble(self.model, self.theta)
        return matrix.dense()

    @cached_property
    def precision(self) -> Float:
        """Information (D, D) of all parameters with their priors."""
        matrix = self._assembled([cells.curvature for cells in self.groups()])
        return matrix + self.priors.information(len(self.theta))

    @cached_property
    def covariance(self) -> Float:
        """Inverse (D, D) of `precision`; formal where the likelihood is right."""
        return scaled_inverse(self.precision)

    @cached_property
    def score(self) -> Float:
        """Gradient (D,) by all parameters, of likelihood and priors.

        It is zero at a mode without `excess`.  Priors pull at the deviations of exposures as hard
        as the stars do.
        """
        out = self.priors.pull(self.theta)
        for cells in self.groups():
            out[cells.columns] += cells.onto_parameters(cells.score[..., None])[:, 0]
        return out

    def with_excess(self, excess: Float) -> Information:
        """Information of these cells, its likelihood flattened by the excess (chips, C, 2)."""
        return replace(self, excess=excess)

    def leverage(self, cells: GroupCells) -> Float:
        """Fraction (C, 2) of its own residual that a star of each cell absorbs, on each axis."""
        cov = self.covariance[np.ix_(cells.columns, cells.columns)]
        d = cells.derivative
        within = np.einsum("akm,mn,aln->akl", d, cov, d, optimize=True)
        variance = np.einsum("ck,akl,cl->ca", cells.phi, within, cells.phi, optimize=True)
        per_star = np.einsum("caa->ca", cells.curvature) / cells.count[:, None]
        return np.asarray(np.clip(per_star * variance, 0.0, 1 - MIN_FREE))

    def sandwich(self) -> Float:
        """Covariance (D, D) of the parameters, valid for any variances of single stars.

        Each squared score is divided by the square of one minus its leverage (HC3 of MacKinnon and
        White 1985, Journal of Econometrics 29, 305): a jackknife, to first order.
        """
        weights = []
        for cells in self.groups():
            free = 1 - self.leverage(cells)
            weights.append(cells.squares / (free[:, :, None] * free[:, None, :]))
        meat = self._assembled(weights) + self.priors.information(len(self.theta))
        return np.asarray(self.covariance @ meat @ self.covariance)
