"""Sums over groups of held-out stars, and their covariance through what all predictions share.

Every statistic is a sum of terms, one per star, with zero expectation if the prediction is correct.
Its derivative with respect to a parameter of the prediction is the sum of term times score, so that
the covariances of the solution's parameters, of the mixture's parameters and of fitted frames can
be propagated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import csr_matrix

from bayesdist.diagnose.holdout.frames import Frame
from bayesdist.diagnose.holdout.predictive import SCALES, Predictive
from bayesdist.diagnose.holdout.rows import HeldRows
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import gamma_cdf, gamma_sf, norm_sf

KNOTS, POINTS, LAST = 48, 2000, 60.0
MIN_SKEW = 1e-4


@dataclass(frozen=True, eq=False)
class StarScores:
    """Scores of stars with respect to everything that predictions share."""

    columns: Int  # indices (m,) of parameters of the solution
    solution: Float  # scores (n, m) with respect to these
    # covariance (n, m) of the catalogue's errors with these, times the score
    catalogue: Float | None
    free: Float  # scores (n, h) with respect to the uncertain parameters of the mixture
    exposure: str = ""
    # scores (n, q) with respect to the frame that was fitted to the exposure
    frame: Float | None = None

    @classmethod
    def of(cls, rows: HeldRows, place: Float, free: Float) -> StarScores:
        """Build from the scores with respect to positions (n, 2) and the mixture (n, h)."""
        shared, frame = rows.with_solution, rows.by_frame
        return cls(
            rows.columns,
            np.einsum("na,nam->nm", place, rows.jacobian),
            None if shared is None else np.einsum("na,nam->nm", place, shared),
            free,
            rows.exposure,
            None if frame is None else np.einsum("na,naq->nq", place, frame),
        )


@dataclass(eq=False)
class GroupedScores:
    """Sums of S statistics over stars, accumulated over batches."""

    sums: Float  # (S,)
    by: Float  # (S, D) sums of terms times scores with respect to the solution's parameters
    common: Float  # (S, D) covariance with these parameters through the catalogue's errors
    free: Float  # (S, h) sums of terms times scores with respect to the mixture
    # (S, q) with respect to the frames of these exposures
    lost: dict[str, Float] = field(default_factory=dict)

    @classmethod
    def empty(cls, n: int, n_params: int, n_free: int) -> GroupedScores:
        """Sums of no stars."""
        by = (n, n_params)
        return cls(np.zeros(n), np.zeros(by), np.zeros(by), np.zeros((n, n_free)))

    def add(self, terms: csr_matrix, scores: StarScores) -> None:
        """Add terms (S, n) of stars."""
        self.sums += np.asarray(terms.sum(axis=1)).ravel()
        self.by[:, scores.columns] += terms @ scores.solution
        if scores.catalogue is not None:
            self.common[:, scores.columns] += terms @ scores.catalogue
        self.free += terms @ scores.free
        if scores.frame is not None:
            shape = len(self.sums), scores.frame.shape[1]
            self.lost.setdefault(scores.exposure, np.zeros(shape))
            self.lost[scores.exposure] += terms @ scores.frame

    def mapped(self, matrix: Float) -> GroupedScores:
        """Sums of linear combinations (T, S) of the statistics."""
        return GroupedScores(
            matrix @ self.sums,
            matrix @ self.by,
            matrix @ self.common,
            matrix @ self.free,
            {name: matrix @ part for name, part in self.lost.items()},
        )

    def covariance(
        self, predictive: Predictive, frames: Mapping[str, Frame], *, mixture: bool
    ) -> Float:
        """Covariance (S, S) due to everything that predictions share.

        `mixture` includes the errors of the mixture's parameters.
        """
        common = self.common @ self.by.T
        out = self.by @ predictive.cov @ self.by.T - common - common.T
        if mixture:
            out += self.free @ predictive.free_cov @ self.free.T
        for name, lost in self.lost.items():
            out -= lost @ frames[name].spent @ lost.T
        return np.asarray(out)


@dataclass(eq=False)
class ScaleSums:
    """Sums of scores with respect to the log of a factor on the errors, in G groups of stars."""

    score: Float  # (G,)
    second: Float  # (G,) sums of their expected second and third moments
    third: Float
    by_free: Float  # (G, h) sums of products with the scores of the mixture
    scales: Float  # (G, SCALES) the same scores for errors multiplied by each factor

    @classmethod
    def empty(cls, n: int, n_free: int) -> ScaleSums:
        """Sums of no stars."""
        return cls(*(np.zeros((n, *shape)) for shape in ((), (), (), (n_free,), (SCALES.size,))))

    def add(
        self,
        member: csr_matrix,
        score: Float,
        moments: Float,
        free: Float,
        scales: Float,
    ) -> None:
        """Add stars according to their membership (G, n).

        The scores are (n,), those of the mixture (n, h) and those for other errors (n, SCALES);
        `moments` (2, n) are second and third moments.
        """
        self.score += member @ score
        self.second += member @ moments[0]
        self.third += member @ moments[1]
        self.by_free += member @ (score[:, None] * free)
        self.scales += member @ scales

    def factor(self, k: int) -> float:
        """Maximum-likelihood factor on the errors of group `k`."""
        return scale_of(self.scales[k])

    def p_value(self, k: int, free_cov: Float) -> float:
        """Probability of a factor farther from 1, given the covariance of the mixture."""
        g = self.by_free[k]
        variance = float(self.second[k] + g @ free_cov @ g)
        return sum_tails(float(self.score[k]), variance, float(self.third[k]))


def membership(codes: Int, n: int, values: Float | None = None) -> csr_matrix:
    """Matrix (n, N) that sums over the stars of each code, or (n k, N) times values (N, k).

    Stars with negative codes belong to no group.
    """
    rows = np.flatnonzero(codes >= 0)
    if values is None:
        return csr_matrix((np.ones(rows.size), (codes[rows], rows)), shape=(n, len(codes)))
    k = values.shape[1]
    at = (codes[rows, None] * k + np.arange(k)).ravel()
    return csr_matrix((values[rows].ravel(), (at, np.repeat(rows, k))), shape=(n * k, len(codes)))


class SpreadMoments:
    """Second and third moments of the spread scores of a star.

    The scores are w (q - 2) for both axes and w (q_u - 1) for one axis, where w is the probability
    of a true match and q its chi-square.  The moments are integrals over t = q / 2.  The density of
    true matches falls as exp(-t), that of false matches as k exp(-k t) or not at all.  The moments
    are tabulated as functions of k, the ratio of both variances.  Errors that differ between the
    axes are replaced by their geometric mean.
    """

    def __init__(self, predictive: Predictive) -> None:
        self._predictive = predictive
        self._log_k = np.linspace(np.log(1e-8), np.log(4.0), KNOTS)
        t = np.linspace(0.0, LAST, POINTS)
        f, k = predictive.fraction, np.exp(self._log_k)[:, None]
        core = (1 - f) * np.exp(-t)
        if predictive.outliers == "gaussian":
            far = f * k * np.exp(-k * t)
        elif predictive.outliers == "uniform":
            far = f * k * (t <= 1 / k)
        else:
            far = np.zeros((KNOTS, POINTS))
        w = core / np.maximum(core + far, 1e-300)
        score = w * (2 * t - 2)
        density = core + far
        # q_u = 2 t cos^2(angle) with a uniformly distributed angle: means of its powers
        square, cube = 1.5 * t**2 - 2 * t + 1, 2.5 * t**3 - 4.5 * t**2 + 3 * t - 1
        self._tables = [
            np.trapezoid(values * density, t, axis=1)
            for values in (score**2, score**3, w**2 * square, w**3 * cube)
        ]

    def of(self, cov: Float) -> Float:
        """Moments (2, 2, n) of stars with covariances (n, 3), for both axes and for one axis."""
        var = np.sqrt(cov[:, 0] * cov[:, 1] - cov[:, 2] ** 2)
        factor = 2.0 if self._predictive.outliers == "uniform" else 1.0
        log_k = np.log(factor * var / self._predictive.scale**2)
        moments = [np.interp(log_k, self._log_k, table) for table in self._tables]
        return np.array(moments).reshape(2, 2, -1)


def sum_tails(value: float, variance: float, third: float) -> float:
    """Two-sided p-value of a sum with zero mean, from a gamma distribution with the same moments.

    It is exact for sums of squares of normal variables.
    """
    if variance <= 0:
        return 1.0
    z = value / np.sqrt(variance)
    skew = third / variance**1.5
    if abs(skew) < MIN_SKEW:
        return float(2 * norm_sf(abs(z)))
    shape = 4 / skew**2
    x = shape + np.sign(skew) * z * np.sqrt(shape)
    below, above = float(gamma_cdf(x, shape)), float(gamma_sf(x, shape))
    return float(min(1.0, 2 * min(below, above)))


def scale_of(scores: Float) -> float:
    """Maximum-likelihood factor on the errors: the zero of the summed scores (SCALES,)."""
    if not np.any(scores < 0):
        return float(SCALES[-1])
    k = int(np.argmax(scores < 0))
    if k == 0:
        return float(SCALES[0])
    a, b = scores[k - 1], scores[k]
    steps = np.log(SCALES)
    # nearly linear in the inverse square of the factor
    x = np.exp(-2 * steps)
    zero = x[k - 1] + (x[k] - x[k - 1]) * a / (a - b)
    return float(1 / np.sqrt(zero))
