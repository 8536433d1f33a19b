"""Detector and chips, as `bayesdist init` guesses them from the positions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bayesdist.errors import InputError

__all__ = ["DetectorLines", "detector_lines", "quoted"]

_DETECTOR = """\
[detector]
name = {name}
size = [{nx}, {ny}]             # columns, rows; {how}
# mission = ""                  # beside the name in the title of the report: mission,
# instrument = ""               # instrument
# filter = ""                   # and filter
# scale_mas = 50.0              # size of a pixel, to state errors in mas beside pixels
"""

_CHIP = """\
[[chip]]
number = {number}
name = {name}
size = [{nx}, {ny}]             # columns, rows; {how}
reference_pixel = [{cx}, {cy}]  # zero point of the polynomial
"""


@dataclass(frozen=True)
class DetectorLines:
    """Lines of a configuration on the detector, or on its chips."""

    text: str
    size: tuple[int, int]  # columns and rows of the first chip
    several: bool  # true of several chips

    @property
    def middle(self) -> tuple[float, float]:
        """Middle of the first chip."""
        nx, ny = self.size
        return (nx + 1) / 2, (ny + 1) / 2


def detector_lines(
    reach: Mapping[int, tuple[float, float]],
    names: Mapping[int, str],
    given: tuple[int, int] | None,
    name: str,
) -> DetectorLines:
    """Lines on one detector, or on several chips.

    `reach` has largest x and y of the stars on each chip, by its number, `names` the chips' names;
    `given` is the size of each where the user knows it, and `name` that of a detector of one chip.
    """
    sizes = {number: given or (_guess(x), _guess(y)) for number, (x, y) in reach.items()}
    values = []
    for number, (nx, ny) in sizes.items():
        x, y = reach[number]
        how = "as given" if given else f"guessed from x up to {x:.1f}, y up to {y:.1f}"
        values.append(
            {"number": number, "name": quoted(names.get(number, f"chip {number}")), "nx": nx,
             "ny": ny, "how": how, "cx": (nx + 1) / 2, "cy": (ny + 1) / 2}
        )  # fmt: skip
    several = len(sizes) > 1
    if several:
        text = "\n".join(_CHIP.format(**one) for one in values)
    else:
        text = _DETECTOR.format(**values[0] | {"name": quoted(name)})
    return DetectorLines(text, next(iter(sizes.values())), several)


def quoted(text: str) -> str:
    """Text as TOML has it."""
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _guess(largest: float) -> int:
    """Detector size: the next multiple of 2 above the data, or a power of 2 that is near."""
    largest -= 0.5
    if largest < 1:
        raise InputError(
            "no star of a chip lies beyond the first pixel, on x or on y",
            where="x, y",
            do="name the columns of its pixels by --columns, or give --size",
        )
    for power in (256, 512, 1024, 2048, 4096, 8192):
        if 0.97 * power <= largest <= power:
            return power
    return int(np.ceil(largest / 2) * 2)
