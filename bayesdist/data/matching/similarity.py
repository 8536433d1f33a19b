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

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from bayesdist.data.matching.linear_map import LinearMap, iterated_map
from bayesdist.data.matching.pairs import chance_rate, hull_of, mean_spacing
from bayesdist.data.matching.triangles import Candidate, Level, candidates
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Complex, Float

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
    levels: tuple[Level, ...]  # increasing numbers of the brightest stars, with their triangles
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
            "positions are fewer than three, or not all finite",
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
    return PatternIndex(points, tuple(Level(stars[:n]) for n in sizes), hull_of(points)[1])


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
            "positions are fewer than three, or not all finite", where=source, do="give more stars"
        )
    if not 0.0 < scale[0] < scale[1]:
        raise InputError(
            f"scales from {scale[0]} to {scale[1]} are none", where=source, do="give a range"
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
        f"stars, where chance gives {best[1]:.1f}",
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

    The search radius shrinks from 0.3 to `narrow` mean spacings of the reference stars. If too few
    points have a pair, the similarity itself is returned.
    """
    wide, final_reach = _WIDE * reference.spacing, narrow * reference.spacing
    grown = iterated_map(points, reference.positions, reference.tree, found.map, wide, final_reach)
    return found.map if grown is None else grown


def _tries(
    n: int, ranked: bool, reference: PatternIndex, area: float
) -> Iterator[tuple[float, Level, int]]:
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
    """Clause on the scale or mirror image with which a list (N, 2) would match; empty if none."""
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
            f"{image} does match{at}: {similarity.found} stars, where chance gives "
            f"{similarity.expected:.1f}"
        )
        if best > _CLEAR_SIGMAS:
            break
    return reason
