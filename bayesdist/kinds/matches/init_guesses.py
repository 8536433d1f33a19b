"""Columns and detector of a table, as guessed by `bayesdist init`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from bayesdist.data.formats import TableLayout
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
    """Lines of a configuration on one detector or several chips, and the size of each chip.

    Parameters
    ----------
    pixels : iterable of tuple of ndarray
        x, y and chip numbers of each table.
    names : mapping of int to str
        Names of the chips.
    given : tuple of int, optional
        Columns and rows of each chip if the user has given them.
    name : str
        Name of a detector with one chip.

    Returns
    -------
    str
        The lines.
    dict of int to tuple of int
        Columns and rows by chip number.
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
        return "\n".join(_CHIP.format(**chip_values) for chip_values in values), sizes
    return _DETECTOR.format(**values[0] | {"name": quoted(name)}), sizes


def quoted(text: str) -> str:
    """Text as a TOML string."""
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _guess(largest: float) -> int:
    """Detector size: a power of 2 just above the largest coordinate, else the next even number."""
    largest -= 0.5
    if largest < 1:
        raise InputError(
            "along x or y, no star of a chip lies beyond the first pixel",
            where="x, y",
            do="name the pixel columns with --columns, or give --size",
        )
    for power in (256, 512, 1024, 2048, 4096, 8192):
        if 0.97 * power <= largest <= power:
            return power
    return int(np.ceil(largest / 2) * 2)


# names of SExtractor columns that are computed from the pixels with the WCS of the image
_BY_THE_IMAGE = ("alpha_j2000", "alphawin_j2000", "alphapsf_j2000", "sky_centroid.ra")
_TOLD = 3  # largest number of possible chip columns mentioned

_NONE = """\
# columns = {x = "x", y = "y", u = "u", v = "v"}  # they are found by their names
"""


def column_lines(layout: TableLayout | None, columns: Mapping[str, str] | None) -> str:
    """Lines of [data] on the columns, the pixel origin and the epochs.

    `layout` is None for a format with fixed columns. `columns` are those named by the user; empty
    names, which leave a column out, are kept.
    """
    if layout is None:
        return _NONE + "# pixel_origin = 1              # of x, y: 1 as in FITS, or 0\n"
    columns_used = layout.taken | {key: "" for key, name in (columns or {}).items() if not name}
    pairs = ", ".join(f"{key} = {quoted(name)}" for key, name in columns_used.items())
    out = [f"columns = {{{pairs}}}"]
    out += [f"# {text}" for text in _remarks(layout)]
    why = layout.why or "of x, y: 1 as in FITS, or 0"
    out.append(f"pixel_origin = {layout.origin}                # {why}")
    if "pm_ra" in columns_used and "epoch" not in columns_used and not layout.dated:
        out.append(
            "# epoch = 2012.5                # of the exposures: without it proper motions are not "
            "used"
        )
    if "pm_ra" in columns_used and "catalogue_epoch" not in columns_used:
        out.append(
            "# catalogue_epoch = 2016.0      # of ra, dec (Gaia DR3: 2016.0, DR2: 2015.5): without "
            "it proper motions are not used"
        )
    return "\n".join(out) + "\n"


def _remarks(layout: TableLayout) -> list[str]:
    """Remarks on columns that the user should check."""
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
