"""Calibrations and position tables of commands: read with their options, described and written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import MaskedColumn, Table
from numpy.typing import NDArray

from bayesdist.app.calibrations import calibration_at, refuse_unused_date
from bayesdist.app.screen import number
from bayesdist.app.store.record import refuse_existing
from bayesdist.calibration.apply import Positions, Subarray, subarray_at_corner, subarrays_of_image
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.sky_table import refuse_columns
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.files.tables import read_table
from bayesdist.products.common.content import read_hdus
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import ascii_of

OUT = ("x_out", "y_out")
_FORMATS = {".ecsv": "ascii.ecsv", ".csv": "ascii.csv", ".fits": "fits"}


def calibration_of_scale(
    path: str | Path,
    *,
    filter: str | None = None,
    scale: float | None = None,
    size: tuple[float, float] | None = None,
    epoch: float | None = None,
) -> Calibration:
    """Calibration of a file or a run with a given pixel scale.

    Parameters
    ----------
    path : path
    filter, size
        See `calibration_at`.
    scale : float, optional
        Size of a corrected pixel in the unit of u and v; that of the file by default.
    epoch : float, optional
        Date in decimal years, which is only checked.

    Raises
    ------
    InputError
        If the scale is not positive, or an epoch is given and the calibration does not depend on
        time.
    """
    calibration = calibration_at(path, filter=filter, size=size)
    refuse_unused_date(epoch, calibration)
    if scale is None:
        return calibration
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"the scale is {scale}", where="--scale", do="give a positive number")
    return replace(calibration, scale=float(scale), scale_from="--scale")


def notes_of(found: Calibration, epoch: float | None) -> tuple[str, ...]:
    """Notes for readers of results that were obtained with a calibration."""
    first = found.chip(epoch=epoch)
    errors = {
        "none": ("it holds no errors",),
        "sigma": ("its errors come without correlations",),
        "covariance": (),
    }
    return (*first.notes, *errors[first.errors])


def images_of(
    found: Calibration,
    *,
    image: str | Path | None = None,
    ltv: tuple[float, float] | None = None,
    corner: tuple[float, float] | None = None,
) -> dict[int, Subarray]:
    """Positions of subarrays on their chips, by chip number; empty for full chips.

    Parameters
    ----------
    found : Calibration
    image : path, optional
        Calibrated image with the keywords of its subarray.
    ltv : tuple of float, optional
        LTV1 and LTV2.
    corner : tuple of float, optional
        Pixel of the chip that is the first pixel of the subarray.

    Raises
    ------
    InputError
        If more than one of the options is given.
    """
    options = [("--image", image), ("--ltv", ltv), ("--corner", corner)]
    named = [name for name, value in options if value is not None]
    if len(named) > 1:
        raise InputError(
            f"{' and '.join(named)} have the same meaning", where="options", do="keep one of them"
        )
    if image is not None:
        sizes = {chip.number: chip.size for chip in found.model.chips}
        headers = (hdu.header for hdu in read_hdus(image))
        return subarrays_of_image(headers, sizes, str(image))
    if ltv is not None:
        return dict.fromkeys(found.numbers, Subarray((ltv[0], ltv[1])))
    if corner is not None:
        return dict.fromkeys(found.numbers, subarray_at_corner(*corner))
    return {}


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
