"""Sums over held-out stars from which they are judged: in bins, in counts, in one pass."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.sparse import csr_matrix
from scipy.special import erf

from bayesdist.data.matches import Matches
from bayesdist.diagnose.holdout.bins import ALL, Partition
from bayesdist.diagnose.holdout.frames import Frame
from bayesdist.diagnose.holdout.predictive import (
    SCALES,
    Predictive,
    Scores,
    marginals_of,
    scores_of,
    uniforms_of,
)
from bayesdist.diagnose.holdout.rows import Rows, predicted_rows
from bayesdist.diagnose.holdout.shared import ClusterSums
from bayesdist.diagnose.holdout.spread import SpreadMoments

__all__ = ["LEVELS", "PIT_BINS", "TAILS", "AxisSums", "BinSums", "HeldSums", "held_sums"]

Float = NDArray[np.float64]

PIT_BINS = 20
TAILS = (3.0, 4.0, 5.0)  # sigma
LEVELS = (1.0, 2.0)  # sigma, within which stars are counted along each axis
STEP = 0.5  # of a standard deviation of the mixture's parameters: for derivatives


@dataclass(eq=False)
class BinSums:
    """Sums over the stars of each bin of a partition; B bins.

    Attributes
    ----------
    n : ndarray, shape (B,)
    place : ndarray, shape (B, 2)
        Scores of the position.
    place_2 : ndarray, shape (B, 2, 2)
        Their squares.
    place_cov : ndarray, shape (2 B, 2 B) or None
        Covariance of all sums where matches share errors, in place of these squares.
    weight : ndarray, shape (B, 2)
        Inverse variances, each times the share that its star counts.
    place_by : ndarray, shape (B, 2, D)
        What they have in common with the solution's parameters.
    place_with : ndarray, shape (B, 2, D)
        Covariance of their sums with these parameters, by way of the catalogue's errors.
    lost : dict of str to ndarray, shape (B, 2, q)
        ... and with the frames that were fitted to these stars.
    spread, spread_2, spread_3 : ndarray, shape (B,)
        Scores of the scale of the errors, and their expected second and third moments.
    spread_by : ndarray, shape (B, h)
    scales : ndarray, shape (B, SCALES)
        Those scores for other errors.
    independent : ndarray, shape (B,)
        Stars, each once in however many exposures it is; as `n` where they share no errors.
    """

    n: Float
    place: Float
    place_2: Float
    weight: Float
    place_by: Float
    place_with: Float
    spread: Float
    spread_2: Float
    spread_3: Float
    spread_by: Float
    scales: Float
    independent: Float
    lost: dict[str, Float] = field(default_factory=dict)
    place_cov: Float | None = None

    @property
    def own_cov(self) -> Float:
        """Covariance (2 B, 2 B) of the sums by what is the matches' own."""
        if self.place_cov is not None:
            return self.place_cov
        return np.asarray(block_diag(*self.place_2))

    @classmethod
    def empty(cls, n_bins: int, n_params: int, n_free: int) -> BinSums:
        """Sums over nothing."""
        by = (2, n_params)
        shapes = ((), (2,), (2, 2), (2,), by, by, (), (), (), (n_free,), (SCALES.size,), ())
        sums: list[Float] = [np.zeros((n_bins, *shape)) for shape in shapes]
        return cls(*sums)  # type: ignore[arg-type]


@dataclass(eq=False)
class AxisSums:
    """Sums over all stars along u and along v.

    Attributes
    ----------
    score, second, third : ndarray, shape (2,)
        Scores of the scale of the errors along the axis, and their expected moments.
    by_free : ndarray, shape (2, h)
    scales : ndarray, shape (2, SCALES)
        Those scores for other errors.
    within : ndarray, shape (2, LEVELS)
        Stars in the middle of their predictive distribution along the axis: in so much of it as a
        normal variable has within so many sigma.
    """

    score: Float
    second: Float
    third: Float
    by_free: Float
    scales: Float
    within: Float

    @classmethod
    def empty(cls, n_free: int) -> AxisSums:
        """Sums over nothing."""
        shapes = ((), (), (), (n_free,), (SCALES.size,), (len(LEVELS),))
        return cls(*(np.zeros((2, *shape)) for shape in shapes))


