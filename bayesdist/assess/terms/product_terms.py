"""What a file that is made from a solution does to positions: known, and the same in every draw.

A file has its own digits, orders and date, and an inverse that was fitted.  What that moves is no
error of the solution: it comes on top for whoever uses the file, and files are alternatives to each
other.  So these terms are shown beside the others and are in no total; what a file makes of the
total is `with_product`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.terms.given import MEASURED

__all__ = ["PRODUCT", "ProductTerm", "with_product"]

Float = NDArray[np.float64]

PRODUCT = "product"


@dataclass(frozen=True, eq=False)
class ProductTerm:
    """A field by which a file differs from the solution.

    Parameters
    ----------
    name : str
    file : str
        Name of the file, or of the files that are used together.
    direction : str
        'forward', from pixels to positions, or 'inverse'.
    shift : callable
        Takes pixels x, y (N,), a chip number and an epoch (or None) to (N, 2): position by the
        file less that of the solution, in the unit of u, v.
    source : str
    rounding : float
        Displacements below this are none: they are digits of the arithmetic.
    """

    name: str
    file: str
    direction: str
    shift: Callable[[Float, Float, int, float | None], Float]
    source: str = MEASURED
    rounding: float = 0.0

    def at(self, x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        """Displacements (N, 2) at pixels (N,) of a chip."""
        found = np.asarray(self.shift(x, y, chip, epoch), float)
        return np.where(np.abs(found) < self.rounding, 0.0, found)


def with_product(total: float, product: float) -> float:
    """Root mean square of an error of mean zero together with a displacement that never changes.

    A constant is independent of every error: the squares add up exactly.
    """
    return float(np.hypot(total, product))
