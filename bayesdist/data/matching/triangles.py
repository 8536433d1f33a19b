"""Triangles of neighbouring stars, and their votes for a rotation, a scale and a shift."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from bayesdist.data.matching.linear_map import robust_fit
from bayesdist.utils.arrays import Bool, Complex, Float, Int

# shortest to longest side; in flatter triangles, small errors change the shape
_MIN_SIDE_RATIO = 0.15
_MAX_SIDE_RATIO = 0.985  # ratio of two sides; more similar sides may change their order
_MAX_ANCHORS = 500  # largest number of stars of the list around which triangles are made
_NEIGHBOURS = (5, 6)  # neighbours of each star, in the list and in the reference
_MAX_CANDIDATES = 3  # number of peaks of the votes that are examined
_MAX_VOTES = 400_000  # at most


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles with corners in the order of the opposite sides, longest first."""

    corners: Int  # (T, 3), indices of stars
    shape: Float  # (T, 2), logarithms of the ratios of middle and shortest side to the longest
    log_size: Float  # (T,), logarithm of the longest side
    left: Bool  # (T,), True if anticlockwise, which a mirror reverses

    def __len__(self) -> int:
        return len(self.corners)


def triangles_of(stars: Complex, anchors: Int, neighbours: int) -> Triangles:
    """Triangles of each anchor with two of its nearest `neighbours`, for stars x + i y (N,).

    Each triangle occurs once. Nearly flat and nearly isosceles triangles are left out.
    """
    points = np.stack([stars.real, stars.imag], axis=-1)
    neighbours = min(neighbours, len(stars) - 1)
    if neighbours < 2 or not len(anchors):
        return _described(stars, np.zeros((0, 3), np.int64))
    _, near = cKDTree(points).query(points[anchors], k=neighbours + 1)
    pairs = np.array(list(combinations(range(1, neighbours + 1), 2)))
    first = np.broadcast_to(near[:, :1, None], (len(anchors), len(pairs), 1))
    corners = np.concatenate([first, near[:, pairs]], axis=2).reshape(-1, 3)
    corners = np.sort(corners.astype(np.int64), axis=1)
    n = len(stars)
    _, distinct = np.unique(
        (corners[:, 0] * n + corners[:, 1]) * n + corners[:, 2], return_index=True
    )
    return _described(stars, corners[distinct])


def _described(stars: Complex, corners: Int) -> Triangles:
    z = stars[corners]
    sides = np.abs(z[:, [1, 2, 0]] - z[:, [2, 0, 1]])  # opposite to each corner
    order = np.argsort(-sides, axis=1)
    corners = np.take_along_axis(corners, order, axis=1)
    sides = np.take_along_axis(sides, order, axis=1)
    good = (sides[:, 2] > _MIN_SIDE_RATIO * sides[:, 0]) & (
        sides[:, 1] < _MAX_SIDE_RATIO * sides[:, 0]
    )
    good &= sides[:, 2] < _MAX_SIDE_RATIO * sides[:, 1]
    corners, sides = corners[good], sides[good]
    a, b, c = stars[corners].T
    return Triangles(
        corners=corners,
        shape=np.log(sides[:, 1:] / sides[:, :1]),
        log_size=np.log(sides[:, 0]),
        left=((b - a) * np.conj(c - a)).imag < 0,
    )


@dataclass(frozen=True, eq=False)
class Level:
    """The brightest reference stars x + i y (M,) and their triangles."""

    stars: Complex

    @cached_property
    def triangles(self) -> Triangles:
        """Triangles of each star with two of its nearest neighbours."""
        return triangles_of(self.stars, np.arange(len(self.stars)), _NEIGHBOURS[1])


@dataclass(frozen=True)
class Candidate:
    """Similarity w = turn z + target that triangles have voted for."""

    turn: complex
    target: complex
    agreeing: int  # number of stars in these triangles that it brings together
    slack: float  # median distance of these stars, a measure of the error of the map


