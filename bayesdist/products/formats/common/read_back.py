"""Positions by files as they were written, to be compared with the solution they were made from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayesdist.calibration.calibration import Calibration
from bayesdist.model import TimeDependence
from bayesdist.utils.arrays import Float

Positions = Callable[[Float, Float, int, float | None], Float]


@dataclass(frozen=True, eq=False)
class ReadBack:
    """What a file says of pixels, by what its bytes hold."""

    file: str  # name of the file, or of several that belong together
    forward: Positions  # of pixels x and y (N,), the number of a chip and a date: positions (N, 2)
    # of the same: where forward and back leads, less the pixel (N, 2); None for a file without
    # inverse
    missed: Positions | None = None
    # whether the file lies along axes of its own and counts in a unit of its own, so that shift,
    # rotation and scale are no errors of it. Otherwise positions are along u, v and in their unit
    own_axes: bool = False


def by_calibrations(
    file: str, sets: Sequence[Calibration], time: TimeDependence | None
) -> ReadBack:
    """Positions by the calibrations of a file, along axes of its own.

    `sets`: one, or one for each segment of the drift. `time`: of the solution that the file was
    made from.
    """

    def of(epoch: float | None) -> Calibration:
        if time is None or epoch is None or len(sets) == 1:
            return sets[0]
        return sets[int(np.searchsorted(time.breaks, epoch, side="right"))]

    def within(one: Calibration, chip: int) -> int:
        # a file of one chip may count from 1
        return chip if chip in one.numbers or len(one.numbers) > 1 else one.numbers[0]

    def forward(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        one = of(epoch)
        # a file without drift would refuse a date
        return one.forward(x, y, chip=within(one, chip), epoch=epoch if one.model.time else None)

    def missed(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        one = of(epoch)
        its = within(one, chip)
        about_zero = one.at(origin="chip")[its]  # at the reference date, for which the rows are
        back = one.inverses[its].pixels(*about_zero.at(x, y))
        return np.stack([back[0] - x, back[1] - y], axis=-1)

    inverses = all(one.inverses for one in sets)
    return ReadBack(file, forward, missed if inverses else None, own_axes=True)


def of_chips(parts: Mapping[int, ReadBack]) -> ReadBack:
    """Positions by several files of one format, each of some chips, as by one file.

    `parts`: by the number of the chip.
    """

    def forward(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        return parts[chip].forward(x, y, chip, epoch)

    def missed(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        return back[chip](x, y, chip, epoch)

    each = parts.values()
    back = {n: one.missed for n, one in parts.items() if one.missed is not None}
    names = dict.fromkeys(one.file for one in each)
    return ReadBack(
        ", ".join(names),
        forward,
        missed if len(back) == len(parts) else None,
        own_axes=any(one.own_axes for one in each),
    )
