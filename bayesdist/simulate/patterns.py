"""Dither patterns: pointings and rolls of exposures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import lcm

import numpy as np
from scipy.spatial.distance import pdist

from bayesdist.model import Chip, DistortionModel
from bayesdist.model.grid import mesh
from bayesdist.utils.arrays import Float

GAP = 50.0  # pixels between chips without a given position
ONE_LINE = 0.02  # of the spread along the offsets, below which that across them counts as none


@dataclass(frozen=True, eq=False)
class DitherPattern:
    """Pointings and rolls of some exposures, relative to the first."""

    name: str
    offsets: Float  # (E, 2), of the detector's middle, pixels along the first one's axes
    rolls: Float  # (E,), radians

    def __len__(self) -> int:
        return len(self.offsets)

    @cached_property
    def reach(self) -> float:
        """Largest distance of two pointings, pixels."""
        return float(pdist(self.offsets).max(initial=0.0))

    @property
    def along_one_line(self) -> bool:
        """True where the pointings differ, and along one line only."""
        spread = np.linalg.svd(self.offsets - self.offsets.mean(axis=0), compute_uv=False)
        return bool(spread[0] > 0 and spread[1:].max(initial=0.0) < ONE_LINE * spread[0])


def grid_offsets(n: tuple[int, int], step: tuple[float, float]) -> Float:
    """Offsets (n_x n_y, 2) of a regular grid, row by row from zero; `step` is in pixels."""
    return np.stack(
        mesh(np.arange(n[0], dtype=float) * step[0], np.arange(n[1], dtype=float) * step[1]), axis=1
    )


def rolls_in_turn(n: int, n_offsets: int, rolls: Sequence[float]) -> Float:
    """Rolls (n,) of exposures that go round some offsets: every offset meets every roll.

    Offsets repeat after `n_offsets` exposures, `rolls` are taken in turn.
    """
    k = np.arange(n)
    # where both would repeat together, the rolls go one further
    return np.asarray(rolls, float)[(k + k // lcm(n_offsets, len(rolls))) % len(rolls)]


def flat_coefficients(
    order: int, chips: Sequence[Chip], places: Sequence[tuple[float, float]] | None = None
) -> Float:
    """Legendre coefficients (chips, 2, K) of chips without distortion.

    `places` are the positions of the chips' reference pixels, in pixels; by default one above the
    other, the first one below, fifty pixels between them.
    """
    model = DistortionModel(order, tuple(chips))
    out, above = np.zeros((len(chips), 2, model.n_terms)), 0.0
    for c, chip in enumerate(chips):
        monomials = np.zeros((2, model.n_terms))
        monomials[0, 1] = monomials[1, 2] = 1.0
        monomials[:, 0] = (0.0, above) if places is None else places[c]
        out[c] = model.basis(chip.number).from_monomials(monomials)
        above += chip.size[1] + GAP
    return out
