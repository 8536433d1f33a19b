"""Star lists of exposures: their settings, cuts, and the initial distortion applied to them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from pydantic import PositiveFloat

from bayesdist.app.config.section import Section
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.plane import ARCSEC
from bayesdist.data import Detections, StarCuts, read_star_lists
from bayesdist.errors import InputError
from bayesdist.model import Chip
from bayesdist.products.common.document import Choice, Document
from bayesdist.utils.arrays import Bool, Float, Int

# positions (N, 2) of pixels x, y (N,) on the chip of a number
Start = Callable[[Float, Float, int], Float]

OFF_CHIP = 0.02  # fraction of a list's detections tolerated beyond the edge of a chip
EDGE = 1.0  # pixels: half a pixel to the edge, and half for lists that count from 0


class StarListsBlock(Section):
    """Star lists, and the cuts on their detections."""

    lists: str | list[str]
    columns: dict[str, str] | None = None
    mag: tuple[float, float] | None = None
    saturation: float | None = None
    q_max: PositiveFloat | None = None
    simulated: bool = False

    @property
    def list_names(self) -> list[str]:
        """Names of the star lists as given."""
        return [self.lists] if isinstance(self.lists, str) else self.lists


@dataclass(frozen=True, eq=False)
class StarLists:
    """Star lists with the cuts that are applied to their detections."""

    lists: tuple[Detections, ...]
    cuts: StarCuts

    def __len__(self) -> int:
        """Number of detections in all lists."""
        return sum(len(detections) for detections in self.lists)

    @property
    def names(self) -> list[str]:
        """Names of the exposures, one per list."""
        return [detections.name for detections in self.lists]

    def of(self, names: Collection[str]) -> StarLists:
        """Star lists of the named exposures."""
        return replace(
            self, lists=tuple(detections for detections in self.lists if detections.name in names)
        )

    @cached_property
    def _tested(self) -> list[tuple[Bool, dict[str, int]]]:
        return [self.cuts.passed(detections) for detections in self.lists]

    @property
    def passed(self) -> list[Bool]:
        """Boolean masks of the detections that pass the cuts, one per list."""
        return [good for good, _ in self._tested]

    @property
    def cut(self) -> dict[str, int]:
        """Number of detections that fail the cuts, by reason."""
        out: dict[str, int] = {}
        for _, reasons in self._tested:
            for reason, count in reasons.items():
                out[reason] = out.get(reason, 0) + count
        return out

    @property
    def cut_words(self) -> str:
        """Numbers of the detections that fail the cuts, with their reasons, as text."""
        return ", ".join(f"{count} {reason}" for reason, count in self.cut.items())


def lists_of(block: StarListsBlock, base: Path, *, errors: bool = False) -> StarLists:
    """Read all star lists that a configuration names.

    Each entry of the configuration is read separately, so that lists of the same name in two
    entries are recognised as one exposure given twice, not as two exposures.

    Parameters
    ----------
    block : StarListsBlock
    base : Path
        Folder that the names of the lists are relative to.
    errors : bool
        True if the lists have columns of errors.
    """
    names = block.list_names
    lists = (
        detections
        for name in names
        for detections in read_star_lists(base / name, block.columns, errors=errors)
    )
    return StarLists(tuple(lists), StarCuts(block.mag, block.saturation, block.q_max))


def refuse_other_chips(lists: Sequence[Detections], chips: Sequence[Chip], key: str) -> None:
    """Refuse detections off the configured chips, and chips without detections.

    Nothing is checked if the configuration has no [[chip]] blocks. `key` is the configuration key
    that names the lists, for the error message.
    """
    chip_of = {chip.number: chip for chip in chips}
    if not chip_of:
        return
    used: set[int] = set()
    for detections in lists:
        for number in detections.chips:
            rows = detections.chip == number
            if number not in chip_of:
                raise InputError(
                    f"{int(rows.sum())} detections are on chip {number}, which no [[chip]] block "
                    "describes",
                    where=detections.where,
                    do=f"add a block, or leave them out (known: {', '.join(map(str, chip_of))})",
                )
            _refuse_off_chip(
                detections.x[rows], detections.y[rows], chip_of[number], detections.where
            )
        used.update(detections.chips)
    empty = [chip.name for chip in chips if chip.number not in used]
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


def known_calibration(
    document: Document, filter: str | None, size: tuple[float, float] | None
) -> Calibration:
    """Calibration of a file in a filter, or without a filter if it does not list that one.

    `size` is that of the detector, for files that do not state it.
    """
    return document.calibration(Choice(filter if filter in document.filters() else None, size))


def start_of(calibration: Calibration, unit_arcsec: float) -> Start:
    """Distortion of a calibration in the given unit of u and v, up to rotation and shift."""
    if calibration.unit not in ARCSEC:
        raise InputError(
            f"states positions in {calibration.unit}, but an initial distortion must be in angles",
            where=calibration.name,
            do="give a calibration whose positions are in arcsec or deg",
        )
    factor = ARCSEC[calibration.unit] / unit_arcsec
    return lambda x, y, chip: calibration.forward(x, y, chip=chip) * factor


def positions_by_chip(start: Start, x: Float, y: Float, chip: Int) -> Float:
    """Positions (N, 2) of pixels x, y (N,) on the chips with numbers `chip` (N,)."""
    out = np.empty((len(x), 2))
    for number in np.unique(chip):
        rows = chip == number
        out[rows] = start(x[rows], y[rows], int(number))
    return out
