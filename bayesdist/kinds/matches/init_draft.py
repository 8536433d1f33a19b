"""`bayesdist init` for a table with missing columns: a draft that lists candidates."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from bayesdist.app.config import parse_config
from bayesdist.data import read_star_lists
from bayesdist.data.formats.files import (
    TableLayout,
    input_files,
    kind_of,
    mission_formats,
    table_layout,
)
from bayesdist.kinds.matches.init_guesses import detector_lines, quoted

MAX_CANDIDATES = 40  # largest number of columns listed

_HEAD = """\
# A DRAFT: no columns of {file} are known as {lacking}.
"""

_CANDIDATES = """\
# If they are there under other names, name them, and write this file anew:
#     bayesdist init {path} --matches {matches} --columns {wanted} --force
# Columns of numbers that are not taken: {candidates}
"""

_WITHOUT_PIXELS = """
[data]
matches = {relative}
# columns = {{{wanted}}}

[detector]
# size = [2048, 2048]           # columns, rows

[model]
order = 4                       # 1 to 12
"""

_STAR_LIST = """
# A star list without reference positions belongs to a [selfcal] or a [campaign].
# 1. Dithered exposures of one field calibrate themselves; see 'bayesdist docs self_calibration':
[selfcal]
lists = {relative}
# lists = "lists/*"             # a pattern, or a list of names: all exposures of the field
{columns}match_radius = 0.5              # pixels between detections of one star in the end
# sigma = "measured"            # errors of the pixels, by magnitude; or "columns", or one number
# start_radius = 2.0            # and at the beginning, before the distortion is known
# initial_distortion = ""       # a finished run, or a calibration file: for some ten pixels

# [gauge]                       # fixes scale, orientation and skew
# offsets = ""                  # a table of commanded offsets: exposure, du, dv, sigma

{detector}
[model]
order = 3                       # 1 to 12

# 2. Matched with a catalogue; see 'bayesdist docs campaign'.  In place of [selfcal], and with
#    [[chip]] blocks in place of [detector]:
# [campaign]
# lists = {relative}
# catalog = ""                  # FILL IN: a table with ra, dec (Gaia's, say) or u, v
# exposures = ""                # FILL IN: a table with exposure, epoch, filter, vafactor
# initial_distortion = ""       # FILL IN: a calibration near enough to find the stars by

# 3. Matched by another program, as TOPCAT or astropy's match_to_catalog_sky, the table has ra, dec
#    of the catalogue beside each detection: 'bayesdist init' makes a configuration of it.
"""

_PAIRS = {"xy": "pixels (x, y)", "uv": "reference positions (ra, dec or u, v)"}
_LIST_KEYS = ("x", "y", "mag", "flux", "exposure")


def draft_of(
    path: Path,
    matches: str | Path,
    relative: str,
    columns: Mapping[str, str] | None,
    size: tuple[int, int] | None,
) -> tuple[str, str] | None:
    """Draft for a table with missing columns; None if no columns are missing.

    A table with pixels alone becomes a self-calibration, with other possibilities as comments.
    Without pixels nothing can be run.

    Parameters
    ----------
    path : Path
        File to write.
    matches : path
        Table.
    relative : str
        Quoted name of the table in the draft.
    columns : mapping of str to str, optional
        Columns named by the user.
    size : tuple of int, optional
        Columns and rows of each chip.

    Returns
    -------
    tuple of str
        Text of the draft, and a description of it.
    """
    layout = table_layout(matches, columns)
    lacking = _lacking(matches, columns) if layout is None else layout.lacking
    if not lacking:
        return None
    words = " and ".join(
        description for pair, description in _PAIRS.items() if set(pair) & set(lacking)
    )
    head = _HEAD.format(file=Path(matches).name, lacking=words)
    if layout is not None:
        head += _candidates(path, matches, layout)
    if set("xy") & set(lacking):
        wanted = ", ".join(f'{key} = ""' for key in lacking)
        text = head + _WITHOUT_PIXELS.format(relative=relative, wanted=wanted)
        return text, f"an incomplete draft with the candidates: no columns are known as {words}"
    columns_used = {} if layout is None else layout.taken
    named = {key: columns_used[key] for key in _LIST_KEYS if key in columns_used} | dict(
        columns or {}
    )
    text = head + _of_star_list(matches, relative, named, size)
    parse_config(text, str(path))
    return text, (
        "an incomplete draft: no columns are known as reference positions; as it stands it is a "
        "[selfcal] of star lists, with a [campaign] and the candidates as comments"
    )


def _lacking(matches: str | Path, columns: Mapping[str, str] | None) -> list[str]:
    """Reference positions missing from a list in the format of a mission; else empty."""
    file = input_files(matches)[0]
    format_ = mission_formats().get(kind_of(file, columns))
    return [] if format_ is None or format_.lacking is None else format_.lacking(file)


def _candidates(path: Path, matches: str | Path, layout: TableLayout) -> str:
    """Lines on the columns that may be the missing ones."""
    spans = list(layout.spans.items())
    listed = [f"{name} ({low:g} to {high:g})" for name, (low, high) in spans[:MAX_CANDIDATES]]
    if len(spans) > MAX_CANDIDATES:
        listed.append(f"and {len(spans) - MAX_CANDIDATES} more")
    keys = ["ra", "dec"] if layout.lacking == ["u", "v"] else layout.lacking
    return _CANDIDATES.format(
        path=path,
        matches=matches,
        wanted=",".join(f"{key}=NAME" for key in keys),
        candidates=", ".join(listed) or "none",
    )


def _of_star_list(
    matches: str | Path, relative: str, columns: dict[str, str], size: tuple[int, int] | None
) -> str:
    """Text of a self-calibration, with the chip sizes guessed from the detections."""
    pixels = (
        (detections.x, detections.y, detections.chip)
        for detections in read_star_lists(matches, columns or None)
    )
    detector, _ = detector_lines(pixels, {}, size, input_files(matches)[0].stem)
    inline = ", ".join(f"{key} = {quoted(name)}" for key, name in columns.items())
    return _STAR_LIST.format(
        relative=relative,
        columns=f"columns = {{{inline}}}\n" if columns else "",
        detector=detector,
    )
