"""Template of `bayesdist init` for RvB pairs."""

from __future__ import annotations

from pathlib import Path

from bayesdist.app.commands.on_files.init_guesses import column_lines
from bayesdist.data import input_files
from bayesdist.data.tables.parquet import describe_part
from bayesdist.errors import InputError
from bayesdist.files.tables import read_table
from bayesdist.missions.wise.pairs.files import (
    IPAC,
    MAGNITUDES,
    RvbFile,
    open_rvb_files,
)
from bayesdist.missions.wise.pairs.read import rvb_bands, stream_rvb
from bayesdist.missions.wise.published import WISE_ARRAYS

SIGMA = 0.1  # default error of pairs without errors, pixels

_FORMAT = """\
format = "rvb"                  # pairs of WISE and 2MASS, u and v in pixels of the band frame
band = "{band}"                     # {found}
"""

_SELECTION = """\
# [data.rvb]                    # selection of pairs; all by default
{colour}# accept_centre = 1.0           # largest offset of a pair at the array's centre, in pixels
# accept_corner = 3.0           # ... and in its corners, where distortion is largest

"""

_COLOUR = """\
# colour = [-0.5, 0.5]          # magnitude at the shortest minus that at the longest wavelength
# bluest = 100                  # maximum number of pairs per frame; the bluest are selected
"""

_DETECTOR = """\
[detector]
mission = "WISE"
name = "{band}"
size = [{nx:.0f}, {ny:.0f}]
scale_mas = {scale:.0f}
"""


def rvb_template(matches: str | Path) -> tuple[int, dict[str, object]] | None:
    """Number of RvB pairs, and the values for the template of `init`; None for other matches.

    Raises InputError as `stream_rvb` does.
    """
    if not _is_rvb(matches):
        return None
    files = open_rvb_files(matches, None)
    quantities = set(files[0].found)
    if "band" in quantities:
        counts = rvb_bands(matches)
        band = max(counts, key=counts.__getitem__)
        comment = "the file contains " + ", ".join(f"{name} ({n})" for name, n in counts.items())
    else:
        band = _guessed_band(files)
        comment = "GUESSED from the positions: not stated in the file"
    sigma: str | float = "columns" if {"sigma_u", "sigma_v"} <= quantities else SIGMA
    n, has_mag = 0, True
    for pairs in stream_rvb(matches, band=band, sigma=sigma):
        n += len(pairs)
        has_mag = has_mag and pairs.matches.has_mag
    sigma_lines = {
        "columns": '"columns"',
        SIGMA: '"by_magnitude"        # the table has no errors'
        if has_mag
        else f"{SIGMA}                     # GUESSED: the table has no errors",
    }
    coloured = "colour" in quantities or len(quantities.intersection(MAGNITUDES)) > 1
    array = WISE_ARRAYS[band]
    (nx, ny), scale = array.size, 1000 * array.scale
    return n, {
        "format": _FORMAT.format(band=band, found=comment),
        "columns": column_lines(None, None),
        "unit_line": "",
        "sigma": sigma_lines[sigma],
        "detector": _SELECTION.format(colour=_COLOUR if coloured else "")
        + _DETECTOR.format(band=band, nx=nx, ny=ny, scale=scale),
        "reference": f"# reference_pixel = [{array.centre[0]}, {array.centre[1]}]  # the centre\n",
        "frames": "none",
        "grid_y": 33,
        "unit": "pix",
    }


def _is_rvb(matches: str | Path) -> bool:
    """True if the files are RvB pairs: IPAC tables with u and v, or Parquet with WISE bands."""
    files = input_files(matches)
    if all(file.name.lower().endswith(IPAC) for file in files):
        return {"u", "v"} <= {name.lower() for name in read_table(files[0]).colnames}
    if any(file.suffix.lower() != ".parquet" for file in files):
        return False
    part = describe_part(files[0])
    if not {"band", "x", "y", "u", "v"} <= set(part.colnames) or "band" not in part.texts:
        return False
    try:
        return bool(rvb_bands(files[0]))
    except InputError:  # bands of another instrument
        return False


def _guessed_band(files: list[RvbFile]) -> str:
    """W4 if all detections are on its array, otherwise W1 (W2 and W3 have the same array)."""
    reach = 0.0
    for file in files:
        for table, _, place in file.blocks(["x", "y"]):
            for key in "xy":
                reach = max(reach, float(file.column(table, key, place).numbers().max()))
    return "W4" if reach <= WISE_ARRAYS["W4"].size[0] + 1 else "W1"