@dataclass(eq=False)
class HeldSums:
    """Sums over all held-out stars.

    Attributes
    ----------
    n, n_left_out : int
        Stars that were predicted, and those of exposures with too few for a frame.
    bins : dict of str to BinSums
        By the name of the partition.
    axes : AxisSums
    pit : ndarray, shape (3, PIT_BINS)
        Counts of the predictive probabilities of u, of v given u, and of the distance.
    pit_by : ndarray, shape (3, PIT_BINS, D)
    pit_free : ndarray, shape (3, PIT_BINS, h)
    beyond : ndarray, shape (TAILS,)
        Stars beyond so many sigma on either axis.
    expected : ndarray, shape (TAILS, 1 + 2 h)
        Expected ones; then with each parameter of the mixture a little lower and higher.
    frames : mapping of str to Frame
    pit_lost : dict of str to ndarray, shape (3, PIT_BINS, q)
        What the counts have in common with these frames.
    shared : ClusterSums or None
        What else matches have in common; None where each has an error of its own.
    """

    bins: dict[str, BinSums]
    axes: AxisSums
    pit: Float
    pit_by: Float
    pit_free: Float
    beyond: Float
    expected: Float
    frames: Mapping[str, Frame]
    pit_lost: dict[str, Float] = field(default_factory=dict)
    shared: ClusterSums | None = None
    n: int = 0
    n_left_out: int = 0


def held_sums(
    predictive: Predictive,
    held: Matches,
    partitions: Sequence[Partition],
    frames: Mapping[str, Frame],
) -> HeldSums:
    """Go through held-out stars once.

    Parameters
    ----------
    predictive : Predictive
    held : Matches
    partitions : sequence of Partition
    frames : mapping of str to Frame

    Returns
    -------
    HeldSums
    """
    D, h = predictive.model.n_params, len(predictive.free)
    out = HeldSums(
        {p.kind: BinSums.empty(len(p.bins), D, h) for p in partitions},
        AxisSums.empty(h),
        np.zeros((3, PIT_BINS)),
        np.zeros((3, PIT_BINS, D)),
        np.zeros((3, PIT_BINS, h)),
        np.zeros(len(TAILS)),
        np.zeros((len(TAILS), 1 + 2 * h)),
        frames,
    )
    if predictive.stars is not None or predictive.cell is not None:
        out.shared = ClusterSums(predictive, PIT_BINS, TAILS)
    moments = SpreadMoments(predictive)
    around = [predictive, *_around(predictive)]
    for table in held.batches():
        seen = 0
        for rows in predicted_rows(predictive, table, frames):
            seen += len(rows.index)
            _add(out, predictive, moments, around, partitions, table, rows)
        out.n += seen
        out.n_left_out += len(table) - seen
    for sums in out.bins.values():
        sums.independent[:] = sums.n
    if out.shared is not None:
        whole = out.bins[ALL]
        alone = whole.spread_2[0], whole.spread_3[0]
        out.shared.settle(out.bins)
        # what stars scatter together they do alike along both axes
        out.axes.second += (whole.spread_2[0] - alone[0]) / 2
        out.axes.third += (whole.spread_3[0] - alone[1]) / 2
    return out


