"""Regressors of matched stars with the parameters projected out, and their values at detections.

The regressors of a test are functions of the detections.  No array has both the length of the
detections and the width of parameters or regressors, because each block's polynomials have only a
few coefficients.
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

RIDGE = 1e-12  # added to a scaled information matrix, so that undetermined directions stay finite
LARGEST_LEVERAGE = 0.95  # of one detection; with a larger leverage hardly any residual remains


@dataclass(frozen=True, eq=False)
class Projection:
    """Sums over a sample from which the regressor tests are computed.

    There are D parameters, the first G of them global, and q regressors: each function that the
    tests add, on both axes of every chip.
    """

    functions: Functions
    theta: Float  # (D,) parameters at which the scores were evaluated
    precision: Float  # (D, D) of the priors
    parameters: Float  # (D, D) information of the parameters, including the priors
    covariance: Float  # (D, D) its inverse
    score: Float  # (D,) including the gradient of the priors
    cross: Float  # (D, q) information between parameters and regressors
    regressors: EfficientScore

    @property
    def sample(self) -> ScoredSample:
        """Sample of detections."""
        return self.functions.sample

    @property
    def n_global(self) -> int:
        """Number of global parameters."""
        return self.sample.model.n_global

    def columns(self, function: Int, chip: int) -> Int:
        """Indices of the regressors of the given functions on both axes of a chip."""
        start = 2 * self.functions.n_added * chip
        return np.ravel(start + 2 * (function[:, None] - self.sample.model.n_terms) + [0, 1])

    @cached_property
    def following(self) -> Float:
        """Derivatives (D, G) of all parameters with respect to the global ones.

        The parameters of the exposures take the values that fit best for given global parameters.
        """
        G = self.n_global
        local = -np.linalg.solve(self.parameters[G:, G:], self.parameters[G:, :G])
        return np.concatenate([np.eye(G), local])

    def with_global(self, information: Float, cross: Float) -> Float:
        """Information (n, n) of columns with only the exposures' parameters projected out.

        `information` is that with all parameters projected out, and `cross` (n, G) that between the
        columns and the global parameters, with the exposures' parameters following.
        """
        G = self.n_global
        return np.asarray(information + cross @ self.covariance[:G, :G] @ cross.T)

    def beside_exposures(self, which: Int) -> Float:
        """Information (n, n) of regressors with only the exposures' parameters projected out."""
        projected = self.regressors.information[np.ix_(which, which)]
        return self.with_global(projected, self.cross[:, which].T @ self.following)

    def star_scores(self, F: Float, block: Block, coefficients: Float) -> Float:
        """Scores (n, q) of detections, from coefficients (2, L, q) of functions F (L, n)."""
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
        """Sample including the leverage of its detections."""
        return replace(self.sample, leverage=self.leverage)

    def regressor_map(self, block: Block, which: Int) -> Float:
        """Coefficients (2, L, n) of projected regressors in a block.

        `which` (n,) are regressor indices from 0 to q - 1.
        """
        K = self.sample.model.n_terms
        out = _added(block, self.functions.n_added, K, which)
        out[:, :K] -= block.moved(self.regressors.gain[:, which])
        return out

    def prior_meat(self, which: Int) -> Float:
        """Covariance (n, n) of the scores of regressors due to the priors, treated as data."""
        gain = self.regressors.gain[:, which]
        return np.asarray(gain.T @ self.precision @ gain)

    @cached_property
    def score_ratio(self) -> float:
        """Mean square of the scores divided by its expectation from the curvature."""
        h = self.sample.curvature[[0, 2]]
        return float((self.scored.whole_score**2).sum() / h.sum())


def projection_of(functions: Functions, theta: Float, priors: GaussianPriors) -> Projection:
    """Sums over the detections of a sample, at the parameters `theta` (D,) of its scores.

    If the information matrix is not positive definite, only concave parts of the likelihood are
    used.
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
    """Coefficients (2, L, n) of regressors in a block, along the axes of the polynomials."""
    out = np.zeros((2, n_terms + n_added, len(which)))
    chip, index_in_chip = np.divmod(which, 2 * n_added)
    on_chip = np.flatnonzero(chip == block.chip)
    function, axis = np.divmod(index_in_chip[on_chip], 2)
    out[:, n_terms + function, on_chip] = block.frame[:, axis]
    return out


def contracted(A: Float, B: Float) -> Float:
    """Sum products over axes and functions: arrays (2, L, m) and (2, L, n) give (m, n)."""
    return A.reshape(-1, A.shape[2]).T @ B.reshape(-1, B.shape[2])


def weighted(F: Float, curvature: Float, X: Float) -> Float:
    """Moments of functions F (L, n), weighted with the curvature (3, n), applied to X (2, L, m)."""
    uu, uv, vv = curvature
    Wuu = (F * uu) @ F.T
    Wvv = Wuu if uu is vv or np.array_equal(uu, vv) else (F * vv) @ F.T
    if not uv.any():
        return np.stack([Wuu @ X[0], Wvv @ X[1]])
    Wuv = (F * uv) @ F.T
    return np.stack([Wuu @ X[0] + Wuv @ X[1], Wuv @ X[0] + Wvv @ X[1]])


def _ridged(matrix: Float) -> Float:
    """Information matrix with a small value on the diagonal, so that it can be inverted."""
    diagonal = np.diag(matrix)
    largest = diagonal.max(initial=0.0)
    return matrix + np.diag(RIDGE * np.where(diagonal > 0, diagonal, largest))
