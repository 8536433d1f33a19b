"""Score tests of regressors: would additional terms improve the fit?

    T = U^T V^-1 U        U = sum of Z_i^T g_i        V = sum of (Z_i^T g'_i) (Z_i^T g'_i)^T

Z are the regressors with the parameters projected out, g is the score of a detection, and g' its
score after the fit has moved one step along Z, corrected for the leverage of fit and step.  The
only assumption about the noise is that stars are independent; the scores of the detections of a
star are summed first.  V is distributed like a Wishart matrix with fewer degrees of freedom than
there are stars, because stars near the edge, and stars whose errors are quoted too small, have the
largest weight.  T is distributed like Hotelling's statistic (Bell and McCaffrey 2002; Pustejovsky
and Tipton 2018).

The regressors of a test are functions of the detections.  No array has both the length of the
detections and the width of parameters or regressors, because each block's polynomials have only a
few coefficients.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag, cho_solve

from bayesdist.diagnose.score.questions import Regressors, TestedFunctions, one_of_each
from bayesdist.diagnose.score.result import Family, Outcome, outcome
from bayesdist.diagnose.score.sample import DetectionBlock, ScoredSample
from bayesdist.diagnose.statistics import Directions, EfficientScore, add_over, chi_square_of
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import chi2_sf, f_sf

MAX_TAKEN = 0.5  # largest leverage by fit and step: with more, the residuals do not show the noise
# Exponent of the leverage correction. 1/2 is exact if the quoted errors are correct (HC2), and 1,
# the jackknife, is too conservative then (HC3); if they are not, 1/2 underestimates the scatter of
# stars with a large weight.
GIVEN_BACK = 0.75
MIN_DOF = 3  # smallest degrees of freedom of the noise: with fewer, its covariance is meaningless
MAX_CHIPS = 4  # largest number of chips tested together, using the covariance of all their scores
RIDGE = 1e-12  # added to a scaled information matrix, so that undetermined directions stay finite
LARGEST_LEVERAGE = 0.95  # of one detection; with a larger leverage hardly any residual remains


def regressor_tests(projection: Projection) -> list[Outcome]:
    """Outcomes of all regressor tests for which there are enough stars."""
    by_regressors: dict[Regressors, list[_ProjectedPart]] = {}
    for chips in _chips_together(projection):
        for regressors, part in _parts_of(projection, chips):
            by_regressors.setdefault(regressors, []).append(part)
    return one_of_each(
        (regressors, _outcome(projection, regressors.family, parts))
        for regressors, parts in by_regressors.items()
    )


@dataclass(frozen=True, eq=False)
class _ProjectedPart:
    """Result of one test on one chip or on a few chips together."""

    statistic: float
    p_value: float
    dof: float
    dof_residual: float
    # square, noise: mean square of the pattern over these chips, noise included, and of the noise
    square: float
    noise: float


def _chips_together(projection: Projection) -> list[list[int]]:
    """Codes of the chips that are tested together: all, or each chip alone if there are many."""
    chips = sorted({block.chip for block in projection.sample.blocks})
    return [chips] if len(chips) <= MAX_CHIPS else [[chip] for chip in chips]


def _outcome(projection: Projection, family: Family, parts: Sequence[_ProjectedPart]) -> Outcome:
    """Outcome of one family, combined from its parts."""
    T, dof = parts[0].statistic, float(sum(part.dof for part in parts))
    residual: float | None = parts[0].dof_residual
    p = parts[0].p_value
    if len(parts) > 1:
        T = sum(chi_square_of(part.p_value, part.dof) for part in parts)
        residual, p = None, float(chi2_sf(T, dof))
    return outcome(
        family,
        T,
        dof,
        residual,
        p,
        square=float(np.mean([part.square for part in parts])),
        noise=float(np.mean([part.noise for part in parts])),
        unit=projection.sample.model.unit,
    )


def _parts_of(
    projection: Projection, chips: list[int]
) -> Iterator[tuple[Regressors, _ProjectedPart]]:
    """Iterate over the tests of all regressors on the given chips."""
    asked, tried = [], []
    for regressors in projection.functions.regressors:
        columns = np.concatenate([projection.columns(regressors.every, chip) for chip in chips])
        is_tested = regressors.own(len(chips))
        directions = Directions.of(
            projection.regressors,
            columns,
            is_tested,
            regressors.directions(len(chips)),
            projection.beside_exposures(columns[is_tested]),
            regressors.least,
        )
        if directions.q:
            asked.append(regressors)
            tried.append(directions)
    sums = _star_sums(projection, chips, tried)
    for regressors, directions, (V, spreads, taken) in zip(asked, tried, sums, strict=True):
        # Wishart matrices with the same scatter
        quoted, measured = directions.q * (directions.q + 1) / spreads - directions.q + 1
        if taken > MAX_TAKEN or quoted < MIN_DOF:
            continue
        dof_residual = float(np.clip(measured, MIN_DOF, quoted))
        dof = dof_residual + directions.q - 1
        T = dof_residual / dof * float(directions.score @ np.linalg.solve(V, directions.score))
        p = float(f_sf(T / directions.q, directions.q, dof_residual))
        square = np.repeat(projection.functions.mean_square[regressors.every], 2)
        squares = directions.squares(V, np.diag(np.tile(square, len(chips)) / len(chips)))
        yield regressors, _ProjectedPart(T, p, directions.q, dof_residual, *squares)


def _star_sums(
    projection: Projection, chips: list[int], tried: Sequence[Directions]
) -> list[tuple[Float, Float, float]]:
    """Covariance of the scores of each family, from the sums of scores per star.

    For each family the list also has the scatter (2,) of that covariance, according to the quoted
    errors and to the scores, and the mean leverage by fit and step of the contributing stars.
    """
    if not tried:
        return []
    sample = projection.sample
    n_stars = int(sample.star.max()) + 1
    single = n_stars == len(sample)
    together = _Together.of(tried)
    parts = [slice(a, b) for a, b in pairwise([*together.starts, len(together.step)])]
    V = [np.zeros((directions.q, directions.q)) for directions in tried]
    information = [np.zeros((directions.q, directions.q)) for directions in tried]
    by_star = np.zeros((0 if single else n_stars, len(together.step)))
    trace, norm = np.zeros((2, n_stars, len(tried)))
    leverage = np.zeros(len(tried))
    size2 = np.zeros((n_stars, len(tried)))
    blocks = [block for block in sample.blocks if block.chip in chips]
    all_chips = len(blocks) == len(sample.blocks)
    for block in blocks:
        coefficients = projection.regressor_map(block, together.columns) @ together.basis
        F = projection.functions.at(block.rows)
        x = np.stack([F.T @ coefficients[axis] for axis in (0, 1)])
        psi, trace_and_norm, lost = together.left_scores(projection, block, x)
        leverage += lost
        star = sample.star[block.rows]
        if single:
            trace[star], norm[star] = trace_and_norm
            size2[star] = np.add.reduceat(psi**2, together.starts, axis=1)
            for k, part in enumerate(parts):
                V[k] += psi[:, part].T @ psi[:, part]
        else:
            for total, values in (
                (by_star, psi),
                (trace, trace_and_norm[0]),
                (norm, trace_and_norm[1]),
            ):
                add_over(total, star, values)
        if not all_chips:
            uu, uv, vv = sample.curvature[:, block.rows]
            for k, part in enumerate(parts):
                u, v = x[..., part]
                cross = (u.T * uv) @ v
                information[k] += (u.T * uu) @ u + (v.T * vv) @ v + cross + cross.T
    for k, (directions, part) in enumerate(zip(tried, parts, strict=True)):
        if not single:
            V[k] += by_star[:, part].T @ by_star[:, part]
        if all_chips:
            V[k] += (
                directions.basis.T @ projection.prior_meat(directions.columns) @ directions.basis
            )
        else:  # contribution of other chips and priors through the frames, which is small
            V[k] += projection.score_ratio * (np.eye(directions.q) - information[k])
    if not single:
        size2 = np.add.reduceat(by_star**2, together.starts, axis=1)
    spreads = _spreads(
        trace, norm, size2, np.array([np.trace(matrix) / len(matrix) for matrix in V])
    )
    leverage /= trace.sum(axis=0)
    return [(matrix, a, float(b)) for matrix, a, b in zip(V, spreads, leverage, strict=True)]


def _spreads(trace: Float, norm: Float, size2: Float, scale: Float) -> Float:
    """Scatter (families, 2) of the covariances of scores, from quoted errors and from the scores.

    `trace` and `norm` (stars, families) are those of each star's information, `size2` (stars,
    families) the squares of its scores, and `scale` (families,) the mean variance of the scores per
    direction.
    """
    quoted = trace**2 + norm**2
    # part of the fourth moment that normal scores with these covariances have
    part = quoted / np.maximum(trace**2 + 2 * norm**2, 1e-300)
    measured = (part * size2**2).sum(axis=0) / scale**2
    return np.stack([quoted.sum(axis=0), measured], axis=1)


@dataclass(frozen=True, eq=False)
class _Together:
    """Directions of several families, concatenated."""

    columns: Int  # (n,)
    basis: Float  # (n, q)
    step: Float  # (q,)
    starts: Int  # (families,) index of the first direction of each family

    @classmethod
    def of(cls, tried: Sequence[Directions]) -> _Together:
        """Concatenate the directions of these families."""
        return cls(
            np.concatenate([directions.columns for directions in tried]),
            np.asarray(block_diag(*(directions.basis for directions in tried))),
            np.concatenate([directions.score for directions in tried]),
            np.cumsum([0, *(directions.q for directions in tried[:-1])]),
        )

    def left_scores(
        self, projection: Projection, block: DetectionBlock, x: Float
    ) -> tuple[Float, Float, Float]:
        """Scores (n, q) of detections after a step of the fit along the directions of each family.

        Also returns trace and norm (2, n, families) of each detection's information on the
        directions x (2, n, q), and the sum (families,) of leverage times trace.
        """

        def of_families(values: Float) -> Float:
            return np.add.reduceat(values, self.starts, axis=1)

        sample = projection.sample
        uu, uv, vv = sample.curvature[:, block.rows, None]
        moved = [of_families(component * self.step) for component in x]
        g = sample.score[:, block.rows, None] - np.stack(
            [uu * moved[0] + uv * moved[1], uv * moved[0] + vv * moved[1]]
        )
        G_uu, G_vv = np.abs(uu) * of_families(x[0] ** 2), np.abs(vv) * of_families(x[1] ** 2)
        G_uv = np.sqrt(np.abs(uu * vv)) * of_families(x[0] * x[1])
        trace, norm2 = G_uu + G_vv, G_uu**2 + 2 * G_uv**2 + G_vv**2
        by_step = np.stack([np.where(uu > 0, G_uu, 0.0), np.where(vv > 0, G_vv, 0.0)])
        if sample.covariance is not None:
            squares = [of_families(x[a] * x[b]) for a, b in ((0, 0), (0, 1), (1, 1))]
            trace, norm2 = _trace_and_norm(squares, (uu, uv, vv))
            by_step = np.broadcast_to(trace / 2, (2, *trace.shape))
        leverage = np.minimum(projection.leverage[:, block.rows, None] + by_step, LARGEST_LEVERAGE)
        g = g / (1.0 - leverage) ** GIVEN_BACK
        family = np.repeat(np.arange(len(self.starts)), np.diff([*self.starts, len(self.step)]))
        psi = g[0][:, family] * x[0] + g[1][:, family] * x[1]
        if sample.covariance is None:
            lost = (leverage[0] * G_uu + leverage[1] * G_vv).sum(axis=0)
        else:
            lost = (leverage[0] * trace).sum(axis=0)
        return psi, np.stack([trace, np.sqrt(norm2)]), lost


def _trace_and_norm(X: Sequence[Float], W: Sequence[Float]) -> tuple[Float, Float]:
    """Trace of X W, and that of its square, for symmetric matrices with elements uu, uv, vv.

    They are at least zero; curvatures W of detections between true and false matches may be
    negative.
    """
    (X_uu, X_uv, X_vv), (uu, uv, vv) = X, W
    first, last = X_uu * uu + X_uv * uv, X_uv * uv + X_vv * vv
    square = first**2 + 2 * (X_uu * uv + X_uv * vv) * (X_uv * uu + X_vv * uv) + last**2
    return np.maximum(first + last, 0.0), np.maximum(square, 0.0)


@dataclass(frozen=True, eq=False)
class Projection:
    """Sums over a sample from which the regressor tests are computed.

    There are D parameters, the first G of them global, and q regressors: each function that the
    tests add, on both axes of every chip.
    """

    functions: TestedFunctions
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

    def star_scores(self, F: Float, block: DetectionBlock, coefficients: Float) -> Float:
        """Scores (n, q) of detections, from coefficients (2, L, q) of functions F (L, n)."""
        g = self.scored.whole_score[:, block.rows]
        return np.asarray(sum((F * g[axis]).T @ coefficients[axis] for axis in (0, 1)))

    @cached_property
    def leverage(self) -> Float:
        """Fraction (2, N) of the noise of each detection that the fit follows, along u and v.

        If errors are correlated, it is the mean of both axes: half the trace of the product of the
        covariance of the model's position with the information of the detection.
        """
        sample = self.sample
        out = np.zeros((2, len(sample)))
        for block in sample.blocks:
            phi = self.functions.polynomials(block.rows)
            joint = self.covariance[np.ix_(block.columns, block.columns)]
            for axis in (0, 1):
                covariance = block.derivative[axis] @ joint @ block.derivative[axis].T
                follows = np.einsum("kn,kn->n", phi, covariance @ phi)
                out[axis, block.rows] = follows * sample.curvature[2 * axis, block.rows]
            if sample.covariance is not None:
                covariance = block.derivative[0] @ joint @ block.derivative[1].T
                mixed = np.einsum("kn,kn->n", phi, covariance @ phi)
                crossed = mixed * sample.curvature[1, block.rows]
                out[:, block.rows] = out[:, block.rows].mean(axis=0) + crossed
        return np.clip(out, 0.0, LARGEST_LEVERAGE)

    @cached_property
    def scored(self) -> ScoredSample:
        """Sample including the leverage of its detections."""
        return replace(self.sample, leverage=self.leverage)

    def regressor_map(self, block: DetectionBlock, which: Int) -> Float:
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


def projection_of(functions: TestedFunctions, theta: Float, priors: GaussianPriors) -> Projection:
    """Sums over the detections of a sample, at the parameters `theta` (D,) of its scores.

    If the information matrix is not positive definite, only concave parts of the likelihood are
    used.
    """
    try:
        return _summed(functions, theta, priors)
    except np.linalg.LinAlgError:
        concave = functions.sample.with_positive_curvature()
        return _summed(replace(functions, sample=concave), theta, priors)


def _summed(functions: TestedFunctions, theta: Float, priors: GaussianPriors) -> Projection:
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


def _added(block: DetectionBlock, n_added: int, n_terms: int, which: Int) -> Float:
    """Coefficients (2, L, n) of regressors in a block, along the axes of the polynomials."""
    out = np.zeros((2, n_terms + n_added, len(which)))
    chip, index_in_chip = np.divmod(which, 2 * n_added)
    on_chip = np.flatnonzero(chip == block.chip)
    function, axis = np.divmod(index_in_chip[on_chip], 2)
    out[:, n_terms + function, on_chip] = block.frame[:, axis]
    return out


def contracted(A: Float, B: Float) -> Float:
    """Products (m, n) of A (2, L, m) and B (2, L, n), summed over axes and functions."""
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