def _around(predictive: Predictive) -> list[Predictive]:
    """The prediction with each parameter of the mixture a little lower and higher."""
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
    partitions: Sequence[Partition],
    table: Matches,
    rows: Rows,
) -> None:
    scores = scores_of(predictive, rows.residual, rows.cov)
    second, third = moments.of(rows.cov)
    along = np.einsum("na,nam->nm", scores.place, rows.jacobian)
    weight = np.divide(
        (scores.place * rows.residual).sum(axis=1)[:, None],
        (rows.residual**2 / rows.cov[:, :2]).sum(axis=1)[:, None] * rows.cov[:, :2],
    )
    lost = _Lost.of(table, rows, scores.place)
    place = scores.place
    if rows.frame is not None and rows.by_frame is not None:
        # as they would scatter if they had lost nothing to the frame
        A = rows.by_frame
        taken = np.einsum("nam,mk,nak->na", A, rows.frame.spent, A)
        place = place * np.sqrt(1 + taken / rows.cov[:, :2])
    shares = None
    if rows.with_solution is not None:
        shares = np.einsum("na,nam->nm", scores.place, rows.with_solution)
    codes = {p.kind: p.codes(table, rows.index) for p in partitions}
    for partition in partitions:
        sums = out.bins[partition.kind]
        member = _member(codes[partition.kind], len(partition.bins))
        sums.n += _sum(member, np.ones(len(rows.index)))
        sums.place += member @ scores.place
        outer = place[:, :, None] * place[:, None, :]
        sums.place_2 += (member @ outer.reshape(-1, 4)).reshape(-1, 2, 2)
        sums.weight += member @ weight
        sums.spread += _sum(member, scores.one)
        sums.spread_2 += _sum(member, second)
        sums.spread_3 += _sum(member, third)
        sums.spread_by += member @ (scores.one[:, None] * scores.free)
        sums.scales += member @ scores.spread
        for axis in (0, 1):
            by = member @ (scores.place[:, axis, None] * along)
            sums.place_by[:, axis, rows.columns] += by
            if shares is not None:
                common = member @ (scores.place[:, axis, None] * shares)
                sums.place_with[:, axis, rows.columns] += common
        if lost is not None:
            shared = lost.among(sums.lost, len(partition.bins), 2)
            for axis in (0, 1):
                shared[:, axis] += member @ (scores.place[:, axis, None] * lost.along)
    _add_axes(out.axes, predictive, moments, scores, rows)
    uniforms = uniforms_of(predictive, rows.residual, rows.cov)
    for k, values in enumerate(uniforms):
        code = np.clip((values * PIT_BINS).astype(np.int64), 0, PIT_BINS - 1)
        member = _member(code, PIT_BINS)
        out.pit[k] += np.bincount(code, minlength=PIT_BINS)
        out.pit_by[k][:, rows.columns] += member @ along - along.sum(axis=0) / PIT_BINS
        out.pit_free[k] += member @ scores.free - scores.free.sum(axis=0) / PIT_BINS
        if lost is not None:
            shared = lost.among(out.pit_lost, 3, PIT_BINS)
            shared[k] += member @ lost.along - lost.along.sum(axis=0) / PIT_BINS
    size = np.abs(rows.residual) / np.sqrt(rows.cov[:, :2])
    if out.shared is not None:
        out.shared.add(table, rows, place, uniforms, size.max(axis=1), codes)
    for k, limit in enumerate(TAILS):
        out.beyond[k] += (size.max(axis=1) > limit).sum()
        for m, one in enumerate(around):
            extra = one.jitter2 - predictive.jitter2
            out.expected[k, m] += _beyond(one, limit * np.sqrt(rows.cov[:, :2]), extra, rows.cov)


def _add_axes(
    axes: AxisSums, predictive: Predictive, moments: SpreadMoments, scores: Scores, rows: Rows
) -> None:
    second, third = moments.of_axis(rows.cov)
    axes.score += scores.axes.sum(axis=0)
    axes.second += second.sum()
    axes.third += third.sum()
    axes.by_free += scores.axes.T @ scores.free
    axes.scales += scores.axes_spread.sum(axis=0)
    aside = np.abs(2 * marginals_of(predictive, rows.residual, rows.cov) - 1)
    for k, level in enumerate(LEVELS):
        axes.within[:, k] += (aside < erf(level / np.sqrt(2))).sum(axis=1)


@dataclass(frozen=True, eq=False)
class _Lost:
    """Scores (n, q) by the frame that was fitted to the exposure of these stars."""

    name: str
    along: Float

    @classmethod
    def of(cls, table: Matches, rows: Rows, place: Float) -> _Lost | None:
        if rows.by_frame is None:
            return None
        name = table.exposure_names[table.exposure[rows.index[0]]]
        return cls(name, np.einsum("na,naq->nq", place, rows.by_frame))

    def among(self, sums: dict[str, Float], *shape: int) -> Float:
        """The exposure's own sums, zero at first."""
        return sums.setdefault(self.name, np.zeros((*shape, self.along.shape[1])))


def _member(codes: NDArray[np.int64], n_bins: int) -> csr_matrix:
    """Matrix (n_bins, n) that sums over the stars of each bin; negative codes are of none."""
    rows = np.flatnonzero(codes >= 0)
    return csr_matrix((np.ones(rows.size), (codes[rows], rows)), shape=(n_bins, len(codes)))


def _sum(member: csr_matrix, values: Float) -> Float:
    return np.asarray(member @ values)


def _beyond(one: Predictive, half: Float, extra: float, cov: Float) -> float:
    """Expected number of stars outside of boxes of half sides (n, 2)."""
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
    """Share of the unit circle inside boxes of half sides (n, 2)."""
    a, b = np.minimum(half, 1.0).T

    def under(x: Float) -> Float:  # area under the arc from 0 to x
        return 0.5 * (x * np.sqrt(1 - x * x) + np.arcsin(x))

    corner = np.sqrt(np.maximum(1 - b * b, 0.0))  # where the box's top meets the arc
    start = np.minimum(corner, a)
    return np.asarray((start * b + under(a) - under(start)) * 4 / np.pi)
