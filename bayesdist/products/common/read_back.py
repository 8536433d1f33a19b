"""Positions computed from written files, for comparison with the solution they were made from."""

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
    """Positions that a file yields when its bytes are read back."""

    file: str  # name of the file, or of several files that form one product
    forward: Positions  # (x (N,), y (N,), chip number, date) -> positions (N, 2)
    # same arguments -> error (N, 2) of the pixel after forward and inverse; None without an inverse
    missed: Positions | None = None
    # True if the file has separate axes and unit, so that shift, rotation and scale do not
    # count as errors; otherwise positions are along u, v in their unit
    own_axes: bool = False


def by_calibrations(
    file: str, sets: Sequence[Calibration], time: TimeDependence | None
) -> ReadBack:
    """Positions computed from the calibrations of a file that defines its own axes.

    `sets` holds one calibration, or one per segment of the drift. `time` is the time dependence of
    the solution that the file was made from.
    """

    def of(epoch: float | None) -> Calibration:
        if time is None or epoch is None or len(sets) == 1:
            return sets[0]
        return sets[int(np.searchsorted(time.breaks, epoch, side="right"))]

    def within(one: Calibration, chip: int) -> int:
        # a file of one chip may count from 1
        return chip if chip in one.numbers or len(one.numbers) > 1 else one.numbers[0]

    def forward(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        calibration = of(epoch)
        # a calibration without drift does not accept a date
        return calibration.forward(
            x, y, chip=within(calibration, chip), epoch=epoch if calibration.model.time else None
        )

    def missed(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        calibration = of(epoch)
        number = within(calibration, chip)
        about_zero = calibration.at(origin="chip")[number]  # at the date of the inverse rows
        back = calibration.inverses[number].pixels(*about_zero.at(x, y))
        return np.stack([back[0] - x, back[1] - y], axis=-1)

    inverses = all(one.inverses for one in sets)
    return ReadBack(file, forward, missed if inverses else None, own_axes=True)


def of_chips(parts: Mapping[int, ReadBack]) -> ReadBack:
    """Combine files of one format that hold different chips; `parts` maps chip numbers to files."""

    def forward(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        return parts[chip].forward(x, y, chip, epoch)

    def missed(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        return back[chip](x, y, chip, epoch)

    each = parts.values()
    back = {n: part.missed for n, part in parts.items() if part.missed is not None}
    names = dict.fromkeys(part.file for part in each)
    return ReadBack(
        ", ".join(names),
        forward,
        missed if len(back) == len(parts) else None,
        own_axes=any(part.own_axes for part in each),
    )
