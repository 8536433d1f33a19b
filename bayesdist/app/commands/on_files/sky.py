"""`bayesdist apply --sky`, and the same in Python: pixels to the sky, with all errors known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy import units
from astropy.io import fits
from astropy.table import QTable, Table

from bayesdist.app.commands.on_files.calibrations import calibration_at, on_the_sky
from bayesdist.app.commands.on_files.position_table import (
    check_output,
    chip_numbers,
    closing_lines,
    head_line,
    position_column,
    read_positions,
    refuse_columns,
    write_positions,
)
from bayesdist.calibration.apply import on_chip
from bayesdist.calibration.calibration import Calibration, calibration_of
from bayesdist.calibration.sky_positions import sky_positions
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.infer.solution.solution import Solution
from bayesdist.utils.arrays import Float

if TYPE_CHECKING:
    import pandas

__all__ = ["apply_to_sky", "sky_to_table"]

COLUMNS = ("ra", "dec", "sigma_ra", "sigma_dec", "corr_ra_dec")
COVARIANCE = "covariance"


def apply_to_sky(
    source: str | Path | Calibration | Solution,
    table: str | Path | Table | pandas.DataFrame | Mapping[str, Any],
    *,
    columns: Sequence[str] = ("x", "y"),
    centroids: Sequence[str] | None = None,
    pixel_origin: float = 1.0,
    chip: int | None = None,
    filter: str | None = None,
    epoch: float | None = None,
    point: tuple[float, float] | None = None,
    size: tuple[float, float] | None = None,
    covariance: bool = False,
) -> QTable:
    """Positions on the sky of a table of pixels, with all errors that a calibration carries.

    Parameters
    ----------
    source : path, Calibration, LinearFit or Posterior
        A run, or a file of any format that holds a calibration.
    table : path, astropy Table, pandas DataFrame or mapping of arrays
        With the pixels of stars, and a column chip where there are several.
    columns : tuple of str
        Names of the columns with x and y.
    centroids : tuple of str, optional
        Names of the columns with the standard deviations of x and y, in pixels.
    pixel_origin : float
        Coordinate of the centre of the first pixel: 1 as in FITS, 0 as in photutils.
    chip : int, optional
        Chip number of all stars, in place of a column.
    filter : str, optional
        Of an IDCTAB.
    epoch : float, optional
        Decimal years, of a calibration that drifts.
    point : tuple of float, optional
        Sky position in degrees of (u, v) = (0, 0), u to the east and v to the north, in place of
        the calibration's own.
    size : tuple of float, optional
        Columns and rows, for a header that does not say.
    covariance : bool
        Whether the covariance of all stars is wanted.

    Returns
    -------
    QTable
        The table with ra and dec, their standard deviations sigma_ra (to the east, cos(dec) in it)
        and sigma_dec, and the correlation corr_ra_dec; `meta` has the errors that are in them.
        With `covariance`, meta["covariance"] is the matrix of all stars (2 N, 2 N) in mas^2, east
        and north in turn.

    Raises
    ------
    InputError
        For a calibration that does not lie on the sky, unknown columns or chips, and a file of
        positions without rows.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> chip = bd.Chip(1, "camera", (1000, 1000), (500.5, 500.5))
    >>> model = bd.DistortionModel(1, (chip,), "arcsec")
    >>> truth = [0, 50, 0, 0, 0, 50]
    >>> stars, _ = bd.simulate_matches(model, truth, 500, sigma=0.01, fraction=0.0, rng=rng)
    >>> fit = bd.fit_linear(stars, model)
    >>> sky = bd.apply_to_sky(fit, {"x": [500.5], "y": [500.5]}, point=(30.0, 0.0))
    >>> round(float(sky["ra"][0].value), 4)
    30.0
    >>> bool(abs(sky["sigma_ra"][0].to_value("mas") - 10 / 500**0.5) < 0.01)  # of the mean of 500
    True
    """
    found = _calibration(source, filter, size)
    rows, name = _rows(table)
    plain = Table(rows)
    x, y = (position_column(plain, c, name) + (1.0 - pixel_origin) for c in columns)
    sigma = None
    if centroids is not None:
        a, b = (position_column(plain, c, name) for c in centroids)
        sigma = a, b
    numbers = chip_numbers(plain, chip, list(found.numbers), found.name, name)
    at = sky_positions(
        found, x, y, numbers, epoch=epoch, point=point, centroids=sigma, joint=covariance
    )
    new = COLUMNS if at.sigma is not None else COLUMNS[:2]
    refuse_columns(rows, new, name)
    rows["ra"], rows["dec"] = at.ra * units.deg, at.dec * units.deg
    if at.cov is not None and at.sigma is not None:
        east, north = at.sigma
        rows["sigma_ra"], rows["sigma_dec"] = east * units.mas, north * units.mas
        product = east * north
        rows["corr_ra_dec"] = np.divide(
            at.cov[:, 0, 1], product, out=np.zeros_like(product), where=product > 0
        )
    outside = sum(
        int((~on_chip(m, x[numbers == n], y[numbers == n]) & np.isfinite(x[numbers == n])).sum())
        for n, m in found.at(epoch).items()
    )
    rows.meta = {
        "calibration": found.name,
        "errors": [e for e, _ in _known(found, centroids)],
        "outside": outside,
    }
    if at.joint is not None:
        rows.meta[COVARIANCE] = at.joint
    return rows


def sky_to_table(
    path: str | Path,
    table: str | Path,
    output: str | Path,
    *,
    joint: bool = False,
    force: bool = False,
    columns: Sequence[str] | None = None,
    centroids: Sequence[str] | None = None,
    pixel_origin: float = 1.0,
    chip: int | None = None,
    filter: str | None = None,
    epoch: float | None = None,
    point: tuple[float, float] | None = None,
    size: tuple[float, float] | None = None,
) -> str:
    """Write the table of `apply_to_sky`; what is to be printed is returned.

    With `joint` a FITS file has the covariance of all stars as an image extension.
    """
    output = Path(output)
    check_output(output, force)
    if joint and output.suffix.lower() != ".fits":
        raise InputError(
            "the covariance of all stars is an image, which this format has not",
            where=str(output),
            do="name a .fits file",
        )
    found = _calibration(path, filter, size)
    rows = apply_to_sky(
        found,
        table,
        columns=columns or ("x", "y"),
        centroids=centroids,
        pixel_origin=pixel_origin,
        chip=chip,
        epoch=epoch,
        point=point,
        covariance=joint,
    )
    matrix = rows.meta.pop(COVARIANCE, None)
    plain = Table(rows)  # units as text, which all formats have
    if matrix is None:
        write_positions(plain, output)
    else:
        _write_joint(plain, matrix, output)
    return "\n".join(_lines(output, found, rows, epoch, centroids))


def _calibration(
    source: str | Path | Calibration | Solution,
    filter: str | None,
    size: tuple[float, float] | None,
) -> Calibration:
    if isinstance(source, Calibration):
        return source
    if isinstance(source, Solution):
        return calibration_of(source)
    return on_the_sky(Path(source), calibration_at(source, filter=filter, size=size))


def _rows(table: Any) -> tuple[QTable, str]:
    """Rows of a table, and what to call it."""
    if isinstance(table, str | Path):
        return QTable(read_positions(Path(table))), str(table)
    if hasattr(table, "to_parquet"):  # a DataFrame
        return QTable(Table.from_pandas(table)), "table"
    return QTable(table), "table"


def _known(found: Calibration, centroids: Sequence[str] | None) -> list[tuple[str, str]]:
    """Errors that positions have, and how stars have them in common."""
    out = []
    if found.errors == "covariance":
        out.append(("coefficients, with their covariance", "correlated between stars"))
    elif found.errors == "sigma":
        out.append(("coefficients, without their correlations", "correlated between stars"))
    for row in found.further:
        shared = "the same for all stars" if row.shared else "of each star by itself"
        out.append((row.name, shared))
    if centroids is not None:
        out.append(("centroids", "of each star by itself"))
    return out


def _lines(
    output: Path,
    found: Calibration,
    rows: QTable,
    epoch: float | None,
    centroids: Sequence[str] | None,
) -> list[str]:
    lines = [head_line(output, f"{len(rows)} positions on the sky", found, epoch)]
    lines += [f"  in the errors: {name} ({shared})" for name, shared in _known(found, centroids)]
    if not found.further and found.errors != "none":
        lines.append("  of further errors (structure, catalogue, yours) the file says nothing")
    if centroids is None:
        lines.append("  not in them: centroids of the stars; give --centroids SX SY")
    names = [name for name in ("sigma_ra", "sigma_dec") if name in rows.colnames]
    sigma = [np.asarray(rows[name].to_value("mas"), float) for name in names] or None
    return lines + closing_lines(rows.meta["outside"], sigma, "mas")


def _write_joint(table: Table, matrix: Float, output: Path) -> None:
    """Write a table, and the covariance of all its rows as an image."""
    table.meta = {k.upper()[:8]: v for k, v in table.meta.items() if not isinstance(v, list)}
    image = fits.ImageHDU(matrix, name="COVARIANCE")
    image.header["BUNIT"] = "mas2"
    image.header.add_comment("rows: east and north of each star in turn, as in the table")
    made = fits.HDUList([fits.PrimaryHDU(), fits.table_to_hdu(table), image])
    with atomic_path(output) as temporary:
        made.writeto(temporary)
