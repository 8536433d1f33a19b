"""Pairs between two lists of positions, and the maps between the lists that are fitted to them.

Pairs are mutual nearest neighbours after a transformation. A linear map is iterated: it is fitted
to the pairs that the previous one brings together. Distortion that is not known in advance is
fitted by a cubic per chip, which is used for the matching only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.spatial import ConvexHull, QhullError, cKDTree

from bayesdist.data.robust import robust_fit
from bayesdist.utils.arrays import Bool, Float, Int

CONVINCING_PAIRS = 15  # number of pairs that is convincing even if most stars have none
NARROW = 0.25  # mean spacings of reference stars; final search radius of a linear map
_MAX_PROBES = 20_000  # largest number of displaced detections that sample chance matches
_DIRECTIONS = np.exp(2j * np.pi * np.arange(8) / 8)
MAX_SAMPLE = 20_000  # largest number of detections used in an iteration
_FIRST_SAMPLE = 150  # detections in the first round
_MAX_ROUNDS = 25
MIN_PAIRS = 6  # with fewer pairs, a linear map fits their noise
_ORDER = 3
_POWERS = [(i, j) for i in range(_ORDER + 1) for j in range(_ORDER + 1 - i)]
_MIN_PAIRS_ON_CHIP = 20 * len(_POWERS)  # with fewer pairs on a chip, a cubic fits their noise
_MAX_PAIRS_FITTED = 4000  # largest number of pairs in a fit; more pairs hardly reduce the noise


def hull_of(points: Float) -> tuple[Float, float]:
    """Convex hull of points (N, 2): half-planes a x + b y + c <= 0 as rows (K, 3), and its area.

    Points without a convex hull get their bounding box.  The area is always positive.
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
    """Boolean mask (N,) that is True for points (N, 2) inside a hull.

    A row (a, b, c) of `equations` (n, 3) states that a x + b y + c <= 0 inside.
    """
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
    number or (N,), is the largest distance of a neighbour. `tree` is the k-d tree of the possible
    neighbours. `step` is the displacement in eight directions, which must be large enough to
    exclude true pairs.
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
    """True if n pairs of stars are convincing.

    `n_points` is the number of points, and `n_reference` that of the reference stars among them.
    At least `MIN_PAIRS` are needed, and either half of the smaller set or `CONVINCING_PAIRS`.
    """
    return n >= MIN_PAIRS and n >= min(CONVINCING_PAIRS, 0.5 * min(n_points, n_reference))


