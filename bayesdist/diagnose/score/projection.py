"""Regressors of matched stars with the parameters projected out, and what they do to detections.

The regressors of a test are functions of the detections.  Nothing is built that is as long as the
detections and as wide as parameters or regressors: polynomials have few coefficients in a block.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve

from bayesdist.diagnose.efficient import EfficientScore
from bayesdist.diagnose.score.regressors import Functions
from bayesdist.diagnose.score.sample import Block, ScoredSample
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.utils.arrays import Float, Int

RIDGE = 1e-12  # of a scaled information matrix: what the sample does not determine stays finite
LARGEST_LEVERAGE = 0.95  # of one detection; it has next to no residual of its own there


@dataclass(frozen=True, eq=False)
class Projection:
    """Sums over a sample, from which the tests are made.

    D parameters, the first G of them global, q regressors: each of the functions that the tests
    add, on both axes of every chip.
    """

    functions: Functions
    theta: Float  # (D,) where the scores were taken
    precision: Float  # (D, D) of the priors
    parameters: Float  # information (D, D) of the parameters, with the priors
    covariance: Float  # (D, D) inverse of it
    score: Float  # (D,) with the pull of the priors
    cross: Float  # (D, q) of parameters and regressors
    regressors: EfficientScore

    @property
    def sample(self) -> ScoredSample:
        """Detections."""
        return self.functions.sample

    @property
    def n_global(self) -> int:
        """Number of global parameters."""
        return self.sample.model.n_global

    def columns(self, function: Int, chip: int) -> Int:
        """Indices of the regressors of some functions on both axes of a chip."""
        start = 2 * self.functions.n_added * chip
        return np.ravel(start + 2 * (function[:, None] - self.sample.model.n_terms) + [0, 1])

    @cached_property
    def following(self) -> Float:
        """Change (D, G) of all parameters with a global one, those of exposures following it."""
        G = self.n_global
        local = -np.linalg.solve(self.parameters[G:, G:], self.parameters[G:, :G])
        return np.concatenate([np.eye(G), local])

    def with_global(self, information: Float, cross: Float) -> Float:
        """Information (n, n) of columns when the exposures' parameters alone are projected out.

        From that with all of them projected out, and `cross` (n, G) with the global parameters that
        the others follow.
        """
        G = self.n_global
        return np.asarray(information + cross @ self.covariance[:G, :G] @ cross.T)

    def beside_exposures(self, which: Int) -> Float:
        """Information (n, n) of regressors, the exposures' parameters alone projected out."""
        left = self.regressors.information[np.ix_(which, which)]
        return self.with_global(left, self.cross[:, which].T @ self.following)

    def star_scores(self, F: Float, block: Block, coefficients: Float) -> Float:
        """Scores (n, q) of detections, by coefficients (2, L, q) of functions F (L, n)."""
        g = self.scored.whole_score[:, block.rows]
        return np.asarray(sum((F * g[axis]).T @ coefficients[axis] for axis in (0, 1)))

    @cached_property
    def leverage(self) -> Float:
        """Fraction (2, N) of the noise of each detection that the fit follows, along u and v."""
        sample = self.sample
        out = np.zeros((2, len(sample)))
        for block in sample.blocks:
            phi = self.functions.polynomials(block.rows)
            joint = self.covariance[np.ix_(block.columns, block.columns)]
            for axis in (0, 1):
                covariance = block.derivative[axis] @ joint @ block.derivative[axis].T
                follows = np.einsum("kn,kn->n", phi, covariance @ phi)
                out[axis, block.rows] = follows * sample.curvature[2 * axis, block.rows]
        return np.clip(out, 0.0, LARGEST_LEVERAGE)

    @cached_property
    def scored(self) -> ScoredSample:
        """Sample with its leverage."""
        return replace(self.sample, leverage=self.leverage)

    def regressor_map(self, block: Block, which: Int) -> Float:
        """Coefficients (2, L, n) of projected regressors in a block.

        `which` (n,) are from 0 to q - 1.
        """
        K = self.sample.model.n_terms
        out = _added(block, self.functions.n_added, K, which)
        out[:, :K] -= block.moved(self.regressors.gain[:, which])
        return out

    def prior_meat(self, which: Int) -> Float:
        """Covariance (n, n) that priors give to the scores of regressors, as data of their own."""
        gain = self.regressors.gain[:, which]
        return np.asarray(gain.T @ self.precision @ gain)

    @cached_property
    def score_ratio(self) -> float:
        """Mean square of the scores over what the curvature expects."""
        h = self.sample.curvature[[0, 2]]
        return float((self.scored.whole_score**2).sum() / h.sum())


