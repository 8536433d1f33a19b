"""Stars of many frames, each with its error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.tables.checks import check_columns
from bayesdist.errors import InputError

__all__ = ["FrameStars"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class FrameStars:
    """Stars of many frames: detections on the detector, or reference stars in each frame's system.

    Refused are no stars, unequal lengths, values that are not finite, and errors that are not
    positive.
    """

    x: Float  # (N,): FITS 1-based pixels, or undistorted positions in the frame
    y: Float
    sigma: Float  # (N,), per axis, in the unit of the undistorted positions
    frame: Int  # (N,): only stars of equal number are paired

    def __post_init__(self) -> None:
        if not np.size(self.x):
            raise InputError("a list holds no stars", where="column 'x'", do="give one with stars")
        columns = ("x", "y", "sigma", "frame")
        check_columns(
            self, columns, integers=("frame",), where="list of stars", positive=("sigma",)
        )

    def __len__(self) -> int:
        return len(self.x)

    @property
    def points(self) -> Float:
        """Positions (N, 2)."""
        return np.column_stack([self.x, self.y])
