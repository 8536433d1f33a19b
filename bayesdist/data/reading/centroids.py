"""Errors of centroids in pixels, converted to errors of matches.

The covariance of a match is that of its catalogue position plus J C J^T, with the covariance C of
the centroid in pixels and the Jacobian J of u and v with respect to x and y.  J is that of a
polynomial of the second order through the matches of a chip and exposure: its error is a small part
of that of the errors.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesdist.data.magnitude_errors import MAD_TO_SIGMA
from bayesdist.data.tables.column import Quantities, SourceColumn
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int

VARIANCES = ("errx2", "erry2", "errxy")  # beginnings of SExtractor's names of variances
MIN_MATCHES = 4
MIN_ROWS = 30  # of a chip and exposure with a Jacobian of its own
FARTHEST = 5.0  # robust standard deviations beyond which matches are left out


def with_centroid_errors(quantities: Quantities, columns: Mapping[str, Any]) -> dict[str, Any]:
    """Columns sigma_u, sigma_v and rho_uv that include the errors of the centroids.

    Parameters
    ----------
    quantities : Quantities
        Table with the errors of x and y as sigma_x and sigma_y, and possibly the covariance cov_xy
        or the correlation rho_xy; if it has no such errors the result is empty.
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
    if len(columns["x"]) < MIN_MATCHES:
        raise InputError(
            f"{len(columns['x'])} matches do not determine the size of a pixel, by which errors of "
            "x and y become errors of u and v",
            where=quantities.source,
            do="give sigma_u and sigma_v",
        )
    C = _covariances(quantities)
    J = _jacobians(columns)
    total = J @ C @ np.swapaxes(J, 1, 2)
    note = "errors of the centroids were converted from pixels"
    if "sigma_u" in columns:
        a, b = columns["sigma_u"], columns["sigma_v"]
        total[:, 0, 0] += a**2
        total[:, 1, 1] += b**2
        mixed = columns.get("rho_uv", 0.0) * a * b
        total[:, 0, 1] += mixed
        total[:, 1, 0] += mixed
        note += " and added to those of the catalogue"
    sigma_u, sigma_v = np.sqrt(total[:, 0, 0]), np.sqrt(total[:, 1, 1])
    return {
        "sigma_u": sigma_u,
        "sigma_v": sigma_v,
        "rho_uv": total[:, 0, 1] / (sigma_u * sigma_v),
        "notes": (*columns.get("notes", ()), note),
    }


def _covariances(quantities: Quantities) -> Float:
    """Covariances (N, 2, 2) of the centroids in pixels squared."""
    xx, yy = (_variance(quantities[key]) for key in ("sigma_x", "sigma_y"))
    if "rho_xy" in quantities:
        column = quantities["rho_xy"]
        values = column.numbers()
        is_covariance = column.name.lower().startswith(VARIANCES)
        mixed = values if is_covariance else values * np.sqrt(xx * yy)
        beyond = mixed**2 >= xx * yy
        if beyond.any():
            bad = int(np.argmax(beyond))
            raise column.fail(bad, f"{values[bad]:g} is impossible beside the errors of x and y")
    else:
        mixed = np.zeros(len(xx))
    return np.stack([np.stack([xx, mixed], axis=-1), np.stack([mixed, yy], axis=-1)], axis=-2)


def _variance(column: SourceColumn) -> Float:
    """Squared errors of a coordinate, in pixels squared."""
    if column.unit is not None and "pix" not in str(column.unit):
        raise column.fail(0, f"unit is {column.unit}, and errors of pixels are in pix")
    values = column.numbers()
    if not (values > 0).all():
        bad = int(np.argmin(values > 0))
        raise column.fail(bad, f"error of a pixel coordinate is {values[bad]:g}")
    return values if column.name.lower().startswith(VARIANCES) else values**2


def _jacobians(columns: Mapping[str, Any]) -> Float:
    """Derivatives (N, 2, 2) of u and v (rows) with respect to x and y at the matches."""
    x, y, uv = columns["x"], columns["y"], np.stack([columns["u"], columns["v"]], axis=1)
    labels = [columns[key] for key in ("exposure", "chip") if key in columns]
    code = np.zeros(len(x), np.int64)
    if labels:
        code = np.unique(np.stack(labels), axis=1, return_inverse=True)[1].ravel()
    out = np.empty((len(x), 2, 2))
    few = np.bincount(code)[code] < MIN_ROWS
    for group in np.unique(code[~few]):
        rows = np.flatnonzero(code == group)
        out[rows] = _jacobian(x, y, uv, rows, rows)
    if few.any():
        out[few] = _jacobian(x, y, uv, np.arange(len(x)), np.flatnonzero(few))
    return out


def _jacobian(x: Float, y: Float, uv: Float, rows: Int, at: Int) -> Float:
    """Jacobians (n, 2, 2) at the rows `at` of a polynomial through the matches `rows`."""
    middle = np.array([x[rows].mean(), y[rows].mean()])
    half = max(np.ptp(x[rows]), np.ptp(y[rows]), 1.0) / 2

    def design(chosen: Int, *, quadratic: bool) -> Float:
        X, Y = (x[chosen] - middle[0]) / half, (y[chosen] - middle[1]) / half
        terms = [np.ones(len(X)), X, Y]
        return np.stack([*terms, X**2, X * Y, Y**2] if quadratic else terms, axis=1)

    quadratic = len(rows) >= MIN_ROWS
    good = rows
    for _ in range(3):
        coefficients = np.linalg.lstsq(design(good, quadratic=quadratic), uv[good], rcond=None)[0]
        distance = np.hypot(*(uv[rows] - design(rows, quadratic=quadratic) @ coefficients).T)
        near = distance <= FARTHEST * MAD_TO_SIGMA * np.median(distance)
        if near.sum() < len(rows) / 2:
            break
        good = rows[near]
    X, Y = (x[at] - middle[0]) / half, (y[at] - middle[1]) / half
    one, zero = np.ones(len(at)), np.zeros(len(at))
    by_x, by_y = [zero, one, zero], [zero, zero, one]
    if quadratic:
        by_x, by_y = [*by_x, 2 * X, Y, zero], [*by_y, zero, X, 2 * Y]
    slopes = [np.stack(terms, axis=1) @ coefficients / half for terms in (by_x, by_y)]
    return np.stack(slopes, axis=-1)
