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
    """Errors to be added in quadrature.

    Parameters
    ----------
    by : str
        'chip', 'exposure' or 'filter'; empty where all stars are of one group.
    labels : tuple of str, length G
        Numbers of the chips, or names; one empty text where all stars are of one group.
    sigma : ndarray, shape (G, 2)
        Added error along u and v, in their unit.
    other : ndarray, shape (2,)
        Of stars whose label is none of these: of an exposure that was held out, for one.
    """

    by: str
    labels: tuple[str, ...]
    sigma: Float
    other: Float

    def times(self, factor: float) -> AddedErrors:
        """The same, multiplied by a factor."""
        return replace(self, sigma=factor * self.sigma, other=factor * self.other)

    def beside(self, matches: MatchTable, sigma_u: Float, sigma_v: Float) -> tuple[Float, Float]:
        """Errors (N,) on u and v with these added.

        Parameters
        ----------
        matches : MatchTable
        sigma_u, sigma_v : ndarray, shape (N,)
            Errors of its stars.
        """
        names, codes = group_codes(matches, self.by)
        row = {label: k for k, label in enumerate(self.labels)}
        of_name = np.array([row.get(name, len(row)) for name in names], np.int64)
        added = np.vstack([self.sigma, self.other])[of_name[codes]]
        return np.hypot(sigma_u, added[:, 0]), np.hypot(sigma_v, added[:, 1])


def group_codes(matches: MatchTable, by: str) -> tuple[tuple[str, ...], Int]:
    """Labels of the groups of a table, and the code (N,) of each star's.

    Parameters
    ----------
    matches : MatchTable
    by : str
        As of `AddedErrors`.

    Returns
    -------
    labels : tuple of str
    codes : ndarray of int, shape (N,)
    """
    if not by:
        return ("",), np.zeros(len(matches), np.int64)
    names = {
        "chip": tuple(map(str, matches.chip_numbers)),
        "exposure": matches.exposure_names,
        "filter": matches.filter_names,
    }
    return names[by], getattr(matches, by)
