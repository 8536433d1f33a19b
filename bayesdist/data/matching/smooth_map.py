"""Remainder of a known distortion as a cubic of each chip, for the matching alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray

from bayesdist.data.matching.linear_map import robust_fit

__all__ = ["SmoothMap", "smooth_map"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

_ORDER = 3
_POWERS = [(i, j) for i in range(_ORDER + 1) for j in range(_ORDER + 1 - i)]
_MIN_PAIRS_ON_CHIP = 20 * len(_POWERS)  # pairs of a chip; with fewer, their noise is fitted
_MAX_PAIRS_FITTED = 4000  # pairs in a fit: with more, their noise does not matter any more


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


def _cubic(design: Float, wanted: Float, use: NDArray[np.bool_]) -> tuple[Float, Float]:
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
