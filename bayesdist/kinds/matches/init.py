"""`bayesdist init`: a commented configuration for a file of matches.

For a table with missing columns it is a draft that lists candidates.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from bayesdist.app.config import parse_config
from bayesdist.app.plausibility import scatter_about_polynomials
from bayesdist.app.store.record import refuse_existing
from bayesdist.data import FORMATS, Matches, read_star_lists
from bayesdist.data.formats import (
    TableLayout,
    input_files,
    kind_of,
    mission_formats,
    table_layout,
)
from bayesdist.data.reading.table import NOT_FINITE_CAUSES
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.kinds.matches.config import data_sections
from bayesdist.kinds.matches.init_guesses import (
    column_lines,
    detector_lines,
    quoted,
)
from bayesdist.kinds.matches.sources import load_matches, mission_template

log = logging.getLogger("bayesdist")

SIGMA = 0.05  # assumed error for tables that do not state any
SAMPLE = 20_000  # number of matches that are examined
# ratio of the extents of u, v and x, y
LIKE_PIXELS = (0.5, 2.0)
DEGREES = 1e-3  # smaller ratios mean degrees: pixels larger than 3.6 arcsec are rare
MAS = 20.0

_GUESSED_UNIT = "unit = {unit:22s}# GUESSED: the table does not say\n"

_TEMPLATE = """\
# A calibration of geometric distortion; see 'bayesdist docs configuration' for every key.

[data]
matches = {matches}
{format}{columns}{unit_line}sigma = {sigma}
{not_finite}
{detector}
[model]
order = {order}                       # 1 to 12
{reference}# of each exposure: none | shift | shift_rotation | shift_rotation_scale | affine
frames = "{frames}"
# [model.tdd]                   # terms that drift with time: axis, power of x, power of y
# epoch0 = 2004.5
# terms = [["u", 1, 0], ["v", 1, 0]]

[fit]
clip_chi2 = 25.0                # second pass without pairs beyond this chi-square
clip_abs = 2.0                  # ... or farther off than this, in pixels

[outliers]
model = "gaussian"              # gaussian | uniform (on the match circle) | none
# match_radius = 2.0            # needed for uniform, in the unit of u, v

[sampler]
seed = 1
target_ess = 400
target_rhat = 1.01

# [compute]
# engine = "threads"            # threads | dask
# memory_mb = 1000              # for the stars; those beyond it are kept in a scratch file

[assess]
grid = [33, {grid_y}]                 # points on x and y
# epoch = 2006.5

{catalogue}
# [[requirement]]
# name = "field-wide"
# statistic = "p95"             # max rms mean p50 p68 p90 p95 p99, or u_... v_... for one axis
# limit = 0.1
# unit = "{unit}"
# probability = 0.95

