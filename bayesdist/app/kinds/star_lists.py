"""Star lists of exposures, and the known distortion they are first seen through."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from bayesdist.app.config.campaign import StarListsBlock
from bayesdist.calibration.calibration import Calibration
from bayesdist.data import Detections, StarCuts, read_star_lists
from bayesdist.errors import InputError
from bayesdist.infer.selfcal.start import Start
from bayesdist.model import Chip
from bayesdist.products import IdcTab, read_idctab
from bayesdist.products.formats.idctab.calibration import idctab_calibration
from bayesdist.utils.arrays import Bool, Float, Int

OFF_CHIP = 0.02  # of a list's detections beyond the edge of a chip: more are no stray ones
EDGE = 1.0  # pixels: half of one to the edge, and half of one for lists that count from 0


@dataclass(frozen=True, eq=False)
class StarLists:
    """Star lists, and which of their detections pass the cuts."""

    lists: tuple[Detections, ...]
    cuts: StarCuts

    def __len__(self) -> int:
        """Detections of all lists."""
        return sum(len(one) for one in self.lists)

    @property
    def names(self) -> list[str]:
        """Exposures of the lists."""
        return [one.name for one in self.lists]

    def of(self, names: Collection[str]) -> StarLists:
        """Lists of some exposures."""
        return replace(self, lists=tuple(one for one in self.lists if one.name in names))

    @cached_property
    def _tested(self) -> list[tuple[Bool, dict[str, int]]]:
        return [self.cuts.passed(one) for one in self.lists]

    @property
    def passed(self) -> list[Bool]:
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


def lists_of(block: StarListsBlock, base: Path, *, errors: bool = False) -> StarLists:
    """All star lists that a configuration names, with `errors` of their own; relative to `base`.

    Each place is read alone: a list whose name stands in two is an exposure given twice, not two.
    """
    names = block.list_names
    lists = (
        one for name in names for one in read_star_lists(base / name, block.columns, errors=errors)
    )
    return StarLists(tuple(lists), StarCuts(block.mag, block.saturation, block.q_max))


def refuse_other_chips(lists: Sequence[Detections], chips: Sequence[Chip], key: str) -> None:
    """Refuse detections off the chips of a configuration, and chips without any.

    Nothing is checked without [[chip]] blocks. `key`: of the configuration, names the lists.
    """
    known = {chip.number: chip for chip in chips}
    if not known:
        return
    seen: set[int] = set()
    for one in lists:
        for number in one.chips:
            rows = one.chip == number
            if number not in known:
                raise InputError(
                    f"{int(rows.sum())} detections are on chip {number}, which no [[chip]] block "
                    "describes",
                    where=one.where,
                    do=f"add a block, or leave them out (known: {', '.join(map(str, known))})",
                )
            _refuse_off_chip(one.x[rows], one.y[rows], known[number], one.where)
        seen.update(one.chips)
    empty = [chip.name for chip in chips if chip.number not in seen]
    if empty:
        raise InputError(
            f"no exposure has a detection on chip {', '.join(empty)}",
            where=key,
            do="drop its [[chip]] block, or correct the lists' column 'chip'",
        )


def _refuse_off_chip(x: Float, y: Float, chip: Chip, where: str) -> None:
    low, (right, top) = 1.0 - EDGE, (size + EDGE for size in chip.size)
    off = (x < low) | (x > right) | (y < low) | (y > top)
    if off.mean() > OFF_CHIP:
        raise InputError(
            f"{off.mean():.0%} of the detections on chip {chip.name} lie outside its "
            f"{chip.size[0]:g} x {chip.size[1]:g} pixels (x {x.min():.0f} to {x.max():.0f}, "
            f"y {y.min():.0f} to {y.max():.0f})",
            where=where,
            do="check whether x and y are swapped or are pixels of a mosaic, and [[chip]].size",
        )


def known_calibration(tab: IdcTab | Path, filter: str | None) -> Calibration:
    """The calibration of an IDCTAB in a filter, or in any where it does not name that one."""
    known = read_idctab(tab) if isinstance(tab, Path) else tab
    names = {name for row in known.filters() for name in row}
    return idctab_calibration(known, filter if filter in names else None)


def start_of(tab: IdcTab | Path, unit_arcsec: float, filter: str | None = None) -> Start:
    """The distortion of an IDCTAB, to a unit of u and v, up to rotation and shift."""
    known = known_calibration(tab, filter)
    return lambda x, y, chip: known.forward(x, y, chip=chip) / unit_arcsec


def positions_by_chip(start: Start, x: Float, y: Float, chip: Int) -> Float:
    """Positions (N, 2) of pixels on chips with numbers (N,)."""
    out = np.empty((len(x), 2))
    for number in np.unique(chip):
        rows = chip == number
        out[rows] = start(x[rows], y[rows], int(number))
    return out
