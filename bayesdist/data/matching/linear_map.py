"""Maps between two lists of positions, fitted to pairs that the maps bring together.

Linear maps are iterated. Distortion that is not known in advance is fitted by a cubic per chip,
which is used for the matching only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.spatial import cKDTree

from bayesdist.utils.arrays import Bool, Float, Int

Solution = TypeVar("Solution")
MAX_SAMPLE = 20_000  # largest number of detections used in an iteration
_FIRST_SAMPLE = 150  # detections in the first round
_MAX_ROUNDS = 25
MIN_PAIRS = 6  # with fewer pairs, a linear map fits their noise
_CLIP = 3.0  # median distances; 3.5 sigma of a circular normal distribution
_ORDER = 3
_POWERS = [(i, j) for i in range(_ORDER + 1) for j in range(_ORDER + 1 - i)]
_MIN_PAIRS_ON_CHIP = 20 * len(_POWERS)  # with fewer pairs on a chip, a cubic fits their noise
_MAX_PAIRS_FITTED = 4000  # largest number of pairs in a fit; more pairs hardly reduce the noise


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
    """Least-squares rotation, scale and shift from pairs (N, 2), about the mean of the points."""
    origin, reference_mean = points.mean(axis=0), reference.mean(axis=0)
    p, q = (points - origin) @ [1, 1j], (reference - reference_mean) @ [1, 1j]
    turn = np.vdot(p, q) / np.vdot(p, p).real
    matrix = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
    return LinearMap(matrix, reference_mean - origin, origin)


def iterated_map(
    points: Float, reference: Float, tree: cKDTree, start: LinearMap, reach: float, radius: float
) -> LinearMap | None:
    """Linear map fitted in rounds, with pairs within `reach` at first and within `radius` at last.

    In each round the area grows outwards from the origin of `start`. Far from the position at which
    the offset was found, a small rotation displaces stars by more than their spacing, so the map is
    first fitted near that position. `tree` is the k-d tree of `reference` (M, 2). None if there are
    too few pairs, or if they are on a line.
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


class RobustFit(NamedTuple, Generic[Solution]):
    """A fit, the distances (N,) of all pairs from it, and a mask (N,) of the pairs near it."""

    solution: Solution
    away: Float
    use: Bool


def robust_fit(
    fit: Callable[[Bool], tuple[Solution, Float] | None],
    n: int,
    *,
    least: int,
    rounds: int = 5,
    slack: float = 0.0,
    reach: float = np.inf,
) -> RobustFit[Solution] | None:
    """Fit N pairs repeatedly, without those beyond three median distances, until none changes.

    `fit` takes a mask (N,) of pairs and returns the solution and the distances (N,) of all pairs
    from it, or None if the pairs do not determine it. The result is None if that happens or if
    there are fewer than `least` pairs. `slack` is the rounding error of a distance of zero; pairs
    beyond `reach` are not used.
    """
    robust, use = None, np.ones(n, bool)
    for _ in range(rounds):
        if use.sum() < least:
            break
        fitted = fit(use)
        if fitted is None:
            return None
        solution, away = fitted
        near = away <= min(_CLIP * float(np.median(away[use])) + slack, reach)
        robust = RobustFit(solution, away, near)
        if (near == use).all():
            break
        use = near
    return robust


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
