"""Statistics of tests: sums over clusters, efficient scores, p-values, and confidence intervals.

**Sums over clusters.**  Detections of one star, one exposure or one cell have correlated errors.
The variance of a statistic that is a sum over detections follows from the squares of its sums over
such clusters, not from those of single detections.

**Efficient scores.**  Tests add columns Z to the derivatives J of positions with respect to the
parameters of the model, which are nuisance parameters and are projected out.  With H the curvature
and g the gradient of each detection, and P and r the precision of the priors and their gradient,

    gain = C^-1 J^T H Z         C = J^T H J + P
    information = Z^T H Z - (J^T H Z)^T gain
    score = Z^T g - gain^T (J^T g + r)

If positions of stars are fitted, they are eliminated from all these sums first.

**P-values** are corrected for the number of tests; confidence intervals are those of fractions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_matrix

from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.distributions import beta_ppf, beta_sf, chi2_isf

MIN_P = 1e-300  # avoids underflow: no p-value is zero
# largest p-value that is combined with others, so that one near 1 does not hide those below 1e-3
LARGEST_COMBINED = 0.99


def sums_over(cluster: Int, values: Float, n: int = 0) -> Float:
    """Sums of values over clusters.

    `cluster` (N,) are codes from 0, `values` are (N, ...), and the result has at least `n` rows.
    """
    columns = values.reshape(len(values), math.prod(values.shape[1:])).T
    sums = [np.bincount(cluster, column, n) for column in columns]
    return np.stack(sums, axis=1).reshape(-1, *values.shape[1:]).astype(np.float64)


def add_over(total: Float, cluster: Int, values: Float) -> None:
    """Add values (N, ...) to the totals (c, ...) of their clusters, a few of many.

    `total` is changed in place.
    """
    present, of = np.unique(cluster, return_inverse=True)
    total[present] += sums_over(of, values)


def joint_clusters(group: Int, cluster: Int) -> tuple[Int, Int]:
    """Split clusters by group.

    `group` and `cluster` (N,) must not be negative.  Returns the group (c,) of each of the c parts,
    and the part (N,) of each value.
    """
    n = int(cluster.max(initial=0)) + 1
    keys, of = np.unique(group * n + cluster, return_inverse=True)
    return keys // n, of


def squares_over(cluster: Int, values: Float, group: Int | None = None, n: int = 1) -> Float:
    """Squares (n, ...) of the sums over clusters, summed in each group.

    `cluster` (N,) must not be negative, `values` are (N, ...); there is a single group by default.
    """
    owner, of = joint_clusters(np.zeros_like(cluster) if group is None else group, cluster)
    return sums_over(owner, sums_over(of, values) ** 2, n)


def products_over(group: Int, cluster: Int, values: Float, n: int) -> Float:
    """Products between groups of the sums of k values over clusters, summed over the clusters.

    Returns a matrix (k n, k n) for values (N, k) in n groups.
    """
    k = values.shape[1]
    rows = (group[:, None] * k + np.arange(k)).ravel()
    shape = (n * k, int(cluster.max(initial=0)) + 1)
    table = csr_matrix((values.ravel(), (rows, np.repeat(cluster, k))), shape=shape)
    return np.asarray((table @ table.T).toarray())


@dataclass(frozen=True, eq=False)
class EfficientScore:
    """Information and score of n columns with the parameters projected out."""

    gain: Float  # (D, n) changes of the parameters that imitate the columns
    information: Float  # (n, n)
    score: Float  # (n,)

    @classmethod
    def of(
        cls,
        covariance: Float,
        nuisance_score: Float,
        cross: Float,
        information: Float,
        score: Float,
        rows: Int | slice = slice(None),
    ) -> EfficientScore:
        """Project the parameters out of information and score of columns.

        `covariance` (D, D) and `nuisance_score` (D,) are those of the parameters.  `cross` (m, n)
        is the information between parameters and columns, for the parameters `rows` only if the
        columns depend on few of them.
        """
        gain = covariance[:, rows] @ cross
        projected = information - cross.T @ gain[rows]
        return cls(gain, (projected + projected.T) / 2, score - gain.T @ nuisance_score)


@dataclass(frozen=True, eq=False)
class Directions:
    """Combinations of columns that the parameters do not absorb, scaled to unit information."""

    columns: Int  # (m,) indices of the columns
    basis: Float  # (m, q) with unit information after projecting out all parameters
    score: Float  # (q,) score, equal to the step of the fit

    @classmethod
    def of(
        cls,
        left: EfficientScore,
        columns: Int,
        own: Bool,
        combinations: Float,
        known: Float,
        least: float,
    ) -> Directions:
        """Directions of the columns marked as `own`, with all other columns projected out.

        `columns` (m,) are indices into `left`, and `own` (m,) is a mask of them.  `combinations`
        (k, n) are the combinations of own columns to test, `known` (k, k) is the information of
        these columns before anything is projected out, and `least` the fraction of it that a
        direction must keep.
        """
        S = left.information[np.ix_(columns, columns)]
        A = _beside_others(S, own, combinations)
        S = A.T @ S @ A
        N = independent_directions(combinations.T @ known @ combinations, S, least)
        # eigenvectors: their information is diagonal
        basis = A @ (N / np.sqrt(np.einsum("nq,nm,mq->q", N, S, N, optimize=True)))
        return cls(columns, basis, basis.T @ left.score[columns])

    @property
    def q(self) -> int:
        """Number of directions."""
        return self.basis.shape[1]

    def squares(self, covariance: Float, square: Float) -> tuple[float, float]:
        """Mean squares of the pattern that corresponds to the score, and of its noise.

        `covariance` (q, q) is that of the score, `square` (m, m) the mean products of the columns.
        """
        of_basis = self.basis.T @ square @ self.basis
        return squares_of(self.score, np.eye(self.q), covariance, of_basis)


def _beside_others(information: Float, own: Bool, directions: Float) -> Float:
    """Directions (n, q) of the `own` regressors (n,), with the other regressors projected out.

    `information` (n, n) is that of all regressors with the parameters projected out; `directions`
    are combinations of the own ones.
    """
    out = np.zeros((len(own), directions.shape[1]))
    out[own] = directions
    across = information[np.ix_(~own, own)] @ directions
    out[~own] = -np.linalg.lstsq(information[np.ix_(~own, ~own)], across)[0]
    return out


def independent_directions(whole: Float, left: Float, least: float) -> Float:
    """Directions (n, q) of regressors that the parameters do not absorb.

    `whole` and `left` (n, n) are the information of the regressors before and after the parameters
    are projected out, `least` is the fraction that a direction must keep.  Directions are scaled
    such that `whole` becomes the unit matrix.
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
    """Mean squares of the pattern that corresponds to a score, noise included, and of its noise.

    `information` and `covariance` (q, q) are those of the directions and of their `score` (q,);
    `square` (q, q) contains the mean products of the directions over the detector.
    """
    inverse = np.linalg.inv(information)
    step = inverse @ score
    noise = np.trace(square @ inverse @ covariance @ inverse)
    return float(step @ square @ step), float(noise)