def candidates(
    stars: Complex, level: Level, tolerance: float, scale: tuple[float, float]
) -> Iterator[Candidate]:
    """Peaks of the votes from all pairs of triangles of equal shape, the best supported first.

    `stars` (N,) are positions x + i y from the middle of the list, brightest first if magnitudes
    are known. `tolerance` applies to the logarithms of side ratios.
    """
    # anchors are spread over the ranks, so that a clump of false bright detections does not
    # dominate
    anchors = np.unique(np.linspace(0, len(stars) - 1, min(_MAX_ANCHORS, len(stars))).astype(int))
    list_triangles = triangles_of(stars, anchors, _NEIGHBOURS[0])
    i, j = _alike(list_triangles, level.triangles, tolerance, scale)
    if not len(i):
        return
    z, w = stars[list_triangles.corners[i]], level.stars[level.triangles.corners[j]]
    middle_z, middle_w = z.mean(axis=1, keepdims=True), w.mean(axis=1, keepdims=True)
    dz, dw = z - middle_z, w - middle_w
    turn = (np.conj(dz) * dw).sum(axis=1) / (np.abs(dz) ** 2).sum(axis=1)
    right = (np.abs(turn) > scale[0]) & (np.abs(turn) < scale[1])
    i, j, turn = i[right], j[right], turn[right]
    if not len(i):
        return
    target = middle_w[right, 0] - turn * middle_z[right, 0]
    lever = float(np.sqrt(np.mean(np.abs(stars) ** 2)))
    votes = np.stack([target.real, target.imag, lever * turn.real, lever * turn.imag], axis=-1)
    reach = 3.0 * tolerance * lever
    near = cKDTree(votes)
    support = near.query_ball_point(votes, reach, return_length=True, workers=-1)
    for _ in range(_MAX_CANDIDATES):
        peak = int(np.argmax(support))
        if support[peak] < 2:
            return
        members = np.array(near.query_ball_point(votes[peak], 2.0 * reach))
        support[members] = 0
        pairs = np.stack(
            [
                list_triangles.corners[i[members]].ravel(),
                level.triangles.corners[j[members]].ravel(),
            ],
            axis=-1,
        )
        fitted = _fitted(stars, level.stars, np.unique(pairs, axis=0), reach)
        if fitted is not None:
            yield fitted


def _alike(
    own: Triangles, theirs: Triangles, tolerance: float, scale: tuple[float, float]
) -> tuple[Int, Int]:
    """Pairs of triangles with equal shape and handedness, and sizes within the range of scales."""
    low, high = np.log(scale[0]), np.log(scale[1])
    # sizes are in units in which their range is as wide as the tolerance
    unit = tolerance / (0.5 * (high - low) + tolerance)
    pair_lists: list[tuple[Int, Int]] = []
    for hand in (False, True):
        a, b = np.flatnonzero(own.left == hand), np.flatnonzero(theirs.left == hand)
        if not (len(a) and len(b)):
            continue
        first = np.column_stack([own.shape[a], unit * (own.log_size[a] + 0.5 * (low + high))])
        second = np.column_stack([theirs.shape[b], unit * theirs.log_size[b]])
        pairs = cKDTree(first).sparse_distance_matrix(
            cKDTree(second), tolerance * np.sqrt(2.0), output_type="ndarray"
        )
        pair_lists.append((a[pairs["i"]], b[pairs["j"]]))
    if not pair_lists:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    i, j = (np.concatenate(indices) for indices in zip(*pair_lists, strict=True))
    stride = -(-len(i) // _MAX_VOTES) or 1
    return i[::stride], j[::stride]


def _fitted(stars: Complex, others: Complex, pairs: Int, reach: float) -> Candidate | None:
    """Least-squares similarity of corresponding stars; None if fewer than three agree."""
    z, w = stars[pairs[:, 0]], others[pairs[:, 1]]

    def fit(use: Bool) -> tuple[tuple[complex, complex], Float]:
        middle_z, middle_w = z[use].mean(), w[use].mean()
        dz, dw = z[use] - middle_z, w[use] - middle_w
        turn = complex((np.conj(dz) * dw).sum() / (np.abs(dz) ** 2).sum())
        target = complex(middle_w - turn * middle_z)
        return (turn, target), np.abs(w - turn * z - target)

    slack = 1e-9 * float(np.abs(w).max(initial=0.0))
    robust = robust_fit(fit, len(z), least=3, slack=slack, reach=reach)
    if robust is None or robust.use.sum() < 3:
        return None
    agreeing = min(len(np.unique(pairs[robust.use, axis])) for axis in (0, 1))
    return Candidate(*robust.solution, agreeing, float(np.median(robust.away[robust.use])))