[products]
sip = {{}}                        # inverse_order, linear = "cd" | "sip", crval
# parameters = {{}}             # table of all parameters with their covariance
"""

_UNSTATED = """\
# Errors that the data cannot show: random | systematic.  As long as both sizes here are 0 and no
# source is given, the catalogue's error counts as not stated, and no requirement is called met.
[[budget]]
name = "reference catalogue"
kind = "systematic"
sigma_u = 0.0                   # FILL IN: error of the catalogue's positions over the whole field
sigma_v = 0.0                   # FILL IN
unit = "{unit}"
# source = "published: ..."     # where the sizes are from; needed where they really are 0
"""

_UNDATED = """\
# The columns and {column} = {epoch:g} indicate a catalogue whose published systematic errors
# grow with time: with the date of the exposures (data.epoch) these lines replace [[budget]].
# [catalogue]
# name = {name}
"""

_STATED = """\
# Systematic errors of the catalogue, which the columns and {column} = {epoch:g} indicate.
# Correct the name if it is another catalogue.
[catalogue]
name = {name}
"""

# releases of Gaia by the epoch of their positions, and columns by which they are recognised
_GAIA = {2016.0: "Gaia DR3", 2015.5: "Gaia DR2"}
_COLUMNS_OF_GAIA = {"phot_g_mean_mag", "ra_dec_corr", "astrometric_params_solved", "ruwe"}

_REJECT = """\
not_finite = "reject"           # some values are NaN or infinite: such rows are left out
"""

_AUTO = """\
# format = "auto"               # {formats}
"""

_OUTSIDE = """\
# {n} of {total} positions lie outside these pixels, and 'bayesdist check' refuses them: correct the
# size, the columns or data.pixel_origin, or leave these rows out of the table.
"""

_CENTRE = """\
# reference_pixel = [{cx}, {cy}]  # zero point of the polynomial; the centre by default
"""

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


def init(
    path: str | Path,
    matches: str | Path,
    *,
    columns: Mapping[str, str] | None = None,
    size: tuple[int, int] | None = None,
    force: bool = False,
) -> str:
    """Write a new configuration with comments.

    A draft is written for a table with missing columns; see `draft_of`.

    Parameters
    ----------
    path : path
        TOML file to write.
    matches : path
        Value of ``data.matches``.
    columns : mapping of str to str, optional
        Value of ``data.columns``.
    size : tuple of int, optional
        Columns and rows of each chip; guessed from the positions by default.
    force : bool
        Replace an existing file.

    Returns
    -------
    str
        Text to print: what the configuration is for, and the next step.
    """
    path = Path(path)
    refuse_existing(path, force)
    relative = quoted(os.path.relpath(Path(matches), path.resolve().parent))
    mission = mission_template(matches) if columns is None else None
    if mission is not None and size is not None:
        raise InputError(
            "has a format whose detector size is known",
            where=str(matches),
            do="leave out --size, and change the size in the configuration if it differs",
        )
    draft = draft_of(path, matches, relative, columns, size) if mission is None else None
    if draft is not None:
        text, outcome = draft
    else:
        n, values = _of_matches(matches, columns, size) if mission is None else mission
        order = 4 if n >= 300 else 3 if n >= 100 else 2
        unstated = _UNSTATED.format(unit=values["unit"])
        text = _TEMPLATE.format(
            matches=relative,
            order=order,
            **{"not_finite": "", "catalogue": unstated} | values,
        )
        parse_config(text, str(path))
        outcome = f"for {n} matches; read it, then 'bayesdist check' it"
        if outside := values.get("n_outside", 0):
            outcome = (
                f"a draft for {n} matches, of which {outside} lie outside the detector: 'bayesdist "
                "check' refuses it until the size, the columns, data.pixel_origin or these rows of "
                "the table are corrected"
            )
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")
    return f"{path}: {outcome}"


def _of_matches(
    matches: str | Path, columns: Mapping[str, str] | None, size: tuple[int, int] | None
) -> tuple[int, dict[str, object]]:
    """Number of matches of a table, and values for the template."""
    not_finite = ""
    try:
        table, unit_line, sigma, read_sigma = _read(matches, columns)
    except InputError as error:
        if not error.cause.startswith(NOT_FINITE_CAUSES):
            raise
        table, unit_line, sigma, read_sigma = _read(matches, columns, not_finite="reject")
        not_finite = _REJECT
    for reason, count in table.rejected.items():
        log.warning("%s: left out %d rows: %s", matches, count, reason)
    layout = table_layout(matches, columns, read_sigma=read_sigma)
    _warn_of_pixels(table, str(matches))
    chips = table.chip_names or tuple(f"chip {number}" for number in table.chip_numbers)
    detector, sizes = detector_lines(
        ((batch.x, batch.y, batch.chip_number) for batch in table.batches()),
        dict(zip(table.chip_numbers, chips, strict=True)),
        size,
        Path(matches).stem,
    )
    n_outside = _number_outside(table, sizes)
    if n_outside:
        detector = _OUTSIDE.format(n=n_outside, total=len(table)) + detector
    stated = {} if layout is None else _gaia(layout, table.unit)
    nx, ny = next(iter(sizes.values()))
    centre = _CENTRE.format(cx=(nx + 1) / 2, cy=(ny + 1) / 2)
    return len(table), {
        "format": _AUTO.format(
            formats=" | ".join((*FORMATS, *mission_formats(), *data_sections()))
        ),
        "columns": column_lines(layout, columns),
        "unit_line": unit_line,
        "sigma": sigma,
        "not_finite": not_finite,
        "detector": detector,
        "reference": "" if len(sizes) > 1 else centre,
        "frames": "shift_rotation_scale" if len(table.exposure_names) > 1 else "none",
        "grid_y": max(3, round(32 * ny / nx) + 1),
        "unit": table.unit,
        "n_outside": n_outside,
    } | stated


def _number_outside(matches: Matches, sizes: Mapping[int, tuple[int, int]]) -> int:
    """Number of matches outside their chip, whose pixels end half a pixel beyond the centres."""
    n = 0
    for batch in matches.batches():
        nx, ny = np.array([sizes[number] for number in batch.chip_number.tolist()]).T
        inside = (batch.x >= 0.5) & (batch.x <= nx + 0.5)
        n += int((~(inside & (batch.y >= 0.5) & (batch.y <= ny + 0.5))).sum())
    return n


def _gaia(layout: TableLayout, unit: str) -> dict[str, object]:
    """Value 'catalogue' of the template for stars of a release of Gaia, or empty.

    It is a comment and the usual row, in the unit of u and v, if the exposures have no dates.
    """
    epochs, taken = layout.catalogue_epochs, layout.taken
    if epochs is None or epochs[0] != epochs[1] or "pm_ra" not in taken:
        return {}
    name = _GAIA.get(epochs[0])
    if name is None or not _COLUMNS_OF_GAIA & {column.lower() for column in layout.names}:
        return {}
    facts = {"name": quoted(name), "column": taken["catalogue_epoch"], "epoch": epochs[0]}
    if "epoch" in taken or layout.dated:
        return {"catalogue": _STATED.format(**facts)}
    return {"catalogue": _UNDATED.format(**facts) + _UNSTATED.format(unit=unit)}


def _read(
    matches: str | Path, columns: Mapping[str, str] | None, *, not_finite: str = "refuse"
) -> tuple[Matches, str, str, bool]:
    """Matches, the line on their unit, the value of sigma, and whether error columns are read."""
    unit, line = None, ""
    sigma: float | str = "columns"
    while True:
        try:
            table = load_matches(
                matches, columns=columns, sigma=sigma, unit=unit, not_finite=not_finite
            )
        except InputError as error:
            if error.cause == "has no unit" and unit is None:
                table = load_matches(
                    matches, columns=columns, sigma=1.0, unit="pix", not_finite=not_finite
                )
                unit = _guessed_unit(table, table_layout(matches, columns))
                line = _GUESSED_UNIT.format(unit=quoted(unit))
            elif error.cause == "holds no errors of the positions" and sigma == "columns":
                sigma = SIGMA
            else:
                raise
        else:
            break
    layout = table_layout(matches, columns)
    columns_used = {} if layout is None else layout.taken
    of_catalogue = "sigma_ra" in columns_used and "sigma_x" not in columns_used
    if sigma == "columns" and of_catalogue and table.has_mag:
        errors = f"{columns_used['sigma_ra']}, {columns_used['sigma_dec']}"
        why = f"the errors of the table ({errors}) are the catalogue's alone"
        return table, line, f'"by_magnitude"        # {why}', False
    if sigma == "columns":
        return table, line, '"columns"', True
    if table.has_mag:
        return table, line, '"by_magnitude"        # the table carries no errors', False
    remark = "GUESSED: the table carries neither errors nor magnitudes"
    if "flux" in columns_used:
        remark += f" (not all {columns_used['flux']} are positive)"
    scatter = scatter_about_polynomials(table.sample(SAMPLE))
    if not scatter:
        return table, line, f"{SIGMA}                    # {remark}", False
    how = "the scatter about a polynomial"
    return table, line, f"{scatter:<24g}# {remark}; {how}", False


def _guessed_unit(table: Matches, layout: TableLayout | None) -> str:
    """Unit of u and v, guessed from their scale relative to pixels and from their names."""
    subset = table.sample(SAMPLE)
    ratio = float(np.ptp(subset.u) / max(np.ptp(subset.x), 1.0))
    name = "" if layout is None else layout.taken.get("u", "").lower()
    is_angle = name == "xi" or "arcsec" in name
    if LIKE_PIXELS[0] < ratio < LIKE_PIXELS[1]:
        return "arcsec" if is_angle else "pix"
    return "deg" if ratio < DEGREES else "mas" if ratio > MAS else "arcsec"


def _warn_of_pixels(matches: Matches, where: str) -> None:
    """Warn about positions before the first pixel."""
    batches = [
        (int(((t.x < 0.5) | (t.y < 0.5)).sum()), t.x.min(), t.y.min()) for t in matches.batches()
    ]
    n, (_, *lowest) = sum(batch[0] for batch in batches), np.min(batches, axis=0)
    if n:
        log.warning(
            "%s: %d of %d positions lie before the first pixel, centred on (1, 1): x from %.1f, y "
            "from %.1f; if they are counted from another pixel of the detector, add the position "
            "of that pixel",
            *(where, n, len(matches), *lowest),
        )


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
