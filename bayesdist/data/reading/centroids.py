"""Errors of centroids in pixels, converted to errors of matches.

The covariance of a match is that of its catalogue position plus J C J^T, with the covariance C of
the centroid in pixels and the Jacobian J of u and v with respect to x and y.  J is taken from a
polynomial of the second order, fitted to the matches of each chip and exposure.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from astropy.table import MaskedColumn, Table

from bayesdist.data.covariances import covariances_of, errors_of
from bayesdist.data.robust import robust_fit
from bayesdist.data.tables.checks import row_number
from bayesdist.data.tables.column import Quantities, SourceColumn, without_unit
from bayesdist.data.tables.names import ALIASES
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Bool, Float

# SExtractor's names of the axes of an error ellipse, the angle from x towards y in degrees, and the
# variances and covariance that are the same as these
ELLIPSES = tuple(
    (
        (f"erra{kind}_image", f"errb{kind}_image", f"{angle}{kind}_image"),
        (f"errx2{kind}_image", f"erry2{kind}_image", f"errxy{kind}_image"),
    )
    for kind, angle in (("win", "errtheta"), ("psf", "errtht"), ("", "errtheta"))
)
VARIANCES = ("errx2", "erry2", "errxy")  # beginnings of SExtractor's names of variances
MIN_MATCHES = 4
MIN_ROWS = 30  # of a chip and exposure with a Jacobian of its own
POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # of x and y in the polynomial
ROUNDING = 1e-12  # relative, of positions


def with_centroid_errors(quantities: Quantities, columns: Mapping[str, Any]) -> dict[str, Any]:
    """Columns sigma_u, sigma_v and rho_uv that include the errors of the centroids.

    Parameters
    ----------
    quantities : Quantities
        Table with the errors of x and y as sigma_x and sigma_y, and possibly their correlation
        rho_xy; without these errors the result is empty.
    columns : mapping
        Arguments of `Matches`: x, y, u, v, and sigma_u, sigma_v and rho_uv of the catalogue, and
        exposure and chip, if known.

    Returns
    -------
    dict of str to ndarray

    Raises
    ------
    InputError
        If errors are not positive or not in pixels, if a correlation is impossible, or if there are
        too few matches to determine the size of a pixel.
    """
    if "sigma_x" not in quantities:
        return {}
    J = _jacobians(columns, quantities.source)
    total = J @ pixel_covariances(quantities) @ np.swapaxes(J, 1, 2)
    note = "errors of the centroids were converted from pixels"
    if "sigma_u" in columns:
        total += covariances_of(columns["sigma_u"], columns["sigma_v"], columns.get("rho_uv", 0.0))
        note += " and added to those of the catalogue"
    return {**errors_of(total), "notes": (*columns.get("notes", ()), note)}


def with_variances(table: Table) -> Table:
    """Table with variances and covariance of x and y where it has SExtractor's error ellipses.

    The first complete ellipse is used, of windowed, PSF or isophotal positions.  The table is
    returned unchanged if it has none, or other errors of x and y.  `check_ellipses` refuses axes
    that are not positive, if the errors are used.
    """
    names = ellipse_columns(table.colnames)
    if names is None:
        return table
    axes, variances = names
    a, b, angle = (np.ma.asarray(without_unit(table[name])) for name in axes)
    cos, sin = np.ma.cos(np.radians(angle)), np.ma.sin(np.radians(angle))
    made = (
        a**2 * cos**2 + b**2 * sin**2,
        a**2 * sin**2 + b**2 * cos**2,
        (a**2 - b**2) * sin * cos,
    )
    out = table.copy(copy_data=False)
    present = {name.lower() for name in table.colnames}
    for name, values in zip(variances, made, strict=True):
        if name not in present:
            out[name] = MaskedColumn(values)
    return out


def ellipse_columns(
    names: Iterable[str],
) -> tuple[tuple[str, str, str], tuple[str, str, str]] | None:
    """Columns of the first complete error ellipse, and names of its variances and covariance.

    None if there is no ellipse, or if there are other errors of x and y.
    """
    lower = {name.lower(): name for name in names}
    for axes, variances in ELLIPSES:
        if not lower.keys() >= set(axes):
            continue
        others = {*ALIASES["sigma_x"], *ALIASES["sigma_y"], *ALIASES["rho_xy"]} - set(variances)
        if lower.keys() & others or variances[2] in lower:
            return None
        a, b, angle = (lower[name] for name in axes)
        return (a, b, angle), variances
    return None


def check_ellipses(table: Table, found: Mapping[str, str], source: str) -> None:
    """Raise InputError by row if an axis of an error ellipse that is used is not positive.

    `table` is the one before `with_variances`, and `found` the columns by quantity after it.
    """
    names = ellipse_columns(table.colnames)
    if names is None or found.get("sigma_x", "").lower() != names[1][0]:
        return
    for name in names[0][:2]:
        values = np.ma.asarray(without_unit(table[name]))
        bad = np.ma.filled(values <= 0, fill_value=False)
        if bad.any():
            row = int(np.argmax(bad))
            raise InputError(
                f"an axis of an error ellipse is {values[row]:g}",
                where=f"{source}, {row_number(row)}, column {name!r}",
                do="correct the row or drop it, or do not use these errors",
            )


def pixel_covariances(quantities: Quantities) -> Float:
    """Covariances (N, 2, 2) of the centroids in pixels squared.

    InputError if errors are not positive or not in pixels, or if a correlation is impossible.
    """
    xx, yy = (_variance(quantities[key]) for key in ("sigma_x", "sigma_y"))
    rho = np.zeros(len(xx))
    if "rho_xy" in quantities:
        column = quantities["rho_xy"]
        values = column.numbers()
        is_covariance = column.name.lower().startswith(VARIANCES)
        rho = values / np.sqrt(xx * yy) if is_covariance else values
        beyond = np.abs(rho) >= 1.0
        if beyond.any():
            bad = int(np.argmax(beyond))
            raise column.fail(bad, f"{values[bad]:g} is impossible beside the errors of x and y")
    return covariances_of(np.sqrt(xx), np.sqrt(yy), rho)


def _variance(column: SourceColumn) -> Float:
    """Squared errors of a coordinate, in pixels squared."""
    if column.unit is not None and "pix" not in str(column.unit):
        raise column.fail(0, f"unit is {column.unit}, and errors of pixels are in pix")
    values = column.numbers()
    if not (values > 0).all():
        bad = int(np.argmin(values > 0))
        raise column.fail(bad, f"error of a pixel coordinate is {values[bad]:g}")
    return values if column.name.lower().startswith(VARIANCES) else values**2


def _jacobians(columns: Mapping[str, Any], source: str) -> Float:
    """Derivatives (N, 2, 2) of u and v (rows) with respect to x and y at the matches."""
    xy, uv = (np.stack([columns[key] for key in pair], axis=1) for pair in ("xy", "uv"))
    labels = [columns[key] for key in ("exposure", "chip") if key in columns]
    code = np.zeros(len(xy), np.int64)
    if labels:
        code = np.unique(np.stack(labels), axis=1, return_inverse=True)[1].ravel()
    out = np.empty((len(xy), 2, 2))
    few = np.bincount(code)[code] < MIN_ROWS
    for group in np.unique(code[~few]):
        rows = np.flatnonzero(code == group)
        out[rows] = _jacobian(xy[rows], uv[rows], xy[rows], source)
    if few.any():
        out[few] = _jacobian(xy, uv, xy[few], source)
    return out


def _jacobian(xy: Float, uv: Float, at: Float, source: str) -> Float:
    """Jacobians (n, 2, 2) at pixels (n, 2) of a polynomial through matches (N, 2).

    It has the second order, or the first if there are few matches.  InputError if the matches do
    not determine it.
    """
    middle, half = xy.mean(axis=0), max(np.ptp(xy), 1.0) / 2
    powers = POWERS if len(xy) >= MIN_ROWS else POWERS[:3]

    def terms(pixels: Float, by: int | None = None) -> Float:
        """Powers (n, terms) of scaled pixels, or their derivatives by x or y."""
        X = (pixels - middle) / half
        columns = []
        for power in powers:
            factor, lowered = 1.0, list(power)
            if by is not None:
                factor, lowered[by] = power[by] / half, max(power[by] - 1, 0)
            columns.append(factor * X[:, 0] ** lowered[0] * X[:, 1] ** lowered[1])
        return np.stack(columns, axis=1)

    design = terms(xy)

    def fit(use: Bool) -> tuple[Float, Float] | None:
        solution, _, rank, _ = np.linalg.lstsq(design[use], uv[use], rcond=None)
        distance = np.asarray(np.hypot(*(uv - design @ solution).T))
        return (np.asarray(solution), distance) if rank == len(powers) else None

    slack = ROUNDING * float(np.abs(uv).max())
    robust = robust_fit(fit, len(xy), least=MIN_MATCHES, slack=slack)
    if robust is None:
        raise InputError(
            f"{len(xy)} matches do not determine the size of a pixel, by which errors of x and y "
            "become errors of u and v",
            where=source,
            do="give sigma_u and sigma_v",
        )
    return np.stack([terms(at, by) @ robust.solution for by in (0, 1)], axis=-1)
