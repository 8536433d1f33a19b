"""Pairs between two lists of positions that a transformation has brought together."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from bayesdist.data.matching.linear_map import MAX_SAMPLE, MIN_PAIRS
from bayesdist.utils.arrays import Bool, Float, Int

CONVINCING_PAIRS = 15  # pairs that convince although most stars have none
NARROW = 0.25  # mean distances between reference stars: reach of the last pairs of a linear map
_MAX_PROBES = 20_000  # displaced detections that sample chance matches
_DIRECTIONS = np.exp(2j * np.pi * np.arange(8) / 8)


def hull_of(points: Float) -> tuple[Float, float]:
    """Half-planes a x + b y + c <= 0 around points (N, 2) as rows (K, 3), and the area inside.

    Points without a hull have their box; the area is positive in any case.
    """
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        low, high = points.min(axis=0), points.max(axis=0)
        equations = np.array(
            [[-1, 0, low[0]], [1, 0, -high[0]], [0, -1, low[1]], [0, 1, -high[1]]], float
        )
        area = float(np.prod(high - low))
    else:
        equations, area = hull.equations, float(hull.volume)  # qhull's name for an area, too
    return equations, max(area, float(np.finfo(float).tiny))


def inside_hull(points: Float, equations: Float) -> Bool:
    """Boolean mask of the points (N, 2) inside a hull."""
    inside = np.ones(len(points), bool)
    for a, b, c in equations:
        inside &= points @ np.array([a, b]) + c <= 0
    return inside


def overlap(points: Float, reference: Float) -> tuple[int, float]:
    """Number of reference stars in the hull of the points (at least 1), and its area."""
    equations, area = hull_of(points)
    return max(int(inside_hull(reference, equations).sum()), 1), area


def mean_spacing(points: Float) -> float:
    """Distance between neighbours if the points (N, 2) were a square grid; positive."""
    extent = np.ptp(points, axis=0)
    area = float(np.prod(np.maximum(extent, extent.max() * 1e-3)))
    return float(np.sqrt(area / len(points))) or 1.0


def mutual_pairs(
    points: Float,
    reference: Float,
    radius: float | Float,
    *,
    tree: cKDTree | None = None,
    frame: Int | None = None,
    reference_frame: Int | None = None,
) -> tuple[Int, Int, Float]:
    """Indices of pairs that are each other's nearest within a radius, and their distances.

    `radius` is one, or the largest distance of the partner of each point (N,); `tree` is of
    `reference`, where it is at hand; of `frame` (N,) and `reference_frame` (M,) only points of
    equal number are paired.  No index is repeated.
    """
    reach = float(np.max(radius))
    if frame is not None and reference_frame is not None:
        # frames lie on top of each other, out of each other's reach
        points = np.column_stack([points, 2.0 * reach * frame])
        reference = np.column_stack([reference, 2.0 * reach * reference_frame])
    tree = cKDTree(reference) if tree is None else tree
    distance, forth = tree.query(points, distance_upper_bound=reach, workers=-1)
    found = np.flatnonzero(forth < len(reference))
    partners = forth[found]
    asked = np.unique(partners)
    _, back = cKDTree(points).query(reference[asked], distance_upper_bound=reach, workers=-1)
    own = np.full(len(reference), -1, np.int64)
    own[asked] = back
    mutual = found[own[partners] == found]
    if np.ndim(radius):
        mutual = mutual[distance[mutual] <= np.asarray(radius)[mutual]]
    return mutual, forth[mutual].astype(np.int64), distance[mutual]


def chance_radius(rate: float, n: int, area: float) -> float:
    """Radius in which one of n stars, even over an area, is found by chance with a probability."""
    return float(np.sqrt(-np.log1p(-rate) * area / (np.pi * n)))


def chance_rate(points: Float, tree: cKDTree, radius: float | Float, step: float) -> float:
    """Fraction of points (N, 2) that find a neighbour where none belongs: when all are displaced.

    Unlike a formula with a mean density this takes account of gradients and clusters.  `radius`,
    one or (N,), is the largest distance of a neighbour, `step` the displacement in eight
    directions: so large that true pairs are out of reach.
    """
    every = -(-len(points) * len(_DIRECTIONS) // _MAX_PROBES)
    sample = points[::every]
    reach = np.broadcast_to(radius, len(points))[::every]
    found = 0
    for direction in _DIRECTIONS:
        moved = sample + step * np.array([direction.real, direction.imag])
        distance, _ = tree.query(moved, distance_upper_bound=float(reach.max()))
        found += int((distance <= reach).sum())
    return found / (len(sample) * len(_DIRECTIONS))


def are_enough(n: int, n_points: int, n_reference: int) -> bool:
    """True if n pairs convince, of so many points and of the reference stars among them.

    These are `MIN_PAIRS`, and half of the smaller set or `CONVINCING_PAIRS`.
    """
    return n >= MIN_PAIRS and n >= min(CONVINCING_PAIRS, 0.5 * min(n_points, n_reference))


def beats_chance(points: Float, reference: Float, tree: cKDTree, distance: Float) -> bool:
    """True where there are true pairs: displaced detections find far fewer neighbours.

    Two dense clusters laid over each other give many pairs, but as many when one is moved a little.
    `distance` is that of the pairs that were found, `tree` that of the reference positions.
    """
    reach = max(float(np.median(distance)), 1e-9 * float(np.abs(reference).max()))
    sample = points[:: -(-len(points) // MAX_SAMPLE)]

    def neighbours(shift: complex) -> int:
        moved = sample + np.array([shift.real, shift.imag])
        found = tree.query(moved, distance_upper_bound=reach * (1 + 1e-9))[0]
        return int(np.isfinite(found).sum())

    here = neighbours(0j)
    there = float(np.mean([neighbours(4.0 * reach * d) for d in _DIRECTIONS]))
    return here > 2.0 * there and here - there > 5.0 * np.sqrt(there)
