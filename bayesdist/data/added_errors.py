"""Errors that are added to the quoted ones in quadrature, group by group.

A group is an axis, or an axis of the stars of one chip, exposure or filter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from bayesdist.data.matches import MatchTable

__all__ = ["GROUPINGS", "AddedErrors", "group_codes"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

GROUPINGS = ("chip", "exposure", "filter")


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

    def beside(self, matches: MatchTable, sigma_u: Float, sigma_v: Float) -> tuple[Float, Float]:
        """Errors (N,) on u and v: those of the table's stars with these added in quadrature."""
        names, codes = group_codes(matches, self.by)
        row = {label: k for k, label in enumerate(self.labels)}
        of_name = np.array([row.get(name, len(row)) for name in names], np.int64)
        added = np.vstack([self.sigma, self.other])[of_name[codes]]
        return np.hypot(sigma_u, added[:, 0]), np.hypot(sigma_v, added[:, 1])


def group_codes(matches: MatchTable, by: str) -> tuple[tuple[str, ...], Int]:
    """Labels of the groups of a table by `AddedErrors.by`, and the code (N,) of each star's."""
    if not by:
        return ("",), np.zeros(len(matches), np.int64)
    names = {
        "chip": tuple(map(str, matches.chip_numbers)),
        "exposure": matches.exposure_names,
        "filter": matches.filter_names,
    }
    return names[by], getattr(matches, by)
