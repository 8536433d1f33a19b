"""Pairs between two lists of positions after a transformation."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from bayesdist.data.matching.linear_map import MAX_SAMPLE, MIN_PAIRS
from bayesdist.utils.arrays import Bool, Float, Int

CONVINCING_PAIRS = 15  # number of pairs that is convincing even if most stars have none
NARROW = 0.25  # mean spacings of reference stars; final search radius of a linear map
_MAX_PROBES = 20_000  # largest number of displaced detections that sample chance matches
_DIRECTIONS = np.exp(2j * np.pi * np.arange(8) / 8)


def hull_of(points: Float) -> tuple[Float, float]:
    """Half-planes a x + b y + c <= 0 around points (N, 2) as rows (K, 3), and the enclosed area.

    Points without a convex hull get their bounding box. The area is always positive.
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
        # in two dimensions, qhull's volume is the area
        equations, area = (hull.equations, float(hull.volume))
    return equations, max(area, float(np.finfo(float).tiny))


def inside_hull(points: Float, equations: Float) -> Bool:
    """Boolean mask of the points (N, 2) inside a hull."""
    inside = np.ones(len(points), bool)
    for a, b, c in equations:
        inside &= points @ np.array([a, b]) + c <= 0
    return inside


def overlap(points: Float, reference: Float) -> tuple[int, float]:
    """Number of reference stars in the hull of the points (at least 1), and the hull area."""
    equations, area = hull_of(points)
    return max(int(inside_hull(reference, equations).sum()), 1), area


def mean_spacing(points: Float) -> float:
    """Spacing of neighbours if the points (N, 2) were a square grid; positive."""
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
    """Indices of pairs of mutual nearest neighbours within a radius, and their distances.

    `radius` is one number, or the largest distance for each point (N,). `tree` is the k-d tree of
    `reference`, if it exists already. With `frame` (N,) and `reference_frame` (M,), only points
    with equal numbers are paired. No index is repeated.
    """
    reach = float(np.max(radius))
    if frame is not None and reference_frame is not None:
        # separate the frames along a third axis by more than the radius
        points = np.column_stack([points, 2.0 * reach * frame])
        reference = np.column_stack([reference, 2.0 * reach * reference_frame])
    tree = cKDTree(reference) if tree is None else tree
    distance, forth = tree.query(points, distance_upper_bound=reach, workers=-1)
    with_neighbour = np.flatnonzero(forth < len(reference))
    partners = forth[with_neighbour]
    asked = np.unique(partners)
    _, back = cKDTree(points).query(reference[asked], distance_upper_bound=reach, workers=-1)
    nearest_point = np.full(len(reference), -1, np.int64)
    nearest_point[asked] = back
    mutual = with_neighbour[nearest_point[partners] == with_neighbour]
    if np.ndim(radius):
        mutual = mutual[distance[mutual] <= np.asarray(radius)[mutual]]
    return mutual, forth[mutual].astype(np.int64), distance[mutual]


def chance_radius(rate: float, n: int, area: float) -> float:
    """Radius within which a detection finds one of n stars by chance with probability `rate`.

    The n stars are assumed to be uniformly distributed over `area`.
    """
    return float(np.sqrt(-np.log1p(-rate) * area / (np.pi * n)))


def chance_rate(points: Float, tree: cKDTree, radius: float | Float, step: float) -> float:
    """Fraction of points (N, 2) that find a neighbour by chance, measured by displacing them.

    Unlike a formula with a mean density, this accounts for gradients and clusters. `radius`, one
    number or (N,), is the largest distance of a neighbour. `step` is the displacement in eight
    directions, which must be large enough to exclude true pairs.
    """
    stride = -(-len(points) * len(_DIRECTIONS) // _MAX_PROBES)
    sample = points[::stride]
    reach = np.broadcast_to(radius, len(points))[::stride]
    n_found = 0
    for direction in _DIRECTIONS:
        moved = sample + step * np.array([direction.real, direction.imag])
        distance, _ = tree.query(moved, distance_upper_bound=float(reach.max()))
        n_found += int((distance <= reach).sum())
    return n_found / (len(sample) * len(_DIRECTIONS))


def are_enough(n: int, n_points: int, n_reference: int) -> bool:
    """True if n pairs are convincing for `n_points` points and the reference stars among them.

    At least `MIN_PAIRS` are needed, and either half of the smaller set or `CONVINCING_PAIRS`.
    """
    return n >= MIN_PAIRS and n >= min(CONVINCING_PAIRS, 0.5 * min(n_points, n_reference))


def beats_chance(points: Float, reference: Float, tree: cKDTree, distance: Float) -> bool:
    """True if there are true pairs: displaced detections find far fewer neighbours.

    Two dense clusters on top of each other give many pairs, but equally many after a small
    displacement. `distance` are the distances of the pairs, `tree` is the k-d tree of the reference
    positions.
    """
    reach = max(float(np.median(distance)), 1e-9 * float(np.abs(reference).max()))
    sample = points[:: -(-len(points) // MAX_SAMPLE)]

    def neighbours(shift: complex) -> int:
        moved = sample + np.array([shift.real, shift.imag])
        distances = tree.query(moved, distance_upper_bound=reach * (1 + 1e-9))[0]
        return int(np.isfinite(distances).sum())

    n_undisplaced = neighbours(0j)
    n_displaced = float(np.mean([neighbours(4.0 * reach * d) for d in _DIRECTIONS]))
    return n_undisplaced > 2.0 * n_displaced and n_undisplaced - n_displaced > 5.0 * np.sqrt(
        n_displaced
    )
