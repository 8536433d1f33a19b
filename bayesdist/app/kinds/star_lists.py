"""Star lists of exposures, and the known distortion they are first seen through."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.config.campaign import StarListsBlock
from bayesdist.calibration.calibration import Calibration
from bayesdist.data import StarCuts, StarList, read_star_lists
from bayesdist.infer.selfcal.start import Start
from bayesdist.products import IdcTab, read_idctab
from bayesdist.products.formats.idctab.calibration import idctab_calibration

__all__ = [
    "StarLists",
    "known_calibration",
    "lists_of",
    "positions_by_chip",
    "start_of",
]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StarLists:
    """Star lists, and which of their detections pass the cuts.

    Parameters
    ----------
    lists : tuple of StarList
    cuts : StarCuts
    """

    lists: tuple[StarList, ...]
    cuts: StarCuts

    def __len__(self) -> int:
        """Detections of all lists."""
        return sum(len(one) for one in self.lists)

    @cached_property
    def _tested(self) -> list[tuple[NDArray[np.bool_], dict[str, int]]]:
        return [self.cuts.passed(one) for one in self.lists]

    @property
    def passed(self) -> list[NDArray[np.bool_]]:
        """Boolean mask of the detections that pass, by list."""
        return [good for good, _ in self._tested]

    @property
    def cut(self) -> dict[str, int]:
        """Detections that do not pass, by reason."""
        out: dict[str, int] = {}
        for _, reasons in self._tested:
            for reason, count in reasons.items():
                out[reason] = out.get(reason, 0) + count
        return out

    @property
    def cut_words(self) -> str:
        """Number of the detections that do not pass, by reason."""
        return ", ".join(f"{count} {reason}" for reason, count in self.cut.items())


def lists_of(block: StarListsBlock, base: Path) -> StarLists:
    """All star lists that a configuration names; paths are relative to `base`.

    Each place is read alone: a list whose name stands in two is an exposure given twice, not two.
    """
    names = block.lists if isinstance(block.lists, list) else [block.lists]
    lists = (one for name in names for one in read_star_lists(base / name, block.columns))
    return StarLists(tuple(lists), StarCuts(block.mag, block.saturation, block.q_max))


def known_calibration(tab: IdcTab | Path, filter: str | None) -> Calibration:
    """The calibration of an IDCTAB in a filter, or in any where it does not name that one."""
    known = read_idctab(tab) if isinstance(tab, Path) else tab
    names = {name for row in known.filters() for name in row}
    return idctab_calibration(known, filter if filter in names else None)


def start_of(tab: IdcTab | Path, unit_arcsec: float, filter: str | None = None) -> Start:
    """The distortion of an IDCTAB, to a unit of u and v, up to rotation and shift."""
    known = known_calibration(tab, filter)
    return lambda x, y, chip: known.forward(x, y, chip=chip) / unit_arcsec


def positions_by_chip(start: Start, x: Float, y: Float, chip: NDArray[np.int64]) -> Float:
    """Positions (N, 2) of pixels on chips with numbers (N,)."""
    out = np.empty((len(x), 2))
    for number in np.unique(chip):
        rows = chip == number
        out[rows] = start(x[rows], y[rows], int(number))
    return out
