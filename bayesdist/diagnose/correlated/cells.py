"""Scores, curvatures and squared scores summed over small cells of the detector: one pass.

Cells are so small that all functions evaluated on them are smooth within one: later steps then need
no star again, however many there are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.stars.likelihood import Likelihood
from bayesdist.infer.stars.stars import Stars
from bayesdist.infer.stars.sums import Sums
from bayesdist.model import Groups
from bayesdist.model.grid import cell_index

__all__ = ["CellSums", "cell_sums", "cells_per_side"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

# cells along each side of a chip, by largest number of groups: limits memory and time
SIDES = ((8, 64), (32, 48), (10**9, 32))
COLUMNS = 9  # n, g_u, g_v, h_uu, h_uv, h_vv, g_u^2, g_u g_v, g_v^2


@dataclass(frozen=True, eq=False)
class CellSums(Sums):
    """Sums over the stars of each group and cell."""

    groups: Groups
    side: int  # cells on each side of a chip
    # (G, C, 9) number of stars, gradient of the log-likelihood by the model's u and v, minus its
    # second derivatives uu, uv, vv, and products of the gradients uu, uv, vv
    sums: Float
    position: Float  # (chips, C, 3) number of stars and sums of their scaled positions X and Y

    BY_GROUP = ("sums",)
    SAME = ("side",)

    def centres(self, chip: int) -> tuple[Int, Float, Float]:
        """Cells of a chip (by code) with stars, and the mean scaled position X, Y in each."""
        n, x, y = self.position[chip].T
        used = np.flatnonzero(n)
        return used, x[used] / n[used], y[used] / n[used]


def cells_per_side(n_groups: int) -> int:
    """Number of cells on each side of a chip for this number of groups."""
    return next(side for most, side in SIDES if n_groups <= most)


def cell_sums(stars: Stars, likelihood: Likelihood, side: int) -> CellSums:
    """Sums over some stars with `side` cells on each side of a chip, as a task for `Shards.sum`."""
    g_u, g_v, h_uu, h_uv, h_vv = likelihood.scores(stars)
    # Where a star may or may not be a false match its curvature is negative.  Such stars are left
    # out, so that every sum of curvatures is that of a possible likelihood.
    good = (h_uu > 0) & (h_vv > 0)
    h_uu, h_uv, h_vv = (np.where(good, h, 0.0) for h in (h_uu, h_uv, h_vv))
    columns = (None, g_u, g_v, h_uu, h_uv, h_vv, g_u**2, g_u * g_v, g_v**2)
    code, C, G = cell_index(stars.X, stars.Y, (side, side)), side * side, len(stars.groups)
    sums = np.zeros((G, C, COLUMNS))
    position = np.zeros((len(stars.model.chips), C, 3))
    for g, chip in enumerate(stars.groups.chip):
        rows = slice(stars.starts[g], stars.starts[g + 1])
        for k, column in enumerate(columns):
            weights = None if column is None else column[rows]
            sums[g, :, k] = np.bincount(code[rows], weights, minlength=C)
        position[chip, :, 0] += sums[g, :, 0]
        for k, z in ((1, stars.X), (2, stars.Y)):
            position[chip, :, k] += np.bincount(code[rows], z[rows], minlength=C)
    return CellSums(stars.groups, side, sums, position)