def holm(p_values: ArrayLike) -> Float:
    """P-values (m,) corrected for their number (Holm 1979).

    A test is significant at a level, among all tests, if its corrected value does not exceed the
    level.
    """
    p = np.asarray(p_values, float)
    order = np.argsort(p, kind="stable")
    out = np.empty(len(p))
    steps = np.arange(len(p), 0, -1) * p[order]
    out[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return out


def combined_p(p_values: ArrayLike, weights: ArrayLike) -> float:
    """P-value of the sum of p-values (m,) that were transformed to a Cauchy distribution.

    Small results are exact for tests that depend on each other in any way (Liu and Xie 2020, J. Am.
    Stat. Assoc. 115, 393).  The weights (m,) add up to 1.
    """
    p = np.clip(np.asarray(p_values, float), MIN_P, LARGEST_COMBINED)
    t = float(np.asarray(weights, float) @ (1.0 / np.tan(np.pi * p)))
    return float(np.arctan2(1.0, t) / np.pi)


def hotelling_p(statistic: float, dof: float, n: float) -> float:
    """P-value of a chi-square statistic with a covariance estimated from the squares of n vectors.

    The squares are taken about zero (Hotelling 1931).  `dof` is the number of directions, `n` that
    of stars or other independent vectors.
    """
    return float(beta_sf(min(statistic / n, 1.0), dof / 2, max(n - dof, 1) / 2))


def chi_square_of(p: float, dof: float) -> float:
    """Chi-square with the p-value `p`, for combining tests that have other distributions."""
    return float(chi2_isf(max(p, MIN_P), dof))


def clopper_pearson(fraction: float, n: float, confidence: float) -> tuple[float, float]:
    """Exact central confidence interval of a fraction, given the observed fraction in n trials.

    Clopper & Pearson 1934, Biometrika 26, 404, in its form with quantiles of the beta distribution:
    neither the number of trials nor that of successes needs to be an integer.
    """
    tail, k = (1.0 - confidence) / 2.0, fraction * n
    low = float(beta_ppf(tail, k, n - k + 1.0)) if k > 0 else 0.0
    high = float(beta_ppf(1.0 - tail, k + 1.0, n - k)) if k < n else 1.0
    return low, high