def projection_of(functions: Functions, theta: Float, priors: GaussianPriors) -> Projection:
    """Sums over the detections of a sample.

    `theta` (D,) is where the scores were taken.
    """
    try:
        return _summed(functions, theta, priors)
    except np.linalg.LinAlgError:
        concave = functions.sample.with_positive_curvature()
        return _summed(replace(functions, sample=concave), theta, priors)


def _summed(functions: Functions, theta: Float, priors: GaussianPriors) -> Projection:
    sample, model = functions.sample, functions.sample.model
    D, K, n = model.n_params, model.n_terms, 2 * functions.n_added
    N, score = np.zeros((D + n * len(model.chips),) * 2), np.zeros(D + n * len(model.chips))
    for block in sample.blocks:
        F, added = functions.at(block.rows), n * block.chip + np.arange(n)
        columns, m = np.r_[block.columns, D + added], len(block.columns)
        X = np.zeros((2, len(F), len(columns)))
        X[:, :K, :m] = block.derivative
        X[..., m:] = _added(block, functions.n_added, K, added)
        WX = weighted(F, sample.curvature[:, block.rows], X)
        N[np.ix_(columns, columns)] += contracted(X, WX)
        score[columns] += contracted(X, (sample.score[:, block.rows] @ F.T)[..., None])[:, 0]
    prior = priors.about(theta)
    parameters = _ridged(N[:D, :D] + prior.precision)
    covariance = cho_solve((np.linalg.cholesky(parameters), True), np.eye(D))
    nuisance, cross = score[:D] + prior.pull(theta), N[:D, D:]
    return Projection(
        functions,
        theta,
        prior.precision,
        parameters,
        covariance,
        nuisance,
        cross,
        EfficientScore.of(covariance, nuisance, cross, N[D:, D:], score[D:]),
    )


def _added(block: Block, n_added: int, n_terms: int, which: Int) -> Float:
    """Coefficients (2, L, n) of some regressors in a block, along the axes of the polynomials."""
    out = np.zeros((2, n_terms + n_added, len(which)))
    chip, rest = np.divmod(which, 2 * n_added)
    here = np.flatnonzero(chip == block.chip)
    function, axis = np.divmod(rest[here], 2)
    out[:, n_terms + function, here] = block.frame[:, axis]
    return out


def contracted(A: Float, B: Float) -> Float:
    """Sums over axes and functions: (2, L, m) and (2, L, n) to (m, n)."""
    return A.reshape(-1, A.shape[2]).T @ B.reshape(-1, B.shape[2])


def weighted(F: Float, curvature: Float, X: Float) -> Float:
    """Moments of functions F (L, n) with the curvature (3, n), times X (2, L, m)."""
    uu, uv, vv = curvature
    Wuu = (F * uu) @ F.T
    Wvv = Wuu if uu is vv or np.array_equal(uu, vv) else (F * vv) @ F.T
    if not uv.any():
        return np.stack([Wuu @ X[0], Wvv @ X[1]])
    Wuv = (F * uv) @ F.T
    return np.stack([Wuu @ X[0] + Wuv @ X[1], Wuv @ X[0] + Wvv @ X[1]])


def _ridged(matrix: Float) -> Float:
    """An information matrix in which directions without information have a trace of it."""
    diagonal = np.diag(matrix)
    largest = diagonal.max(initial=0.0)
    return matrix + np.diag(RIDGE * np.where(diagonal > 0, diagonal, largest))
