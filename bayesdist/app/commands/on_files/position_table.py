"""Reading, writing and description of the position tables of `bayesdist apply`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import MaskedColumn, Table
from numpy.typing import NDArray

from bayesdist.app.commands.on_files.calibrations import notes_of
from bayesdist.app.screen import number
from bayesdist.app.store.output import refuse_existing
from bayesdist.calibration.apply import Positions
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.sky_table import refuse_columns
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.files.tables import read_table
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import ascii_of

OUT = ("x_out", "y_out")
_FORMATS = {".ecsv": "ascii.ecsv", ".csv": "ascii.csv", ".fits": "fits"}


def check_output(output: Path, force: bool) -> None:
    """Refuse an output file with an unknown extension, or one that exists."""
    if output.suffix.lower() not in _FORMATS:
        raise InputError(
            f"extension {output.suffix!r} cannot be written",
            where=str(output),
            do=f"choose one of {', '.join(_FORMATS)}",
        )
    refuse_existing(output, force)


def read_positions(path: Path) -> Table:
    """Read a table of positions; raises InputError if it is empty."""
    table = read_table(path)
    if not len(table):
        raise InputError("has no rows", where=str(path), do="give a table of positions")
    return table


def origin_line(origin: float, reason: str) -> str:
    """Line on the coordinate of the centre of the first pixel."""
    return f"  the first pixel is {origin:g}: {reason}"


def add_positions(table: Table, at: Positions, names: tuple[str, str], where: str) -> None:
    """Add columns with positions and their errors and, for detector positions, the chip."""
    x, y = names
    new: dict[str, NDArray[Any]] = {x: at.x, y: at.y}
    if at.cov is not None:
        new |= {f"sigma_{x}": at.sigma_x, f"sigma_{y}": at.sigma_y}
        new[f"corr_{x}_{y}"] = at.correlation
    if names != OUT and "chip" not in table.colnames:
        new["chip"] = at.chip
    refuse_columns(table, list(new), where)
    for name, values in new.items():
        table[name] = values
        if name.startswith(("sigma", *names)):
            table[name].unit = "pix"


def fits_table(table: Table) -> Table:
    """Table suitable for FITS: ASCII text, short header keywords, and no lists in the header."""
    out = table.copy(copy_data=False)
    for name in table.colnames:
        if out[name].dtype.kind == "U":
            texts, codes = np.unique(np.ma.filled(out[name], ""), return_inverse=True)
            mask, plain = getattr(out[name], "mask", None), np.array(list(map(ascii_of, texts)))
            out[name] = plain[codes] if mask is None else MaskedColumn(plain[codes], mask=mask)
    out.rename_columns(table.colnames, list(map(ascii_of, table.colnames)))
    out.meta = {
        ascii_of(key).upper()[:8]: ascii_of(value) if isinstance(value, str) else value
        for key, value in table.meta.items()
        if not isinstance(value, list)
    }
    return out


def write_positions(table: Table, output: Path) -> None:
    """Write a table in the format of its extension, atomically."""
    kind = _FORMATS[output.suffix.lower()]
    if kind == "fits":
        table = fits_table(table)
    with atomic_path(output) as temporary:
        try:
            table.write(temporary, format=kind)
        except (TypeError, ValueError) as error:  # from columns of arrays or objects
            raise InputError(
                f"not every column can be written as {output.suffix}",
                where=str(output),
                do=f"choose another of {', '.join(_FORMATS)}, or drop columns that hold arrays",
            ) from error


def head_line(output: Path, positions: str, found: Calibration, epoch: float | None) -> str:
    """Line on the output file and the calibration that was used."""
    notes = "".join(f"; {note}" for note in notes_of(found, epoch))
    return f"{output}: {positions}, by {found.name}{notes}"


def closing_lines(outside: int, sigma: Sequence[Float] | None, unit: str) -> list[str]:
    """Lines on positions outside the detector, and on the largest error."""
    out = []
    if outside:
        out.append(
            f"  positions outside of their chip, where polynomials are extrapolated: {outside}"
        )
    if sigma is not None and np.isfinite(sigma).any():
        worst = number(float(np.nanmax(sigma)), 3)
        out.append(f"  largest standard deviation of a coordinate {worst} {unit}")
    return out
