"""Similarity between two lists of stars, found from the shapes of triangles without a start value.

Triangles of neighbouring bright stars are looked up in a k-d tree of the triangles of the reference
list. Every two triangles of equal shape vote for a rotation, scale and shift. Votes of true pairs
agree, while those of chance pairs are scattered over the parameter space. The best candidate is
accepted if it brings far more stars together than a displaced list does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from bayesdist.data.matching.pairs import (
    LinearMap,
    chance_rate,
    hull_of,
    iterated_map,
    mean_spacing,
)
from bayesdist.data.robust import robust_fit
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Bool, Complex, Float, Int

_MIN_STARS_TRIED = 60  # smallest number of stars in a trial
# reference stars in the first level; each further level has three times as many
_STARS_OF_FIRST_LEVEL = 400
_LEVEL_FACTOR = 3
# tolerances of the logarithms of side ratios, which allow for residual distortion
_TOLERANCES = (0.004, 0.012)
# stars of the list, relative to the number expected from the mean density
_DEPTHS = (1.0, 0.5, 2.0)
_WIDE = 0.3  # mean spacings of reference stars; search radius of the first pairs
_BRIGHT_STARS = 2000  # stars in the first linear map
_STARS_CHECKED = 1000  # largest number of stars with which a candidate is checked
_CHANCE_SIGMAS = 8.0  # standard deviations by which its coincidences must exceed those by chance
_MIN_AGREEING = 6  # smallest number of stars that must agree
# ratios of arcsec, mas, degrees and pixels of 0.05 arcsec
_RATIOS = (20.0, 50.0, 1000.0, 3600.0, 72_000.0, 3.6e6)
_RATIO_TOLERANCE = 1.1  # relative tolerance of such a ratio, because pixel sizes differ
_WIDE_SCALE = 1.4  # relative tolerance for a scale that is poorly known
_SCALE_TOLERANCE = 0.03  # relative tolerance of the scale that the matching allows
# largest number of stars with a neighbour per star with agreeing triangles
_STARS_FOR_EACH_AGREEING = 5.0
_CLEAR_SIGMAS = 16.0  # standard deviations; half of this may occur by chance in many trials
MIRRORED = "its mirror image"
# shortest to longest side; in flatter triangles, small errors change the shape
_MIN_SIDE_RATIO = 0.15
_MAX_SIDE_RATIO = 0.985  # ratio of two sides; more similar sides may change their order
_MAX_ANCHORS = 500  # largest number of stars of the list around which triangles are made
_NEIGHBOURS = (5, 6)  # neighbours of each star, in the list and in the reference
_MAX_CANDIDATES = 3  # number of peaks of the votes that are examined
_MAX_VOTES = 400_000  # largest number of votes


@dataclass(frozen=True, eq=False)
class Similarity:
    """Rotation, scale and shift from one list to another.

    w = scale exp(i rotation) (z or its mirror image - origin) + target,    z = x + i y
    """

    rotation: float  # degrees anticlockwise, in [0, 360)
    scale: float
    mirrored: bool  # True if the y axis is reversed first
    origin: Float  # (2,), a point in the middle of the list
    target: Float  # (2,), position of the origin in the other list
    coincidences: int  # stars with agreeing triangles
    found: int  # bright stars with a neighbour after the transformation
    expected: float  # expected number of such stars by chance

    @property
    def map(self) -> LinearMap:
        """Equivalent linear map."""
        a = np.radians(self.rotation)
        matrix = self.scale * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        if self.mirrored:
            matrix = matrix @ np.diag([1.0, -1.0])
        return LinearMap(matrix, self.target - self.origin, self.origin)

    def __call__(self, points: Float) -> Float:
        """Transformed points, shape (N, 2)."""
        return self.map(points)


@dataclass(frozen=True, eq=False)
class PatternIndex:
    """Reference list (M, 2) prepared for repeated searches; made by `pattern_index`."""

    positions: Float
    # increasing numbers of the brightest stars, with their triangles
    levels: tuple[StarTriangles, ...]
    area: float  # area of the hull of all positions

    @cached_property
    def tree(self) -> cKDTree:
        """k-d tree of the positions."""
        return cKDTree(self.positions)

    @cached_property
    def spacing(self) -> float:
        """Mean spacing of neighbours."""
        return mean_spacing(self.positions)


def pattern_index(positions: ArrayLike, mag: ArrayLike | None = None) -> PatternIndex:
    """Prepare a reference list for `find_similarity`.

    Parameters
    ----------
    positions : array_like, shape (M, 2)
        Positions of the reference stars.
    mag : array_like, shape (M,), optional
        Magnitudes. Without them all stars are used at once.

    Returns
    -------
    PatternIndex
        Prepared reference list.

    Raises
    ------
    InputError
        If there are fewer than three stars, or if positions are not finite.
    """
    points = np.ascontiguousarray(positions, np.float64)
    if len(points) < 3 or not np.isfinite(points).all():
        raise InputError(
            "there are fewer than three positions, or some are not finite",
            where="reference list",
            do="give more stars",
        )
    stars = points[:, 0] + 1j * points[:, 1]
    sizes = [len(points)]
    if mag is not None:
        stars = stars[np.argsort(np.asarray(mag, float), kind="stable")]
        sizes = []
        size = _STARS_OF_FIRST_LEVEL
        while size < len(points):
            sizes.append(size)
            size *= _LEVEL_FACTOR
        sizes.append(len(points))
    return PatternIndex(points, tuple(StarTriangles(stars[:n]) for n in sizes), hull_of(points)[1])


def find_similarity(
    points: ArrayLike,
    reference: PatternIndex,
    *,
    mag: ArrayLike | None = None,
    scale: tuple[float, float] = (0.97, 1.03),
    mirrored: bool = False,
    source: str = "detections",
    reference_name: str = "reference list",
) -> Similarity:
    """Find the similarity that maps a list of stars onto a reference list.

    Parameters
    ----------
    points : array_like, shape (N, 2)
        Positions. Residual distortion may displace them by several pixels, as long as it changes
        local scales by less than about one per cent.
    reference : PatternIndex
        Prepared reference list.
    mag : array_like, shape (N,), optional
        Magnitudes with any zero point. With them, bright stars are tried first.
    scale : tuple of float, optional
        Smallest and largest scale.
    mirrored : bool, optional
        True to search for the mirror image.
    source, reference_name : str, optional
        Names of the two lists, for the error message.

    Returns
    -------
    Similarity
        First candidate that is convincing.

    Raises
    ------
    InputError
        If no similarity brings together more stars than chance does; the message gives the best
        number of coincidences.
    """
    xy = np.ascontiguousarray(points, np.float64)
    if len(xy) < 3 or not np.isfinite(xy).all():
        raise InputError(
            "there are fewer than three positions, or some are not finite",
            where=source,
            do="give more stars",
        )
    if not 0.0 < scale[0] < scale[1]:
        raise InputError(
            f"scales from {scale[0]} to {scale[1]} are not a range", where=source, do="give a range"
        )
    order = np.arange(len(xy))
    if mag is not None:
        order = np.argsort(np.asarray(mag, float), kind="stable")
    origin = 0.5 * (xy.min(axis=0) + xy.max(axis=0))
    ranked = (xy - origin)[order]
    stars = ranked[:, 0] + 1j * ranked[:, 1]
    if mirrored:
        stars = np.conj(stars)
    area = hull_of(xy)[1] * scale[0] * scale[1]
    best = (0, 0.0)  # coincidences of the best candidate, and those by chance
    for tolerance, level, size in _tries(len(stars), mag is not None, reference, area):
        bright = stars[:size]
        for candidate in candidates(bright, level, tolerance, scale):
            n_found, expected = _support(candidate, bright, reference)
            best = max(best, (n_found, expected))
            if (
                candidate.agreeing >= _MIN_AGREEING
                and n_found - expected > _CHANCE_SIGMAS * np.sqrt(expected)
                and n_found > 2.0 * expected
                and n_found >= _MIN_AGREEING
            ):
                return Similarity(
                    rotation=float(np.degrees(np.angle(candidate.turn)) % 360.0),
                    scale=float(abs(candidate.turn)),
                    mirrored=mirrored,
                    origin=origin,
                    target=np.array([candidate.target.real, candidate.target.imag]),
                    coincidences=candidate.agreeing,
                    found=n_found,
                    expected=expected,
                )
    raise InputError(
        f"does not match {reference_name}: the best rotation and shift bring together {best[0]} "
        f"stars, while chance gives {best[1]:.1f}",
        where=source,
        do="check the field, the scale, the parity and the distortion that is taken as known",
    )


def brightest(points: Float, mag: Float | None) -> Float:
    """Points (n, 2) sufficient for a linear map: the brightest, or the first without magnitudes."""
    return (points if mag is None else points[np.argsort(mag, kind="stable")])[:_BRIGHT_STARS]


def grown_map(
    points: Float, found: Similarity, reference: PatternIndex, *, narrow: float
) -> LinearMap:
    """Linear map of points (N, 2), fitted outwards from the middle, where a similarity is accurate.

    The search radius shrinks from 0.3 to `narrow` mean spacings of the reference stars.  If too few
    points have a pair, the similarity `found` itself is returned.
    """
    wide, final_reach = _WIDE * reference.spacing, narrow * reference.spacing
    grown = iterated_map(points, reference.positions, reference.tree, found.map, wide, final_reach)
    return found.map if grown is None else grown


def _tries(
    n: int, ranked: bool, reference: PatternIndex, area: float
) -> Iterator[tuple[float, StarTriangles, int]]:
    """Tolerance, reference level and number of stars for each trial, the most promising first."""
    for tolerance in _TOLERANCES:
        for level in reference.levels:
            even = len(level.stars) * area / reference.area
            last = level is reference.levels[-1]
            if even < _MIN_STARS_TRIED and not last:
                continue
            if not ranked:
                if last:
                    yield tolerance, level, n
                continue
            sizes = [int(np.clip(even * depth, min(_MIN_STARS_TRIED, n), n)) for depth in _DEPTHS]
            for size in dict.fromkeys(sizes):
                yield tolerance, level, size


def _support(candidate: Candidate, stars: Complex, reference: PatternIndex) -> tuple[int, float]:
    """Number of stars with a reference star nearby, and the number expected by chance."""
    sample = stars[:: -(-len(stars) // _STARS_CHECKED)]
    moved = candidate.turn * sample + candidate.target
    points = np.stack([moved.real, moved.imag], axis=-1)
    reach = float(np.clip(3.0 * candidate.slack, 0.02 * reference.spacing, 0.2 * reference.spacing))
    distance, _ = reference.tree.query(points, distance_upper_bound=reach)
    expected = len(sample) * chance_rate(points, reference.tree, reach, 4.0 * reach)
    return int(np.isfinite(distance).sum()), max(expected, 0.5)


def mismatch_reason(plane: Float, mag: Float | None, reference: PatternIndex) -> str:
    """Clause on the scale or mirror image with which a list does match; empty if there is none.

    `plane` (N, 2) are the positions on the tangent plane, and `mag` (N,) the magnitudes, if known.
    """
    ratios = [factor for unit_ratio in _RATIOS for factor in (unit_ratio, 1.0 / unit_ratio)]
    tries = [
        (1.0, _WIDE_SCALE, False),
        *((unit_ratio, _RATIO_TOLERANCE, False) for unit_ratio in ratios),
        (1.0, _WIDE_SCALE, True),
    ]
    best, reason = 0.0, ""
    # a wrong unit is found or excluded quickly, but a mirror image is not, so it comes last
    for ratio, within, mirrored in tries:
        try:
            similarity = find_similarity(
                ratio * plane,
                reference,
                mag=mag,
                scale=(1.0 / within, within),
                mirrored=mirrored,
            )
        except InputError:
            continue
        # if shrunk onto a crowded region, any list finds neighbours, but few of its triangles agree
        if _STARS_FOR_EACH_AGREEING * similarity.coincidences < similarity.found:
            continue
        scale = ratio * similarity.scale
        as_it_is = abs(scale - 1.0) < _SCALE_TOLERANCE
        if as_it_is and not mirrored:  # neither scale nor parity is wrong
            continue
        sigmas = (similarity.found - similarity.expected) / np.sqrt(similarity.expected)
        if sigmas <= best:
            continue
        image = MIRRORED if mirrored else "it"
        at = "" if as_it_is else f" at {scale:.4g} times the scale"
        best = sigmas
        reason = (
            f"{image} does match{at}: {similarity.found} stars, while chance gives "
            f"{similarity.expected:.1f}"
        )
        if best > _CLEAR_SIGMAS:
            break
    return reason


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
    """Triangles of stars x + i y (N,): each anchor with two of its nearest `neighbours`.

    `anchors` are indices of stars.  Each triangle occurs once.  Nearly flat and nearly isosceles
    triangles are left out.
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
class StarTriangles:
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
    stars: Complex, level: StarTriangles, tolerance: float, scale: tuple[float, float]
) -> Iterator[Candidate]:
    """Yield peaks of the votes of all pairs of similar triangles, the best supported first.

    `stars` (N,) are positions x + i y from the middle of the list, brightest first if magnitudes
    are known. `level` has the reference stars and their triangles. `tolerance` applies to the
    logarithms of side ratios, and `scale` is the range of allowed scales.
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
