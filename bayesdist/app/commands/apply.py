"""`bayesdist apply`: transform detector positions to the undistorted frame or the sky, or back.

Positions on the sky have all errors of the calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import QTable, Table

from bayesdist.app.calibrations import calibration_at, on_the_sky, refuse_unused_date
from bayesdist.app.commands.inputs import (
    OUT,
    add_positions,
    calibration_of_scale,
    check_output,
    closing_lines,
    fits_table,
    head_line,
    images_of,
    origin_line,
    read_positions,
    write_positions,
)
from bayesdist.app.screen import number
from bayesdist.calibration.apply import (
    Application,
    OutputFrame,
    Positions,
    frame_that_holds,
    on_chip,
)
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.inverse import fitted_inverse
from bayesdist.calibration.sky_table import (
    COVARIANCE,
    chip_numbers,
    errors_in,
    pixel_columns,
    position_column,
    table_on_sky,
)
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.utils.arrays import Bool, Float, Int

METHODS = ("newton", "polynomial", "table")


def apply_to_table(
    path: str | Path,
    table: str | Path,
    output: str | Path,
    *,
    inverse: bool = False,
    method: str = "newton",
    order: int | None = None,
    columns: Sequence[str] | None = None,
    pixel_origin: float | None = None,
    chip: int | None = None,
    filter: str | None = None,
    epoch: float | None = None,
    scale: float | None = None,
    size: tuple[float, float] | None = None,
    origin: Sequence[float] | None = None,
    vafactor: float = 1.0,
    image: str | Path | None = None,
    ltv: tuple[float, float] | None = None,
    corner: tuple[float, float] | None = None,
    force: bool = False,
) -> str:
    """Transform the positions of a table to the output frame, or back to pixels, and write a file.

    Pixels are 1-based when written.

    Parameters
    ----------
    path : path
        Calibration file or run.
    table, output : path
        Table to read, and file to write.
    inverse : bool
        Transform back to pixels.
    method : str
        Method of the inverse: 'newton' (on the forward polynomials), 'polynomial' (fitted here), or
        'table' (inverse that the file states).
    order : int, optional
        Order of the fitted polynomial.
    columns : sequence of str, optional
        Columns with the positions; by default those with usual names for pixels, or x_out and y_out
        for the inverse.
    pixel_origin : float, optional
        Coordinate of the centre of the first pixel in the table; by default that of the program
        that wrote the columns.
    chip : int, optional
        Chip number, in place of a column 'chip'.
    filter, scale, size
        See `calibration_of_scale`.
    epoch : float, optional
        Date in decimal years.
    origin : tuple of float, optional
        Output pixel of the zero point, (0, 0) by default.
    vafactor : float
        Factor of velocity aberration of the exposure.
    image, ltv, corner
        See `images_of`.
    force : bool
        Replace an existing file.

    Returns
    -------
    str
        Text to print.
    """
    output = Path(output)
    check_output(output, force)
    calibration = calibration_of_scale(path, filter=filter, scale=scale, size=size, epoch=epoch)
    chips_of = calibration.in_frame(epoch)
    pixel, source = calibration.pixel(epoch)
    ox, oy = origin or (0.0, 0.0)
    frame = OutputFrame(pixel, (ox, oy), vafactor)
    images = images_of(calibration, image=image, ltv=ltv, corner=corner)
    a = Application(chips_of, frame, images)
    rows = read_positions(Path(table))
    if inverse:
        x, y = (position_column(rows, name, str(table)) for name in columns or OUT)
    else:
        x, y, first, reason = pixel_columns(rows, columns, pixel_origin, str(table))
    names = calibration.name, str(table)
    if inverse:
        has_chips = chip is not None or len(chips_of) == 1 or "chip" in rows.colnames
        chips = chip_numbers(rows, chip, list(chips_of), *names) if has_chips else None
        at, lines = _back(a, calibration, x, y, chips, method, order, epoch)
        added = ("x", "y")
    else:
        chips = chip_numbers(rows, chip, list(chips_of), *names)
        parts = {n: (chips == n, a.forward(x[chips == n], y[chips == n], chip=n)) for n in a.chips}
        at, added = _gathered(parts, x.size), OUT
        lines = [origin_line(first, reason), *_frame_lines(a, source)]
    add_positions(rows, at, added, str(table))
    rows.meta = {"calibration": calibration.name, "scale": pixel, "unit": calibration.unit}
    rows.meta |= {"origin": [ox, oy], "vafactor": vafactor}
    write_positions(rows, output)
    head = head_line(output, f"{at.x.size} positions", calibration, epoch)
    return "\n".join([head, *lines, *_losses(a, at, x, y, inverse)])


def _back(
    a: Application,
    found: Calibration,
    X: Float,
    Y: Float,
    chips: Int | None,
    method: str,
    order: int | None,
    epoch: float | None,
) -> tuple[Positions, list[str]]:
    """Pixels, and lines of text on the errors of the inverse."""
    if chips is None:
        at = a.locate(X, Y)
    else:
        parts = {n: (chips == n, a.inverse(X[chips == n], Y[chips == n], chip=n)) for n in a.chips}
        at = _gathered(parts, X.size)
    if method == "newton":
        worst = max(a.closure(n) for n in a.chips)
        return at, [f"  inverse by Newton's method: closes to {number(worst, 2)} pix"]
    lines = []
    about_zero = found.at(epoch, origin="chip")
    x, y = at.x.copy(), at.y.copy()
    for n in a.chips:
        mine = at.chip == n
        chip = about_zero[n]
        if method == "polynomial":
            back = fitted_inverse(chip, order)
            method_name = f"polynomial of order {back.order}"
        else:
            if n not in found.inverses:
                raise InputError(
                    f"holds no INVERSE row of chip {n}",
                    where=found.name,
                    do="choose --method newton or polynomial",
                )
            back, method_name = found.inverses[n], "INVERSE row"
        zero = a.chips[n].at(*(([v]) for v in chip.basis.reference_pixel))
        pixels = back.pixels(*(a.plane(X[mine], Y[mine]) - zero))
        x[mine], y[mine] = a.images[n].from_chip(*pixels) if n in a.images else pixels
        worst, rms = back.misses(chip)
        errors = f"{number(worst, 3)} pix at worst, {number(rms, 3)} rms"
        lines.append(f"  chip {n}: {method_name}, closes to {errors}")
    return Positions(x, y, at.cov, at.chip), lines


def _gathered(parts: dict[int, tuple[Bool, Positions]], n: int) -> Positions:
    """Positions on several chips in the order of the rows."""
    at = np.full((2, n), np.nan)
    number = np.zeros(n, np.int64)
    has_cov = all(p.cov is not None for _, p in parts.values())
    cov = np.full((n, 2, 2), np.nan) if has_cov else None
    for mine, part in parts.values():
        at[0, mine], at[1, mine], number[mine] = part.x, part.y, part.chip
        if cov is not None:
            cov[mine] = part.cov
    return Positions(at[0], at[1], cov, number)


def _frame_lines(a: Application, source: str) -> list[str]:
    frame, size = frame_that_holds(a.chips, a.frame.scale, a.frame.vafactor)
    unit = next(iter(a.chips.values())).unit
    unit = "pix of u, v" if unit == "pix" else unit
    return [
        f"  output pixels of {number(a.frame.scale, 6)} {unit} ({source})",
        f"  an image of {size[0]} x {size[1]} pixels holds all chips, with --origin "
        f"{frame.origin[0]:g} {frame.origin[1]:g}",
    ]


def _losses(a: Application, at: Positions, x: Float, y: Float, inverse: bool) -> list[str]:
    """Lines of text on positions without a pixel, and on positions outside the detector."""
    out = []
    if inverse:
        none = int((~np.isfinite(at.x)).sum())
        if none:
            out.append(f"  positions on no chip, whose x and y are NaN: {none}")
        x, y = at.x, at.y
    outside = 0
    for n, c in a.chips.items():
        mine = (at.chip == n) & np.isfinite(x) & np.isfinite(y)
        image = a.images.get(n)
        px, py = (x, y) if image is None else image.to_chip(x, y)
        outside += int((mine & ~on_chip(c, px, py)).sum())
    sigma = None if at.cov is None else (at.sigma_x, at.sigma_y)
    return out + closing_lines(outside, sigma, "pix")


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
