"""Positions in many frames, and pairs within a radius that depends on the place on the detector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bayesdist.data.matching.pairs import mutual_pairs
from bayesdist.data.tables.checks import check_values, one_length
from bayesdist.errors import InputError

__all__ = ["FrameStars", "pairs_in_frames"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class FrameStars:
    """Stars of many frames: detections on the detector, or reference stars in each frame's system.

    Parameters
    ----------
    x, y : ndarray, shape (N,)
        Detections: FITS 1-based pixels.  Reference stars: undistorted position in the frame.
    sigma : ndarray, shape (N,)
        Standard error on each axis, in the unit of the undistorted positions.
    frame : ndarray of int, shape (N,)
        Which frame; only stars of equal number are paired.

    Raises
    ------
    InputError
        For no stars, unequal lengths, values that are not finite, or errors that are not positive.
    """

    x: Float
    y: Float
    sigma: Float
    frame: Int

    def __post_init__(self) -> None:
        given = {name: getattr(self, name) for name in ("x", "y", "sigma", "frame")}
        if not np.size(self.x):
            raise InputError("a list holds no stars", where="column 'x'", do="give one with stars")
        arrays = one_length(given, integers=("frame",), where="list of stars")
        for name, values in arrays.items():
            object.__setattr__(self, name, values)
        check_values(arrays, place=lambda row: f"list of stars, row {row + 1}", positive=("sigma",))

    def __len__(self) -> int:
        return len(self.x)

    @property
    def points(self) -> Float:
        """Positions (N, 2)."""
        return np.column_stack([self.x, self.y])


def pairs_in_frames(
    position: Float, frame: Int, reference: FrameStars, radius: Float
) -> tuple[Int, Int]:
    """Pairs that are each other's nearest within their frame.

    Parameters
    ----------
    position : ndarray, shape (N, 2)
        Of the detections, corrected.
    frame : ndarray of int, shape (N,)
    reference : FrameStars
    radius : ndarray, shape (N,)
        Largest distance of the partner of each detection.

    Returns
    -------
    index, reference_index : ndarray of int, shape (n_pairs,)
        No index stands twice.
    """
    reach = float(radius.max())
    # frames lie on top of each other, out of each other's reach
    apart = 2.0 * reach
    points = np.column_stack([position, apart * frame])
    others = np.column_stack([reference.points, apart * reference.frame])
    index, partner, distance = mutual_pairs(points, others, cKDTree(others), reach)
    near = distance <= radius[index]
    return index[near], partner[near]
