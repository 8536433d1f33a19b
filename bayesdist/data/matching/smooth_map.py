"""What a known distortion has left over, as a cubic of each chip: for the pairing alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray

__all__ = ["SmoothMap", "smooth_map"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

_ORDER = 3
_POWERS = [(i, j) for i in range(_ORDER + 1) for j in range(_ORDER + 1 - i)]
_LEAST = 20 * len(_POWERS)  # pairs of a chip; with fewer, what is fitted is their noise
_MOST = 4000  # that a fit uses: beyond, their noise has no part in it any more
_CLIP = 3.0  # times the median distance: 3.5 sigma of a circular normal


@dataclass(frozen=True, eq=False)
class SmoothMap:
    """A displacement by chip and place; none for chips with too few pairs.

    Parameters
    ----------
    low, high : ndarray, shape (2,)
        Box of the positions.
    coefficients : dict of int to ndarray, shape (10, 2)
        Of products of Legendre polynomials, for each chip.
    """

    low: Float
    high: Float
    coefficients: dict[int, Float]

    def __call__(self, points: Float, chip: Int) -> Float:
        """Displacements (N, 2) at points (N, 2)."""
        out = np.zeros_like(points)
        for number, values in self.coefficients.items():
            here = chip == number
            out[here] = _terms(points[here], self.low, self.high) @ values
        return out


def smooth_map(points: Float, chip: Int, residual: Float, index: Int) -> SmoothMap:
    """Cubics through the residuals of pairs, chip by chip, with those far off left out.

    Parameters
    ----------
    points : ndarray, shape (N, 2)
        Positions of all detections.
    chip : ndarray of int, shape (N,)
    residual : ndarray, shape (n, 2)
        What must be added to the points of the pairs.
    index : ndarray of int, shape (n,)
        Which points they are.

    Returns
    -------
    SmoothMap
    """
    low, high = points.min(axis=0), points.max(axis=0)
    coefficients: dict[int, Float] = {}
    for number in np.unique(chip).tolist():
        here = np.flatnonzero(chip[index] == number)
        if len(here) < _LEAST:
            continue
        here = here[:: -(-len(here) // _MOST)]
        design, wanted = _terms(points[index[here]], low, high), residual[here]
        use = np.ones(len(wanted), bool)
        for _ in range(6):
            values = _solved(design[use], wanted[use])
            away = np.hypot(*(wanted - design @ values).T)
            kept = away <= _CLIP * np.median(away[use])
            if (kept == use).all() or kept.sum() < _LEAST:
                break
            use = kept
        coefficients[number] = values
    return SmoothMap(low, high, coefficients)


def _solved(design: Float, wanted: Float) -> Float:
    """Least squares; Legendre polynomials leave normal equations well conditioned."""
    return np.linalg.pinv(design.T @ design, hermitian=True) @ (design.T @ wanted)


def _terms(points: Float, low: Float, high: Float) -> Float:
    """Products of Legendre polynomials up to the third order in all."""
    t = 2.0 * (points - low) / np.maximum(high - low, np.finfo(float).tiny) - 1.0
    a, b = legvander(t[:, 0], _ORDER), legvander(t[:, 1], _ORDER)
    return np.stack([a[:, i] * b[:, j] for i, j in _POWERS], axis=-1)
