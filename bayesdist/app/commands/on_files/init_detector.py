"""Detector and chips, as `bayesdist init` guesses them from the positions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int

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


Size = tuple[int, int]


def detector_lines(
    pixels: Iterable[tuple[Float, Float, Int]],
    names: Mapping[int, str],
    given: Size | None,
    name: str,
) -> tuple[str, dict[int, Size]]:
    """Lines on one detector, or on several chips; and columns and rows of each, by its number.

    `pixels` are x, y and chips of some tables, `names` the chips' names; `given` is the size of
    each where the user knows it, and `name` that of a detector of one chip.
    """
    reach: dict[int, tuple[float, float]] = {}
    for x, y, chips in pixels:
        for number in np.unique(chips).tolist():
            rows, (far_x, far_y) = chips == number, reach.get(number, (0.0, 0.0))
            reach[number] = max(far_x, float(x[rows].max())), max(far_y, float(y[rows].max()))
    sizes, values = {}, []
    for number, (far_x, far_y) in sorted(reach.items()):
        nx, ny = sizes[number] = given or (_guess(far_x), _guess(far_y))
        how = "as given" if given else f"guessed from x up to {far_x:.1f}, y up to {far_y:.1f}"
        values.append(
            {"number": number, "name": quoted(names.get(number, f"chip {number}")), "nx": nx,
             "ny": ny, "how": how, "cx": (nx + 1) / 2, "cy": (ny + 1) / 2}
        )  # fmt: skip
    if len(sizes) > 1:
        return "\n".join(_CHIP.format(**one) for one in values), sizes
    return _DETECTOR.format(**values[0] | {"name": quoted(name)}), sizes


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
