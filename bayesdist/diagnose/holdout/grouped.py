"""Sums over groups of held-out stars, and how they vary through what all predictions share.

Every statistic is a sum of terms, one for each star, whose expectation is zero where the prediction
is right.  By a parameter of the prediction it changes as the sum of term times score, so that the
covariances of the solution's parameters, of the mixture's and of fitted frames carry over.
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
    """Scores of some stars by all that predictions share."""

    columns: Int  # parameters (m,) of the solution
    solution: Float  # scores (n, m) by these
    catalogue: Float | None  # covariance (n, m) of the catalogue's errors with these, times score
    free: Float  # scores (n, h) by what is not known exactly of the mixture
    exposure: str = ""
    frame: Float | None = None  # scores (n, q) by the frame that was fitted to the exposure

    @classmethod
    def of(cls, rows: HeldRows, place: Float, free: Float) -> StarScores:
        """Scores of stars, by those of their positions (n, 2) and of the mixture (n, h)."""
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
    """Sums of S statistics over stars; sums of batches are added one after the other."""

    sums: Float  # (S,)
    by: Float  # of terms times scores (S, D) by the solution's parameters
    common: Float  # covariance (S, D) with these, by way of the catalogue's errors
    free: Float  # (S, h)
    lost: dict[str, Float] = field(default_factory=dict)  # (S, q) by frames of these exposures

    @classmethod
    def empty(cls, n: int, n_params: int, n_free: int) -> GroupedScores:
        """Sums over nothing."""
        by = (n, n_params)
        return cls(np.zeros(n), np.zeros(by), np.zeros(by), np.zeros((n, n_free)))

    def add(self, terms: csr_matrix, scores: StarScores) -> None:
        """Add terms (S, n) of some stars."""
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
        """Covariance (S, S) by what all predictions share, with or without the mixture's errors."""
        common = self.common @ self.by.T
        out = self.by @ predictive.cov @ self.by.T - common - common.T
        if mixture:
            out += self.free @ predictive.free_cov @ self.free.T
        for name, lost in self.lost.items():
            out -= lost @ frames[name].spent @ lost.T
        return np.asarray(out)


@dataclass(eq=False)
class ScaleSums:
    """Sums of scores by the logarithm of a factor on the errors, in G groups of stars."""

    score: Float  # (G,)
    second: Float  # their expected moments (G,)
    third: Float
    by_free: Float  # times the scores (G, h) of the mixture
    scales: Float  # the same scores (G, SCALES) for other errors

    @classmethod
    def empty(cls, n: int, n_free: int) -> ScaleSums:
        """Sums over nothing."""
        return cls(*(np.zeros((n, *shape)) for shape in ((), (), (), (n_free,), (SCALES.size,))))

    def add(
        self,
        member: csr_matrix,
        score: Float,
        moments: Float,
        free: Float,
        scales: Float,
    ) -> None:
        """Add stars by their membership (G, n).

        Their scores are (n,), (n, h) and (n, SCALES), second and third moments (2, n).
        """
        self.score += member @ score
        self.second += member @ moments[0]
        self.third += member @ moments[1]
        self.by_free += member @ (score[:, None] * free)
        self.scales += member @ scales

    def factor(self, k: int) -> float:
        """Most likely factor on the errors of one group."""
        return scale_of(self.scales[k])

    def p_value(self, k: int, free_cov: Float) -> float:
        """Probability of a factor farther from 1 in one group, by the mixture's covariance."""
        g = self.by_free[k]
        variance = float(self.second[k] + g @ free_cov @ g)
        return sum_tails(float(self.score[k]), variance, float(self.third[k]))


def membership(codes: Int, n: int, values: Float | None = None) -> csr_matrix:
    """Matrix (n, N) that sums over the stars of each code, or (n k, N) times values (N, k).

    Stars of negative codes are of no group.
    """
    rows = np.flatnonzero(codes >= 0)
    if values is None:
        return csr_matrix((np.ones(rows.size), (codes[rows], rows)), shape=(n, len(codes)))
    k = values.shape[1]
    at = (codes[rows, None] * k + np.arange(k)).ravel()
    return csr_matrix((values[rows].ravel(), (at, np.repeat(rows, k))), shape=(n * k, len(codes)))


class SpreadMoments:
    """Second and third moments of the score w (q - 2) of one star, and of one axis, w (q_u - 1).

    w is the probability of a true match and q its chi-square.  They are integrals over t = q / 2,
    in which true matches fall as exp(-t) and false ones as k exp(-k t) or not at all, tabulated in
    k, the ratio of their variances; errors that differ between the axes count as their geometric
    mean.
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
        # q_u = 2 t cos^2 of an angle of which nothing is known: means of its powers
        square, cube = 1.5 * t**2 - 2 * t + 1, 2.5 * t**3 - 4.5 * t**2 + 3 * t - 1
        self._tables = [
            np.trapezoid(values * density, t, axis=1)
            for values in (score**2, score**3, w**2 * square, w**3 * cube)
        ]

    def of(self, cov: Float) -> Float:
        """Moments (2, 2, n) of stars with covariances uu, vv, uv (n, 3): of both axes, of one."""
        var = np.sqrt(cov[:, 0] * cov[:, 1] - cov[:, 2] ** 2)
        factor = 2.0 if self._predictive.outliers == "uniform" else 1.0
        log_k = np.log(factor * var / self._predictive.scale**2)
        found = [np.interp(log_k, self._log_k, table) for table in self._tables]
        return np.array(found).reshape(2, 2, -1)


def sum_tails(value: float, variance: float, third: float) -> float:
    """Two-sided probability of a sum of mean zero: by a gamma distribution of the same moments.

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
    """Factor on the errors at which the sum of scores (SCALES,) is zero: the most likely one."""
    if not np.any(scores < 0):
        return float(SCALES[-1])
    k = int(np.argmax(scores < 0))
    if k == 0:
        return float(SCALES[0])
    a, b = scores[k - 1], scores[k]
    steps = np.log(SCALES)
    # nearly a straight line in the inverse square of the factor
    x = np.exp(-2 * steps)
    zero = x[k - 1] + (x[k] - x[k - 1]) * a / (a - b)
    return float(1 / np.sqrt(zero))
