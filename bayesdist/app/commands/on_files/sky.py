"""`bayesdist apply --sky`: transform pixels to the sky, with all errors of the calibration."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import QTable, Table

from bayesdist.app.calibrations import calibration_at, on_the_sky, refuse_unused_date
from bayesdist.app.commands.on_files.position_table import (
    check_output,
    closing_lines,
    fits_table,
    head_line,
    origin_line,
    read_positions,
    write_positions,
)
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.sky_table import COVARIANCE, errors_in, pixel_columns, table_on_sky
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.utils.arrays import Float


def sky_to_table(
    path: str | Path,
    table: str | Path,
    output: str | Path,
    *,
    joint: bool = False,
    force: bool = False,
    columns: Sequence[str] | None = None,
    centroids: Sequence[str] | None = None,
    pixel_origin: float | None = None,
    chip: int | None = None,
    filter: str | None = None,
    epoch: float | None = None,
    point: tuple[float, float] | None = None,
    size: tuple[float, float] | None = None,
) -> str:
    """Write the table of `Calibration.to_sky`, and return the text to print.

    If `joint` is True a FITS file with the covariance of all stars as an image extension is
    written.
    """
    output = Path(output)
    check_output(output, force)
    if joint and output.suffix.lower() != ".fits":
        raise InputError(
            "the covariance of all stars is an image, which this format cannot store",
            where=str(output),
            do="name a .fits file",
        )
    calibration = on_the_sky(Path(path), calibration_at(path, filter=filter, size=size))
    refuse_unused_date(epoch, calibration)
    positions = read_positions(Path(table))
    origin, reason = pixel_columns(positions, columns, pixel_origin, str(table))[2:]
    rows = table_on_sky(
        calibration,
        QTable(positions),
        name=str(table),
        columns=columns,
        centroids=centroids,
        pixel_origin=origin,
        chip=chip,
        epoch=epoch,
        point=point,
        covariance=joint,
    )
    matrix = rows.meta.pop(COVARIANCE, None)
    plain = Table(rows)  # units as text, which all formats can hold
    if matrix is None:
        write_positions(plain, output)
    else:
        _write_joint(plain, matrix, output)
    head, *lines = _lines(output, calibration, rows, epoch, centroids)
    return "\n".join([head, origin_line(origin, reason), *lines])


def _lines(
    output: Path,
    found: Calibration,
    rows: QTable,
    epoch: float | None,
    centroids: Sequence[str] | None,
) -> list[str]:
    lines = [head_line(output, f"{len(rows)} positions on the sky", found, epoch)]
    lines += [f"  in the errors: {name} ({shared})" for name, shared in errors_in(found, centroids)]
    if not found.further and found.errors != "none":
        lines.append("  of further errors (structure, catalogue, yours) the file says nothing")
    if centroids is None:
        lines.append("  not in them: centroids of the stars; give --centroids SX SY")
    names = [name for name in ("sigma_ra", "sigma_dec") if name in rows.colnames]
    sigma = [np.asarray(rows[name].to_value("mas"), float) for name in names] or None
    return lines + closing_lines(rows.meta["outside"], sigma, "mas")


def _write_joint(table: Table, matrix: Float, output: Path) -> None:
    """Write a table, with the covariance of all its rows as an image."""
    image = fits.ImageHDU(matrix, name="COVARIANCE")
    image.header["BUNIT"] = "mas2"
    image.header.add_comment("rows: east and north of each star in turn, as in the table")
    hdus = fits.HDUList([fits.PrimaryHDU(), fits.table_to_hdu(fits_table(table)), image])
    with atomic_path(output) as temporary:
        hdus.writeto(temporary)
