"""Errors that are added to the quoted ones in quadrature, group by group.

A group is an axis, or an axis of the stars of one chip, exposure or filter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

__all__ = ["AddedErrors"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class AddedErrors:
    """Errors to be added in quadrature, by group; `other` is for stars of none of these groups."""

    by: str  # 'chip', 'exposure' or 'filter'; empty where all stars are of one group
    labels: tuple[str, ...]  # length G: chip numbers or names; one empty text for one group
    sigma: Float  # (G, 2), along u and v in their unit
    other: Float  # (2,), of stars with another label, as of an exposure that was held out

    def times(self, factor: float) -> AddedErrors:
        """These errors multiplied by a factor."""
        return replace(self, sigma=factor * self.sigma, other=factor * self.other)

    def at(self, labels: Sequence[str], codes: Int) -> tuple[Float, Float]:
        """Errors (N,) on u and v of stars, by the labels of their groups and codes (N,) into them.

        `Matches.grouped` gives both.
        """
        row = {label: k for k, label in enumerate(self.labels)}
        of_label = np.array([row.get(label, len(row)) for label in labels], np.int64)
        added = np.vstack([self.sigma, self.other])[of_label[codes]]
        return added[:, 0], added[:, 1]
