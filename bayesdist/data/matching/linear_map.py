"""Linear maps between two lists of positions, iterated with the pairs that they bring together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

__all__ = [
    "MAX_SAMPLE",
    "MIN_PAIRS",
    "LinearMap",
    "RobustFit",
    "best_similarity",
    "iterated_map",
    "robust_fit",
]

Float = NDArray[np.float64]
Solution = TypeVar("Solution")

MAX_SAMPLE = 20_000  # detections that the iterations use
_FIRST_SAMPLE = 150  # detections of the first round
_MAX_ROUNDS = 25
MIN_PAIRS = 6  # pairs: with fewer, a linear map fits their noise
_CLIP = 3.0  # times the median distance: 3.5 sigma of a circular normal


@dataclass(frozen=True, eq=False)
class LinearMap:
    """Linear map p -> matrix (p - origin) + origin + shift.

    Parameters
    ----------
    matrix : ndarray, shape (2, 2)
    shift : ndarray, shape (2,)
    origin : ndarray, shape (2,)
    """

    matrix: Float
    shift: Float
    origin: Float

    def __call__(self, points: Float) -> Float:
        """Transformed points, shape (N, 2)."""
        return (points - self.origin) @ self.matrix.T + self.origin + self.shift


def best_similarity(points: Float, reference: Float) -> LinearMap:
    """Rotation, scale and shift by least squares of pairs (N, 2), about the mean of the points."""
    origin, there = points.mean(axis=0), reference.mean(axis=0)
    p, q = (points - origin) @ [1, 1j], (reference - there) @ [1, 1j]
    turn = np.vdot(p, q) / np.vdot(p, p).real
    matrix = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
    return LinearMap(matrix, there - origin, origin)


def iterated_map(
    points: Float, reference: Float, tree: cKDTree, start: LinearMap, reach: float, radius: float
) -> LinearMap | None:
    """Linear map fitted in rounds: pairs within `reach` at first, within `radius` at last.

    The area grows from the start's origin meanwhile: far from where the offset was found a small
    rotation displaces stars by more than their distances, so the map is fitted near that position
    first.  `tree` is of `reference` (M, 2).  None where too few pairs are left, or they lie on a
    line.
    """
    outwards = np.argsort(((points - start.origin) ** 2).sum(axis=1))
    current, size, reach = start, _FIRST_SAMPLE, max(reach, radius)
    for _ in range(_MAX_ROUNDS):
        sample = points[outwards[:size][:: -(-min(size, len(points)) // MAX_SAMPLE)]]
        distance, nearest = tree.query(current(sample), distance_upper_bound=reach, workers=-1)
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
    """A fit, the distances of all pairs from it (N,), and a mask of those near it (N,)."""

    solution: Solution
    away: Float
    use: NDArray[np.bool_]


def robust_fit(
    fit: Callable[[NDArray[np.bool_]], tuple[Solution, Float] | None],
    n: int,
    *,
    least: int,
    rounds: int = 5,
    slack: float = 0.0,
    reach: float = np.inf,
) -> RobustFit[Solution] | None:
    """A fit to N pairs, repeated without those beyond three median distances until none changes.

    `fit` gives for pairs by mask (N,) the solution and the distances (N,) of all from it, or None
    where they do not determine it.  None, too, where fewer than `least` pairs are given.  `slack`
    is the rounding error of a distance of 0; no pair beyond `reach` is used.
    """
    found, use = None, np.ones(n, bool)
    for _ in range(rounds):
        if use.sum() < least:
            break
        fitted = fit(use)
        if fitted is None:
            return None
        solution, away = fitted
        near = away <= min(_CLIP * float(np.median(away[use])) + slack, reach)
        found = RobustFit(solution, away, near)
        if (near == use).all():
            break
        use = near
    return found


def _robust_linear(p: Float, q: Float) -> tuple[Float, Float] | None:
    """Least-squares matrix and shift from p to q, with pairs far from them left out."""
    design = np.column_stack([p, np.ones(len(p))])

    def fit(use: NDArray[np.bool_]) -> tuple[Float, Float] | None:
        solution, _, rank, _ = np.linalg.lstsq(design[use], q[use], rcond=None)
        away = np.asarray(np.hypot(*(q - design @ solution).T), float)
        return (np.asarray(solution, float), away) if rank == 3 else None

    slack = 1e-12 * float(np.abs(q).max(initial=0.0))
    found = robust_fit(fit, len(p), least=MIN_PAIRS, slack=slack)
    if found is None or found.use.sum() < MIN_PAIRS:
        return None
    return np.asarray(found.solution[:2].T), np.asarray(found.solution[2])
