"""Maps between two lists of positions, fitted to the pairs that they bring together.

Linear ones are iterated; what a known distortion leaves is a cubic of each chip, for the matching
alone.
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
MAX_SAMPLE = 20_000  # detections that the iterations use
_FIRST_SAMPLE = 150  # detections of the first round
_MAX_ROUNDS = 25
MIN_PAIRS = 6  # pairs: with fewer, a linear map fits their noise
_CLIP = 3.0  # times the median distance: 3.5 sigma of a circular normal
_ORDER = 3
_POWERS = [(i, j) for i in range(_ORDER + 1) for j in range(_ORDER + 1 - i)]
_MIN_PAIRS_ON_CHIP = 20 * len(_POWERS)  # pairs of a chip; with fewer, their noise is fitted
_MAX_PAIRS_FITTED = 4000  # pairs in a fit: with more, their noise does not matter any more


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
    """A fit, the distances of all pairs from it (N,), and a mask of those near it (N,)."""

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

    def fit(use: Bool) -> tuple[Float, Float] | None:
        solution, _, rank, _ = np.linalg.lstsq(design[use], q[use], rcond=None)
        away = np.asarray(np.hypot(*(q - design @ solution).T), float)
        return (np.asarray(solution, float), away) if rank == 3 else None

    slack = 1e-12 * float(np.abs(q).max(initial=0.0))
    found = robust_fit(fit, len(p), least=MIN_PAIRS, slack=slack)
    if found is None or found.use.sum() < MIN_PAIRS:
        return None
    return np.asarray(found.solution[:2].T), np.asarray(found.solution[2])


@dataclass(frozen=True, eq=False)
class SmoothMap:
    """Displacement by chip and position; none for chips with too few pairs."""

    low: Float  # (2,), smallest position
    high: Float  # (2,), largest position
    coefficients: dict[int, Float]  # (10, 2) of each chip, of products of Legendre polynomials

    def __call__(self, points: Float, chip: Int) -> Float:
        """Displacements (N, 2) at points (N, 2)."""
        out = np.zeros_like(points)
        for number, values in self.coefficients.items():
            here = chip == number
            out[here] = _terms(points[here], self.low, self.high) @ values
        return out


def smooth_map(points: Float, chip: Int, residual: Float, index: Int) -> SmoothMap:
    """Cubics through the residuals of pairs, chip by chip, without those far off.

    `points` (N, 2) and `chip` (N,) are of all detections, `residual` (n, 2) is what must be added
    to those of `index` (n,).
    """
    low, high = points.min(axis=0), points.max(axis=0)
    coefficients: dict[int, Float] = {}
    for number in np.unique(chip).tolist():
        here = np.flatnonzero(chip[index] == number)
        if len(here) < _MIN_PAIRS_ON_CHIP:
            continue
        here = here[:: -(-len(here) // _MAX_PAIRS_FITTED)]
        fit = partial(_cubic, _terms(points[index[here]], low, high), residual[here])
        found = robust_fit(fit, len(here), least=_MIN_PAIRS_ON_CHIP, rounds=6)
        if found is not None:
            coefficients[number] = found.solution
    return SmoothMap(low, high, coefficients)


def _cubic(design: Float, wanted: Float, use: Bool) -> tuple[Float, Float]:
    """Coefficients by least squares, and distances of all pairs from them."""
    # Legendre polynomials leave normal equations well conditioned
    normal, right = design[use].T @ design[use], design[use].T @ wanted[use]
    values = np.linalg.pinv(normal, hermitian=True) @ right
    return values, np.hypot(*(wanted - design @ values).T)


def _terms(points: Float, low: Float, high: Float) -> Float:
    """Products of Legendre polynomials up to the third order in all."""
    t = 2.0 * (points - low) / np.maximum(high - low, np.finfo(float).tiny) - 1.0
    a, b = legvander(t[:, 0], _ORDER), legvander(t[:, 1], _ORDER)
    return np.stack([a[:, i] * b[:, j] for i, j in _POWERS], axis=-1)
