"""Sums over held-out stars for all tests, accumulated in one pass."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.sparse import csr_matrix
from scipy.special import erf

from bayesdist.data.matches import Matches
from bayesdist.diagnose.holdout.bins import ALL, Partition
from bayesdist.diagnose.holdout.frames import Frame
from bayesdist.diagnose.holdout.grouped import (
    GroupedScores,
    ScaleSums,
    SpreadMoments,
    StarScores,
    membership,
)
from bayesdist.diagnose.holdout.predictive import (
    Predictive,
    marginals_of,
    scores_of,
    uniforms_of,
)
from bayesdist.diagnose.holdout.rows import HeldRows, predicted_rows
from bayesdist.diagnose.holdout.shared import SharedErrors
from bayesdist.utils.arrays import Float

PIT_BINS = 20
TAILS = (3.0, 4.0, 5.0)  # sigma
LEVELS = (1.0, 2.0)  # in sigma; fractions of stars within these are counted on each axis
STEP = 0.5  # step of numerical derivatives, in standard deviations of the mixture's parameters


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
