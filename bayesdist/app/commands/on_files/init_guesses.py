"""Columns, detector and scatter of a table, as `bayesdist init` finds them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from bayesdist.data.formats.layout import TableLayout
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


# names under which SExtractor writes what the image's own WCS makes of the pixels
_BY_THE_IMAGE = ("alpha_j2000", "alphawin_j2000", "alphapsf_j2000", "sky_centroid.ra")
_TOLD = 3  # columns that may be chips

_NONE = """\
# columns = {x = "x", y = "y", u = "u", v = "v"}  # they are found by their names
"""


def column_lines(layout: TableLayout | None, columns: Mapping[str, str] | None) -> str:
    """Lines of [data] that name the columns taken, the pixel origin and the epochs.

    `layout`: none of a format that fixes its columns. `columns`: as the user names them; empty
    names stay.
    """
    if layout is None:
        return _NONE + "# pixel_origin = 1              # of x, y: 1 as in FITS, or 0\n"
    taken = layout.taken | {key: "" for key, name in (columns or {}).items() if not name}
    pairs = ", ".join(f"{key} = {quoted(name)}" for key, name in taken.items())
    out = [f"columns = {{{pairs}}}"]
    out += [f"# {text}" for text in _remarks(layout)]
    why = layout.why or "of x, y: 1 as in FITS, or 0"
    out.append(f"pixel_origin = {layout.origin}                # {why}")
    if "pm_ra" in taken and "epoch" not in taken and not layout.dated:
        out.append(
            "# epoch = 2012.5                # of the exposures: without it proper motions are not "
            "used"
        )
    if "pm_ra" in taken and "catalogue_epoch" not in taken:
        out.append(
            "# catalogue_epoch = 2016.0      # of ra, dec (Gaia DR3: 2016.0, DR2: 2015.5): without "
            "it proper motions are not used"
        )
    return "\n".join(out) + "\n"


def _remarks(layout: TableLayout) -> list[str]:
    """Remarks on columns that a user has to look at."""
    out = []
    ra = layout.taken.get("ra", "")
    if ra.lower() in _BY_THE_IMAGE:
        out.append(
            f"LOOK: {ra} is often made from the pixels by the image's own WCS: then it is no "
            "reference"
        )
    if "chip" not in layout.taken:
        like_chips = {k: n for k, n in layout.like_chips.items() if "flag" not in k.lower()}
        for name, n in list(like_chips.items())[:_TOLD]:
            out.append(
                f"LOOK: column {name} has {n} values; if these are chips, add chip = {quoted(name)}"
                " (init --columns chip=NAME)"
            )
    return out
