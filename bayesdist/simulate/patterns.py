"""Dither patterns: pointings and roll angles of exposures."""

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

GAP = 50.0  # default gap between chips, pixels
ONE_LINE = 0.02  # pointings with a smaller axis ratio count as lying along one line


@dataclass(frozen=True, eq=False)
class DitherPattern:
    """Pointings and roll angles of exposures, relative to the first one."""

    name: str
    offsets: Float  # (E, 2), of the detector centre, pixels along the axes of the first exposure
    rolls: Float  # (E,), radians

    def __len__(self) -> int:
        return len(self.offsets)

    @cached_property
    def reach(self) -> float:
        """Largest distance between two pointings, in pixels."""
        return float(pdist(self.offsets).max(initial=0.0))

    @property
    def along_one_line(self) -> bool:
        """True if the pointings differ only along one line."""
        spread = np.linalg.svd(self.offsets - self.offsets.mean(axis=0), compute_uv=False)
        return bool(spread[0] > 0 and spread[1:].max(initial=0.0) < ONE_LINE * spread[0])


def grid_offsets(n: tuple[int, int], step: tuple[float, float]) -> Float:
    """Offsets (n_x n_y, 2) of a regular grid in pixels, row by row, starting at zero."""
    return np.stack(
        mesh(np.arange(n[0], dtype=float) * step[0], np.arange(n[1], dtype=float) * step[1]), axis=1
    )


def rolls_in_turn(n: int, n_offsets: int, rolls: Sequence[float]) -> Float:
    """Roll angles (n,) of exposures such that every offset is combined with every roll angle.

    The offsets repeat after `n_offsets` exposures; the roll angles are used cyclically.
    """
    k = np.arange(n)
    # when the combinations would start to repeat, the roll angles are advanced by one
    return np.asarray(rolls, float)[(k + k // lcm(n_offsets, len(rolls))) % len(rolls)]


def flat_coefficients(
    order: int, chips: Sequence[Chip], places: Sequence[tuple[float, float]] | None = None
) -> Float:
    """Legendre coefficients (chips, 2, K) of chips without distortion.

    `places` are the positions (u, v) of the chips' reference pixels, in pixels.  By default the
    chips are stacked upwards, beginning with the first, with gaps of `GAP` pixels.
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
