"""Matches at the pixels that look-up tables have corrected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import Matches
from bayesdist.model import DistortionModel
from bayesdist.model.lookup import LookupTable, corrected

__all__ = ["corrected_matches", "inside_chips", "on_the_chips"]


def corrected_matches(tables: Sequence[LookupTable], matches: Matches) -> Matches:
    """Matches at the pixels to which tables of the detector and of one filter move them."""
    filter = next((table.filter for table in tables if table.filter), "")
    x, y = corrected(tables, matches.x, matches.y, chip=matches.chip_number, filter=filter)
    return matches.with_columns(x=x, y=y)


def on_the_chips(matches: Matches, model: DistortionModel) -> Matches:
    """Matches without the few at the edge that a table has moved off the chip.

    There the polynomial is not defined.  They count in the tables all the same.
    """
    inside = inside_chips(matches, model)
    return matches if inside.all() else matches.select(inside, reason="moved off the chip")


def inside_chips(matches: Matches, model: DistortionModel) -> NDArray[np.bool_]:
    """Boolean mask (N,) of the matches whose pixels lie on their chip."""
    size = np.array([model.chips[model.chip_code(c)].size for c in matches.chip_numbers])
    nx, ny = size[matches.chip].T
    x, y = matches.x, matches.y
    return np.asarray((x >= 0.5) & (x <= nx + 0.5) & (y >= 0.5) & (y <= ny + 0.5))
