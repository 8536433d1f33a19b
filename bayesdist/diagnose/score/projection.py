"""Regressors with the parameters of the model projected out: scores, information and covariances.

The regressors Z of a test are functions of the detections; the parameters of the model are
nuisance.  With J the derivatives of positions by the parameters, H the curvature of each detection
and P the precision of the priors, what is left of Z is Z - J C^-1 (Z^T H J)^T, C = J^T H J + P.
Parameters of single exposures are eliminated exposure by exposure, so that nothing large is ever
built.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve

from bayesdist.diagnose.score.regressors import Functions
from bayesdist.diagnose.score.sample import Block, ScoredSample
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.utils.arrays import Bool, Float, Int

RIDGE = 1e-12  # of a scaled information matrix: what the sample does not determine stays finite
LARGEST_LEVERAGE = 0.95  # of one detection; it has next to no residual of its own there


@dataclass(frozen=True, eq=False)
class Eliminated:
    """Parameters of one exposure, as far as the sample knows them."""

    index: Int  # (l,) which entries of theta
    inverse: Float  # (l, l) inverse of their information, with the priors
    gain: Float  # (l, G + q) how they follow a global parameter, or a regressor
    score: Float  # (l,) with the pull of the priors
    precision: Float  # (l,) of the priors


@dataclass(frozen=True, eq=False)
class Projection:
    """Sums over a sample, from which the tests are made.

    G global parameters, q regressors: each of the functions that the tests add, on both axes of
    every chip.
    """

    functions: Functions
    exposures: dict[int, Eliminated]  # by the code of the frame's exposure
    # (G + q, G + q) of global parameters and regressors, with the priors, the exposures' parameters
    # eliminated
    information: Float
    score: Float  # (G + q,)
    precision: Float  # (G, G) of the priors of the global parameters
    theta: Float  # (D,) where the scores were taken

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
    def root(self) -> tuple[Float, bool]:
        """Cholesky factor of the information of the global parameters."""
        G = self.n_global
        return np.asarray(np.linalg.cholesky(_ridged(self.information[:G, :G]))), True

    @cached_property
    def nuisance(self) -> Float:
        """Parameters (G, q) that regressors are taken for."""
        G = self.n_global
        return np.asarray(cho_solve(self.root, self.information[:G, G:]))

    @cached_property
    def efficient_score(self) -> Float:
        """Score of the regressors (q,), the parameters projected out."""
        G = self.n_global
        return np.asarray(self.score[G:] - self.nuisance.T @ self.score[:G])

    def efficient_information(self, which: Int) -> Float:
        """Information (n, n) of some regressors, the parameters projected out."""
        G = self.n_global
        out = self.information[np.ix_(G + which, G + which)]
        out = out - self.information[G + which, :G] @ self.nuisance[:, which]
        return np.asarray((out + out.T) / 2)

    def moved(self, block: Block, by: Float, own: Float | None) -> Float:
        """Change (2, K, n) of a block's polynomial by global parameters, and by its exposure's own.

        These change by `by` (G, n) and `own` (l, n), None for an exposure without parameters.
        """
        by_global, by_local = block.parts(self.n_global)
        n_own = by_global.shape[2]
        out = by_global @ by[block.columns[:n_own]]
        if own is not None:
            index = self.exposures[block.frame_exposure].index
            out += by_local @ own[np.searchsorted(index, block.columns[n_own:])]
        return np.asarray(out)

    def through(self, block: Block, by: Float) -> Float:
        """Change (2, K, n) of a block's polynomial that global parameters (G, n) bring about.

        The parameters of the exposure follow them.
        """
        one = self.exposures.get(block.frame_exposure)
        return self.moved(block, by, None if one is None else -one.gain[:, : self.n_global] @ by)

    def star_scores(self, F: Float, block: Block, coefficients: Float) -> Float:
        """Scores (n, q) of detections, by coefficients (2, L, q) of functions F (L, n)."""
        g = self.scored.whole_score[:, block.rows]
        return np.asarray(sum((F * g[axis]).T @ coefficients[axis] for axis in (0, 1)))

    @cached_property
    def leverage(self) -> Float:
        """Fraction (2, N) of the noise of each detection that the fit follows, along u and v."""
        sample, G = self.sample, self.n_global
        inverse = cho_solve(self.root, np.eye(G))
        followed = {
            e: (
                back := -cho_solve(self.root, one.gain[:, :G].T),
                one.inverse - one.gain[:, :G] @ back,
            )
            for e, one in self.exposures.items()
        }
        out = np.zeros((2, len(sample)))
        for block in sample.blocks:
            by_global, by_local = block.parts(G)
            columns = block.columns[: by_global.shape[2]]
            phi = self.functions.polynomials(block.rows)
            joint = inverse[np.ix_(columns, columns)]
            if by_local.shape[2]:
                one = self.exposures[block.frame_exposure]
                at = np.searchsorted(one.index, block.columns[len(columns) :])
                cross, own = followed[block.frame_exposure]
                edge = cross[np.ix_(columns, at)]
                joint = np.block([[joint, edge], [edge.T, own[np.ix_(at, at)]]])
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
        K, one = self.sample.model.n_terms, self.exposures.get(block.frame_exposure)
        own = None if one is None else self._following(one, which)
        out = _added(block, self.functions.n_added, K, which)
        out[:, :K] -= self.moved(block, self.nuisance[:, which], own)
        return out

    def _following(self, one: Eliminated, which: Int) -> Float:
        """Parameters (l, n) of an exposure that regressors are taken for."""
        G = self.n_global
        return np.asarray(one.gain[:, G + which] - one.gain[:, :G] @ self.nuisance[:, which])

    def prior_meat(self, which: Int) -> Float:
        """Covariance (n, n) that priors give to the scores of regressors, as data of their own."""
        nuisance = self.nuisance[:, which]
        out = nuisance.T @ self.precision @ nuisance
        for one in self.exposures.values():
            follows = self._following(one, which)
            out += follows.T @ (one.precision[:, None] * follows)
        return np.asarray(out)

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
    G, K, L = model.n_global, model.n_terms, len(functions.terms)
    chips = len(model.chips)
    m = G + 2 * (L - K) * chips
    pull = priors.pull(theta)
    information, score = np.zeros((m, m)), np.zeros(m)
    of_priors = priors.information(G)
    information[:G, :G] = of_priors
    score[:G] = pull[:G]
    exposures: dict[int, Eliminated] = {}
    for blocks in sample.blocks_by("frame_exposure"):
        index = np.arange(0)
        for block in blocks:
            index = np.union1d(index, block.columns[block.columns >= G])
        inner = np.diag(priors.precision[index])
        cross, own = np.zeros((len(index), m)), pull[index].copy()
        for block in blocks:
            F = functions.at(block.rows)
            by_global, by_local = block.parts(G)
            n_own = by_global.shape[2]
            added = 2 * (L - K) * block.chip + np.arange(2 * (L - K))
            columns = np.r_[block.columns[:n_own], G + added]
            X = np.zeros((2, L, len(columns)))
            X[:, :K, :n_own] = by_global
            X[..., n_own:] = _added(block, L - K, K, added)
            WX = weighted(F, sample.curvature[:, block.rows], X)
            R = F @ sample.score[:, block.rows].T  # (L, 2)
            information[np.ix_(columns, columns)] += _contracted(X, WX)
            score[columns] += _contracted(X, R.T[..., None])[:, 0]
            if by_local.shape[2]:
                at = np.searchsorted(index, block.columns[n_own:])
                cross[np.ix_(at, columns)] += _contracted(by_local, WX[:, :K])
                Wl = weighted(F[:K], sample.curvature[:, block.rows], by_local)
                inner[np.ix_(at, at)] += _contracted(by_local, Wl)
                own[at] += _contracted(by_local, R[:K].T[..., None])[:, 0]
        if len(index):
            inverse = _inverse(inner)
            gain = inverse @ cross
            information -= cross.T @ gain
            score -= gain.T @ own
            exposures[blocks[0].frame_exposure] = Eliminated(
                index, inverse, gain, own, priors.precision[index]
            )
    out = Projection(functions, exposures, information, score, of_priors, theta)
    out.root  # noqa: B018 - raises here, where there is another way
    return out


def _added(block: Block, n_added: int, n_terms: int, which: Int) -> Float:
    """Coefficients (2, L, n) of some regressors in a block, along the axes of the polynomials."""
    out = np.zeros((2, n_terms + n_added, len(which)))
    chip, rest = np.divmod(which, 2 * n_added)
    here = np.flatnonzero(chip == block.chip)
    function, axis = np.divmod(rest[here], 2)
    out[:, n_terms + function, here] = block.frame[:, axis]
    return out


def _contracted(A: Float, B: Float) -> Float:
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


def _inverse(matrix: Float) -> Float:
    """Inverse of an information matrix.

    Raises `numpy.linalg.LinAlgError` when it is not positive.
    """
    root = np.linalg.cholesky(_ridged(matrix))
    return np.asarray(cho_solve((root, True), np.eye(len(matrix))))


def beside_others(information: Float, own: Bool, directions: Float) -> Float:
    """Directions (n, q) of the `own` regressors (n,), without what the others say of them.

    `information` (n, n) is that of all, the parameters projected out; `directions` are combinations
    of the own ones.
    """
    out = np.zeros((len(own), directions.shape[1]))
    out[own] = directions
    across = information[np.ix_(~own, own)] @ directions
    out[~own] = -np.linalg.lstsq(information[np.ix_(~own, ~own)], across)[0]
    return out


def independent_directions(whole: Float, left: Float, least: float) -> Float:
    """Directions (n, q) of regressors that the parameters have left.

    `whole` and `left` (n, n) are the information of the regressors before and after the parameters
    are projected out, `least` the fraction of it that a direction must keep. Directions are in
    units in which `whole` is the unit matrix.
    """
    diagonal = np.diag(whole)
    scale = np.zeros(len(diagonal))
    scale[diagonal > 0] = diagonal[diagonal > 0] ** -0.5
    values, vectors = np.linalg.eigh(whole * np.outer(scale, scale))
    good = values > 1e-8 * values.max(initial=1e-300)
    basis = scale[:, None] * vectors[:, good] / np.sqrt(values[good])
    fraction, turn = np.linalg.eigh(basis.T @ left @ basis)
    return np.asarray(basis @ turn[:, fraction > least])


def squares_of(
    score: Float, information: Float, covariance: Float, square: Float
) -> tuple[float, float]:
    """Mean squares of the pattern that a score stands for, and of what noise makes of it.

    The first holds the second. `information` and `covariance` (q, q) are those of the directions
    and of their `score` (q,), `square` (q, q) the mean products of the directions over the
    detector.
    """
    inverse = np.linalg.inv(information)
    step = inverse @ score
    noise = np.trace(square @ inverse @ covariance @ inverse)
    return float(step @ square @ step), float(noise)