def beats_chance(points: Float, reference: Float, tree: cKDTree, distance: Float) -> bool:
    """True if there are true pairs, that is, if displaced detections find far fewer neighbours.

    Two dense clusters on top of each other give many pairs, but equally many after a small
    displacement.  `distance` (n,) has the distances of the pairs, and `tree` is the k-d tree of the
    reference positions.
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


@dataclass(frozen=True, eq=False)
class LinearMap:
    """Linear map p -> matrix (p - origin) + origin + shift.

    Parameters
    ----------
    matrix : ndarray, shape (2, 2)
        Matrix of the map.
    shift : ndarray, shape (2,)
        Displacement of the origin.
    origin : ndarray, shape (2,)
        Point about which the matrix is applied.
    """

    matrix: Float
    shift: Float
    origin: Float

    def __call__(self, points: Float) -> Float:
        """Transformed points, shape (N, 2)."""
        return (points - self.origin) @ self.matrix.T + self.origin + self.shift


def best_similarity(points: Float, reference: Float) -> LinearMap:
    """Least-squares rotation, scale and shift from `points` (N, 2) to `reference` (N, 2).

    The map is about the mean of the points.
    """
    origin, reference_mean = points.mean(axis=0), reference.mean(axis=0)
    p, q = (points - origin) @ [1, 1j], (reference - reference_mean) @ [1, 1j]
    turn = np.vdot(p, q) / np.vdot(p, p).real
    matrix = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
    return LinearMap(matrix, reference_mean - origin, origin)


def iterated_map(
    points: Float, reference: Float, tree: cKDTree, start: LinearMap, reach: float, radius: float
) -> LinearMap | None:
    """Linear map from points (N, 2) to their counterparts in `reference` (M, 2), by iteration.

    Pairs are within `reach` at first and within `radius` at last.  In each round the area grows
    outwards from the origin of `start`: far from the position at which the offset was found, a
    small rotation displaces stars by more than their spacing.  `tree` is the k-d tree of
    `reference`.  The result is None if there are too few pairs, or if they are on a line.
    """
    outwards = np.argsort(((points - start.origin) ** 2).sum(axis=1))
    current, size, reach = start, _FIRST_SAMPLE, max(reach, radius)
    for _ in range(_MAX_ROUNDS):
        sample = points[outwards[:size][:: -(-min(size, len(points)) // MAX_SAMPLE)]]
        distance, nearest = tree.query(current(sample), distance_upper_bound=reach)
        near = np.isfinite(distance)
        origin = start.origin
        fitted = _robust_linear(sample[near] - origin, reference[nearest[near]] - origin)
        if fitted is None:
            return None
        current = LinearMap(*fitted, origin)
        if reach <= radius and size >= len(points):
            break
        reach, size = max(radius, 0.6 * reach), 3 * size
    return current


def _robust_linear(p: Float, q: Float) -> tuple[Float, Float] | None:
    """Least-squares matrix and shift from p to q, without outliers."""
    design = np.column_stack([p, np.ones(len(p))])

    def fit(use: Bool) -> tuple[Float, Float] | None:
        solution, _, rank, _ = np.linalg.lstsq(design[use], q[use], rcond=None)
        away = np.asarray(np.hypot(*(q - design @ solution).T), float)
        return (np.asarray(solution, float), away) if rank == 3 else None

    slack = 1e-12 * float(np.abs(q).max(initial=0.0))
    robust = robust_fit(fit, len(p), least=MIN_PAIRS, slack=slack)
    if robust is None or robust.use.sum() < MIN_PAIRS:
        return None
    return np.asarray(robust.solution[:2].T), np.asarray(robust.solution[2])


@dataclass(frozen=True, eq=False)
class SmoothMap:
    """Displacement as a function of chip and position; zero for chips with too few pairs."""

    low: Float  # (2,), smallest coordinates
    high: Float  # (2,), largest coordinates
    coefficients: dict[int, Float]  # (10, 2) per chip, of products of Legendre polynomials

    def __call__(self, points: Float, chip: Int) -> Float:
        """Displacements (N, 2) at points (N, 2)."""
        out = np.zeros_like(points)
        for number, values in self.coefficients.items():
            on_chip = chip == number
            out[on_chip] = _terms(points[on_chip], self.low, self.high) @ values
        return out


def smooth_map(points: Float, chip: Int, residual: Float, index: Int) -> SmoothMap:
    """Cubics through the residuals of pairs, chip by chip, without outliers.

    `points` (N, 2) and `chip` (N,) are those of all detections. `residual` (n, 2) are the
    displacements needed by the detections with indices `index` (n,).
    """
    low, high = points.min(axis=0), points.max(axis=0)
    coefficients: dict[int, Float] = {}
    for number in np.unique(chip).tolist():
        rows = np.flatnonzero(chip[index] == number)
        if len(rows) < _MIN_PAIRS_ON_CHIP:
            continue
        rows = rows[:: -(-len(rows) // _MAX_PAIRS_FITTED)]
        fit = partial(_cubic, _terms(points[index[rows]], low, high), residual[rows])
        robust = robust_fit(fit, len(rows), least=_MIN_PAIRS_ON_CHIP, rounds=6)
        if robust is not None:
            coefficients[number] = robust.solution
    return SmoothMap(low, high, coefficients)


def _cubic(design: Float, wanted: Float, use: Bool) -> tuple[Float, Float]:
    """Least-squares coefficients, and distances of all pairs from the fit."""
    # with Legendre polynomials, the normal equations are well conditioned
    normal, right = design[use].T @ design[use], design[use].T @ wanted[use]
    values = np.linalg.pinv(normal, hermitian=True) @ right
    return values, np.hypot(*(wanted - design @ values).T)


def _terms(points: Float, low: Float, high: Float) -> Float:
    """Products of Legendre polynomials up to the third total order."""
    t = 2.0 * (points - low) / np.maximum(high - low, np.finfo(float).tiny) - 1.0
    a, b = legvander(t[:, 0], _ORDER), legvander(t[:, 1], _ORDER)
    return np.stack([a[:, i] * b[:, j] for i, j in _POWERS], axis=-1)
