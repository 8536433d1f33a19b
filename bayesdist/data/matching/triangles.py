"""Triangles of neighbouring stars, by what shift and rotation leave as it is."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

__all__ = ["Triangles", "triangles_of"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Complex = NDArray[np.complex128]

_FLATTEST = 0.15  # shortest to longest side: below, a small error turns the shape around
_ALIKE = 0.985  # sides nearer to each other than this may change places


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles, their corners in the order of the opposite sides, longest first.

    Parameters
    ----------
    corners : ndarray of int, shape (T, 3)
        Indices of the stars.
    shape : ndarray, shape (T, 2)
        Logarithms of the middle and the shortest side in units of the longest.
    log_size : ndarray, shape (T,)
        Logarithm of the longest side.
    left : ndarray of bool, shape (T,)
        Whether the corners go round anticlockwise: a mirror changes it.
    """

    corners: Int
    shape: Float
    log_size: Float
    left: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.corners)


def triangles_of(stars: Complex, anchors: Int, neighbours: int) -> Triangles:
    """Triangles of each anchor with two of its nearest neighbours.

    Parameters
    ----------
    stars : ndarray of complex, shape (N,)
        Positions x + i y.
    anchors : ndarray of int
        Stars that the triangles are made around.
    neighbours : int
        How many of the nearest ones take part.

    Returns
    -------
    Triangles
        Each once, without the nearly flat and the nearly isosceles ones.
    """
    points = np.stack([stars.real, stars.imag], axis=-1)
    neighbours = min(neighbours, len(stars) - 1)
    if neighbours < 2 or not len(anchors):
        return _described(stars, np.zeros((0, 3), np.int64))
    _, near = cKDTree(points).query(points[anchors], k=neighbours + 1, workers=-1)
    pairs = np.array(list(combinations(range(1, neighbours + 1), 2)))
    first = np.broadcast_to(near[:, :1, None], (len(anchors), len(pairs), 1))
    corners = np.concatenate([first, near[:, pairs]], axis=2).reshape(-1, 3)
    corners = np.sort(corners.astype(np.int64), axis=1)
    n = len(stars)
    _, once = np.unique((corners[:, 0] * n + corners[:, 1]) * n + corners[:, 2], return_index=True)
    return _described(stars, corners[once])


def _described(stars: Complex, corners: Int) -> Triangles:
    z = stars[corners]
    sides = np.abs(z[:, [1, 2, 0]] - z[:, [2, 0, 1]])  # opposite to each corner
    order = np.argsort(-sides, axis=1)
    corners = np.take_along_axis(corners, order, axis=1)
    sides = np.take_along_axis(sides, order, axis=1)
    good = (sides[:, 2] > _FLATTEST * sides[:, 0]) & (sides[:, 1] < _ALIKE * sides[:, 0])
    good &= sides[:, 2] < _ALIKE * sides[:, 1]
    corners, sides = corners[good], sides[good]
    a, b, c = stars[corners].T
    return Triangles(
        corners=corners,
        shape=np.log(sides[:, 1:] / sides[:, :1]),
        log_size=np.log(sides[:, 0]),
        left=((b - a) * np.conj(c - a)).imag < 0,
    )
