"""Check that positions are those of the array that the pairs are stated to be of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import InputError

__all__ = ["ArrayCheck"]

Float = NDArray[np.float64]

# Pairs that fill no more than a quarter of the array are those of a smaller one: by chance this
# many lie there with a probability of 4^-50.
_ENOUGH = 50
# Of the longer side: reference stars in pixels of the array lie this near to their detections.
# Distortion and frame solutions move them by less; swapped columns and other units by far more.
_NEAR = 0.05


@dataclass
class ArrayCheck:
    """Positions batch by batch against the array of a band."""

    band: str
    size: tuple[float, float]  # columns and rows of the array
    n: int = 0
    n_far: int = 0
    reach: Float = field(default_factory=lambda: np.zeros(2))

    def see(
        self,
        x: Float,
        y: Float,
        where: Callable[[int], str],
        *,
        reference: tuple[Float, Float] | None = None,
    ) -> None:
        """Refuse detections that the array cannot have made.

        `x`, `y`: (N,), FITS 1-based pixels. `where`: names file and row of a position. `reference`:
        (N,), u and v, where these are said to be pixels of the array.
        """
        for name, values, extent in (("x", x, self.size[0]), ("y", y, self.size[1])):
            # half a pixel beyond the edge of the outermost: centroids may fall a little outside
            outside = (values < 0.0) | (values > extent + 1.0)
            if outside.any():
                bad = int(np.argmax(outside))
                raise InputError(
                    f"value is {values[bad]:g}, outside the {extent:g} pixels of {self.band}'s "
                    f"array, as in {int(outside.sum())} of {len(values)} rows",
                    where=f"{where(bad)}, column {name!r}",
                    do="check the band, the array size and pixel_origin",
                )
        self.n += len(x)
        self.reach = np.maximum(self.reach, [x.max(), y.max()])
        if reference is not None:
            away = np.hypot(reference[0] - x, reference[1] - y)
            self.n_far += int((away > _NEAR * max(self.size)).sum())

    def end(self, sources: str) -> None:
        """Refuse positions that all lie in the first quarter, and references far from detections.

        The first are those of another array, the second those of no array, or in swapped columns.
        """
        if self.n >= _ENOUGH and (self.reach <= np.array(self.size) / 2 + 0.5).all():
            raise InputError(
                f"all {self.n} pairs of {self.band} lie within x <= {self.reach[0]:.0f}, y <= "
                f"{self.reach[1]:.0f} of an array of {self.size[0]:g} x {self.size[1]:g}",
                where=sources,
                do="check the band and the size: these are positions of a smaller array",
            )
        if 2 * self.n_far > self.n:
            raise InputError(
                f"in {self.n_far} of {self.n} pairs u, v lies more than "
                f"{_NEAR * max(self.size):.0f} pixels from x, y",
                where=sources,
                do="give u and v in pixels of the band frame, and check which column is which",
            )
