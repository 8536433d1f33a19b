"""Sums over held-out stars for all tests, accumulated in one pass.

**Groups of stars.**  Every statistic is a sum of terms, one per star, with zero expectation if the
prediction is correct.  Its derivative with respect to a parameter of the prediction is the sum of
term times score, so that the covariances of the solution's parameters, of the mixture's parameters
and of fitted frames, which all predictions share, can be propagated.

**Errors that matches share.**  A star of the catalogue has the same error in all exposures.  Errors
of a look-up table, or of structure that the model lacks, are the same for all stars in a cell of
the detector.  Sums over matches therefore vary by more than those of independent matches.  The
variance of position scores follows from the squares of their sums per star, and that of counts from
sums per cluster, which is a star or a cell.  The spread scores of matches are their chi-squares q
minus the expectation, weighted with the probability of a true match.  For these,

    cov(q_i, q_j) = 4 c_i c_j      c = (shared error)^2 / (total error)^2

for two matches i, j of a star (two axes, Gaussian errors).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.sparse import csr_matrix
from scipy.special import erf

from bayesdist.data.matches import Matches
from bayesdist.diagnose.holdout.bins import ALL, Partition
from bayesdist.diagnose.holdout.predictive import (
    SCALES,
    Frame,
    HeldRows,
    Predictive,
    marginals_of,
    predicted_rows,
    scores_of,
    uniforms_of,
)
from bayesdist.diagnose.statistics import joint_clusters, products_over, squares_over, sums_over
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import gamma_cdf, gamma_sf, norm_sf

PIT_BINS = 20
TAILS = (3.0, 4.0, 5.0)  # sigma
LEVELS = (1.0, 2.0)  # in sigma; fractions of stars within these are counted on each axis
STEP = 0.5  # step of numerical derivatives, in standard deviations of the mixture's parameters
KNOTS, POINTS, LAST = 48, 2000, 60.0
MIN_SKEW = 1e-4


@dataclass(eq=False)
class BinSums:
    """Sums over the stars of each of the B bins of a partition."""

    n: Float  # (B,) number of stars
    independent: Float  # (B,) number of distinct stars
    place: GroupedScores  # (2 B,) scores of the position: u and v of each bin in turn
    place_2: Float  # (B, 2, 2) sums of their squares
    place_cov: Float  # (2 B, 2 B) covariance of these sums due to the errors of the matches
    weight: Float  # (B, 2) sums of inverse variances, times the weight of each star
    scale: ScaleSums

    @classmethod
    def empty(cls, n: int, n_params: int, n_free: int) -> BinSums:
        """Sums of no stars."""
        return cls(
            np.zeros(n),
            np.zeros(n),
            GroupedScores.empty(2 * n, n_params, n_free),
            np.zeros((n, 2, 2)),
            np.zeros((0, 0)),
            np.zeros((n, 2)),
            ScaleSums.empty(n, n_free),
        )

    @property
    def offset_scores(self) -> Float:
        """Scores (B, 2) of the position."""
        return self.place.sums.reshape(-1, 2)

    def close(self, kind: str, shared: SharedErrors | None) -> None:
        """Replace variances of independent matches by those of matches with shared errors."""
        n = len(self.n)
        if shared is None:
            self.independent = self.n
            self.place_cov = np.asarray(block_diag(*self.place_2))
            return
        self.independent = shared.independent(kind, n)
        by_star, self.place_cov = shared.place_covariance(kind, n)
        pairs = np.arange(n)
        self.place_2 = by_star.reshape(n, 2, n, 2)[pairs, :, pairs]
        second, third = shared.spread_moments(kind, n)
        self.scale.second += second
        self.scale.third += third


@dataclass(eq=False)
class HeldSums:
    """Sums over all held-out stars."""

    bins: dict[str, BinSums]  # by the kind of the partition
    axes: tuple[ScaleSums, ScaleSums]  # of all stars, along u and along v
    # (2, LEVELS) number of stars within the central part of their predictive distribution on each
    # axis that corresponds to each level of a normal distribution
    within: Float
    # counts (PIT_BINS,) of the predictive probabilities of u, of v given u, and of the distance
    pit: tuple[GroupedScores, ...]
    beyond: Float  # (TAILS,) number of stars beyond each limit on either axis
    # (TAILS, 1 + 2 h) expected numbers, also with each mixture parameter slightly lower and higher
    expected: Float
    frames: Mapping[str, Frame]
    shared: SharedErrors | None  # None if the errors of all matches are independent
    n: int = 0  # number of predicted stars
    n_left_out: int = 0  # number of stars of exposures with too few stars for a frame


def held_sums(
    predictive: Predictive,
    held: Matches,
    partitions: Sequence[Partition],
    frames: Mapping[str, Frame],
) -> HeldSums:
    """Sums over held-out stars, in one pass over the data."""
    D, h = predictive.model.n_params, len(predictive.free)
    several = predictive.stars is not None or predictive.cell is not None
    out = HeldSums(
        {p.kind: BinSums.empty(len(p.bins), D, h) for p in partitions},
        (ScaleSums.empty(1, h), ScaleSums.empty(1, h)),
        np.zeros((2, len(LEVELS))),
        tuple(GroupedScores.empty(PIT_BINS, D, h) for _ in range(3)),
        np.zeros(len(TAILS)),
        np.zeros((len(TAILS), 1 + 2 * h)),
        frames,
        SharedErrors(predictive, PIT_BINS) if several else None,
    )
    moments = SpreadMoments(predictive)
    around = [predictive, *_around(predictive)]
    for table in held.batches():
        predicted = 0
        for rows in predicted_rows(predictive, table, frames):
            predicted += len(rows.index)
            _add(out, predictive, moments, around, partitions, table, rows)
        out.n += predicted
        out.n_left_out += len(table) - predicted
    for kind, sums in out.bins.items():
        sums.close(kind, out.shared)
    if out.shared is not None:
        # the joint scatter of stars is the same along both axes
        second, third = out.shared.spread_moments(ALL, 1)
        for axis in out.axes:
            axis.second += second / 2
            axis.third += third / 2
    return out


def _around(predictive: Predictive) -> list[Predictive]:
    """Predictive distributions with each mixture parameter slightly lower, and higher."""
    out = []
    sd = np.sqrt(np.diag(predictive.free_cov))
    for key, step in zip(predictive.free, STEP * sd, strict=True):
        for sign in (-1, 1):
            if key == "j":
                change = {"jitter2": max(predictive.jitter2 + sign * step, 0.0)}
            elif key == "f":
                change = {"fraction": float(np.clip(predictive.fraction + sign * step, 0, 1))}
            else:
                change = {"scale": predictive.scale * float(np.exp(sign * step))}
            out.append(replace(predictive, **change))
    return out


def _add(
    out: HeldSums,
    predictive: Predictive,
    moments: SpreadMoments,
    around: Sequence[Predictive],
    partitions: Iterable[Partition],
    table: Matches,
    rows: HeldRows,
) -> None:
    """Add stars to all sums."""
    scores = scores_of(predictive, rows.residual, rows.cov)
    carried = StarScores.of(rows, scores.place, scores.free)
    weight = np.divide(
        (scores.place * rows.residual).sum(axis=1)[:, None],
        (rows.residual**2 / rows.cov[:, :2]).sum(axis=1)[:, None] * rows.cov[:, :2],
    )
    place = scores.place
    if rows.frame is not None and rows.by_frame is not None:
        # rescale to the scatter that they would have without a fitted frame
        A = rows.by_frame
        absorbed = np.einsum("nam,mk,nak->na", A, rows.frame.spent, A)
        place = place * np.sqrt(1 + absorbed / rows.cov[:, :2])
    squares = (place[:, :, None] * place[:, None, :]).reshape(-1, 4)
    codes = {p.kind: p.codes(table, rows.index) for p in partitions}
    of_spread, of_axis = moments.of(rows.cov)
    for kind, code in codes.items():
        sums = out.bins[kind]
        n = len(sums.n)
        member = membership(code, n)
        sums.n += np.asarray(member.sum(axis=1)).ravel()
        sums.place.add(membership(code, n, scores.place), carried)
        sums.place_2 += (member @ squares).reshape(-1, 2, 2)
        sums.weight += member @ weight
        sums.scale.add(member, scores.one, of_spread, scores.free, scores.spread)
    all_stars = csr_matrix(np.ones((1, len(rows.index))))
    for a, axis in enumerate(out.axes):
        axis.add(all_stars, scores.axes[:, a], of_axis, scores.free, scores.axes_spread[:, a])
    aside = np.abs(2 * marginals_of(predictive, rows.residual, rows.cov) - 1)
    for k, level in enumerate(LEVELS):
        out.within[:, k] += (aside < erf(level / np.sqrt(2))).sum(axis=1)
    uniforms = uniforms_of(predictive, rows.residual, rows.cov)
    for counts, values in zip(out.pit, uniforms, strict=True):
        code = np.clip((values * PIT_BINS).astype(np.int64), 0, PIT_BINS - 1)
        counts.add(membership(code, PIT_BINS), replace(carried, catalogue=None))
    size = (np.abs(rows.residual) / np.sqrt(rows.cov[:, :2])).max(axis=1)
    if out.shared is not None:
        out.shared.add(table, rows, place, uniforms, size, codes)
    for k, limit in enumerate(TAILS):
        out.beyond[k] += (size > limit).sum()
        for m, variant in enumerate(around):
            extra = variant.jitter2 - predictive.jitter2
            out.expected[k, m] += _beyond(
                variant, limit * np.sqrt(rows.cov[:, :2]), extra, rows.cov
            )


def _beyond(one: Predictive, half: Float, extra: float, cov: Float) -> float:
    """Expected number of stars outside of boxes with half sides (n, 2)."""
    sigma = np.sqrt(np.maximum(cov[:, :2] + extra, 1e-300))
    core = erf(half / (np.sqrt(2) * sigma)).prod(axis=1)
    if one.outliers == "gaussian":
        far = erf(half / (np.sqrt(2) * one.scale)).prod(axis=1)
    elif one.outliers == "uniform":
        far = _in_circle(half / one.scale)
    else:
        far = np.ones(len(half))
    inside = (1 - one.fraction) * core + one.fraction * far
    return float(np.maximum(1 - inside, 0.0).sum())


def _in_circle(half: Float) -> Float:
    """Fraction (n,) of the unit circle inside boxes with half sides (n, 2)."""
    a, b = np.minimum(half, 1.0).T

    def under(x: Float) -> Float:  # area under the arc from 0 to x
        return 0.5 * (x * np.sqrt(1 - x * x) + np.arcsin(x))

    corner = np.sqrt(np.maximum(1 - b * b, 0.0))  # intersection of the box's top with the arc
    start = np.minimum(corner, a)
    return np.asarray((start * b + under(a) - under(start)) * 4 / np.pi)


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


class SharedErrors:
    """Matches, with the stars and cells through which their errors are correlated.

    `predictive` contains errors of the catalogue, of positions on the detector, or both.
    Predictive probabilities are counted in `n_bins` bins.
    """

    def __init__(self, predictive: Predictive, n_bins: int) -> None:
        self._predictive, self._n_bins = predictive, n_bins
        self._parts: list[dict[str, NDArray[Any]]] = []
        self._codes: dict[str, list[Int]] = {}
        self._step = predictive.cell if predictive.local else None
        self._n = 0

    def add(
        self,
        table: Matches,
        rows: HeldRows,
        place: Float,
        uniforms: Float,
        size: Float,
        codes: Mapping[str, Int],
    ) -> None:
        """Add matches, with their scores and the bins that they belong to."""
        stars, index = self._predictive.stars, rows.index
        if stars is None or table.star is None:
            star = -1 - self._n - np.arange(len(index))  # each match is a separate star
            variance = np.zeros(len(index))
        else:
            star = table.star[index]
            epoch = None if table.epoch is None else table.epoch[index]
            variance = stars.errors.at(star, epoch).mean(axis=1)
        self._n += len(index)
        total_variance = rows.cov[:, :2].mean(axis=1)
        part: dict[str, NDArray[Any]] = {
            "star": star,
            "place": place,
            "share": np.minimum(variance / total_variance, 1.0),
            "pit": np.clip((uniforms * self._n_bins).astype(np.int64), 0, self._n_bins - 1).T,
            "size": size,
        }
        if self._step is not None:
            chip = table.chip_number[index]
            x, y = table.x[index], table.y[index]
            local = self._predictive.local_variance(x, y, chip)
            part["local"] = (1 - self._predictive.fraction) * np.sqrt(local) / total_variance
            part["local_size"] = np.sqrt(local)
            part["local_share"] = np.minimum(local / total_variance, 1.0)
            across, up = (
                np.maximum(a // s, 0).astype(np.int64)
                for a, s in zip((x, y), self._step, strict=True)
            )
            part["cell"] = (chip * 2**20 + up) * 2**20 + across
        self._parts.append(part)
        for kind, code in codes.items():
            self._codes.setdefault(kind, []).append(code)

    @cached_property
    def _all(self) -> dict[str, NDArray[Any]]:
        """Columns of all matches, with stars and cells numbered from 0."""
        out = {k: np.concatenate([part[k] for part in self._parts]) for k in self._parts[0]}
        for k in {"star", "cell"} & set(out):
            out[k] = np.unique(out[k], return_inverse=True)[1]
        return out

    def _inside(self, kind: str, *names: str) -> list[NDArray[Any]]:
        """Bins (n,) and columns of the matches that belong to a bin of a partition."""
        code = np.concatenate(self._codes[kind])
        inside = np.flatnonzero(code >= 0)
        return [code[inside], *(self._all[name][inside] for name in names)]

    def place_covariance(self, kind: str, n: int) -> tuple[Float, Float]:
        """Covariances (2 n, 2 n) of position scores in n bins, without and with errors of cells."""
        at, star, place = self._inside(kind, "star", "place")
        by_star = products_over(at, star, place, n)
        if self._step is None:
            return by_star, by_star
        at, cell, local = self._inside(kind, "cell", "local")
        extra = products_over(at, cell, local[:, None], n)
        extra[np.diag_indices(n)] -= np.bincount(at, local**2, n)
        return by_star, by_star + np.kron(extra, np.eye(2))

    def spread_moments(self, kind: str, n: int) -> tuple[Float, Float]:
        """Second and third moments (n,) that correlated errors add to the spread scores."""
        out = np.zeros((2, n))
        pairs = [("star", "share")]
        if self._step is not None:
            pairs.append(("cell", "local_share"))
        for names in pairs:
            at, member, share = self._inside(kind, *names)
            owner, of = joint_clusters(at, member)
            p1, p2, p3 = (sums_over(of, share**k) for k in (1, 2, 3))
            two = np.maximum(p1**2 - p2, 0.0)
            three = np.maximum(p1**3 - 3 * p1 * p2 + 2 * p3, 0.0)
            out[0] += np.bincount(owner, 4 * two, n)
            out[1] += np.bincount(owner, 16 * (3 * two + three), n)
        return out[0], out[1]

    def independent(self, kind: str, n: int) -> Float:
        """Number (n,) of distinct stars in each bin."""
        at, star = self._inside(kind, "star")
        return np.bincount(joint_clusters(at, star)[0], minlength=n).astype(np.float64)

    @property
    def stars_repeat(self) -> bool:
        """True if several matches share the error of one star."""
        return self.n_stars < self._n

    @cached_property
    def n_stars(self) -> int:
        """Number of distinct stars."""
        return int(self._all["star"].max()) + 1

    def pit_covariance(self, k: int, merge: int) -> Float:
        """Covariance (m, m) of the counts of predictive probabilities, in merged bins.

        The error that a cell shares changes a count like a parameter of the solution does: by the
        sum of score times error.  Squares of the counts of a few tens of cells would not give a
        covariance of full rank.
        """
        m = self._n_bins // merge
        code = self._all["pit"][:, k] // merge
        if self.stars_repeat:
            by = _by_bin(code, self._all["star"], m, np.ones(len(code)))
            out = by.T @ by
        else:
            out = len(code) * (np.eye(m) / m - 1 / m**2)
        if self._step is not None:
            for score in (self._all["place"] * self._all["local_size"][:, None]).T:
                by = _by_bin(code, self._all["cell"], m, score)
                out += by.T @ by
        return np.asarray(out)

    def overdispersion(self, limit: float) -> float:
        """Variance of the number of stars beyond a limit, divided by that of independent stars."""
        far = (self._all["size"] > limit).astype(float)
        deviation = far - far.mean()
        single = float((deviation**2).sum())
        clustered = float(squares_over(self._all["star"], deviation)[0])
        return max(1.0, clustered / single) if single else 1.0


def _by_bin(code: Int, cluster: Int, m: int, values: Float) -> Float:
    """Sums (clusters, m) of values per bin, minus their mean over the bins."""
    n = int(cluster.max()) + 1
    sums = np.bincount(cluster * m + code, values, n * m).reshape(n, m)
    return np.asarray(sums - sums.sum(axis=1, keepdims=True) / m)
