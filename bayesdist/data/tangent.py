"""Directions on the sky, and tangent planes.

The gnomonic projection of the position (a, d) about the tangent point (a0, d0), converted to
seconds of arc, is

    D   = sin d sin d0 + cos d cos d0 cos(a - a0)
    xi  = cos d sin(a - a0) / D                                  east
    eta = (cos d0 sin d - sin d0 cos d cos(a - a0)) / D          north

Calabretta & Greisen 2002, A&A 395, 1077, Section 5.1.3, written as standard coordinates.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.data.covariances import covariances_of, errors_of
from bayesdist.data.tables.checks import Place, row_number
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Bool, Float

ARCSEC = np.degrees(1.0) * 3600.0  # seconds of arc in a radian


def mean_direction(ra: ArrayLike, dec: ArrayLike) -> tuple[float, float]:
    """Mean direction: that of the sum of the unit vectors.

    Parameters
    ----------
    ra, dec : array_like, shape (N,)
        Right ascension and declination in degrees.

    Returns
    -------
    ra0, dec0 : float
        Mean direction in degrees, with ra0 in [0, 360).
    """
    return direction_of(direction_sum(ra, dec))


def direction_sum(ra: ArrayLike, dec: ArrayLike) -> tuple[int, int, int]:
    """Sum of unit vectors in units of 2^-62, from ra and dec (N,) in degrees.

    The sum is exact to the last digit, so that sums of parts add up to the total.
    """
    a, d = np.radians(np.asarray(ra, float)), np.radians(np.asarray(dec, float))
    x, y, z = (_exact_sum(c) for c in (np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)))
    return x, y, z


def _exact_sum(values: Float) -> int:
    """Sum of numbers in [-1, 1] in units of 2^-62; two parts of 31 bits cannot overflow."""
    upper = np.rint(values * 2.0**31)
    lower = np.rint((values * 2.0**31 - upper) * 2.0**31)
    return (int(upper.astype(np.int64).sum()) << 31) + int(lower.astype(np.int64).sum())


def direction_of(vector: tuple[int, int, int]) -> tuple[float, float]:
    """Right ascension and declination in degrees of a vector of any length.

    See `mean_direction`.
    """
    x, y, z = (float(component) for component in vector)
    ra0 = float(np.degrees(np.arctan2(y, x)) % 360.0)
    return ra0, float(np.degrees(np.arctan2(z, np.hypot(x, y))))


def _angles(
    ra: ArrayLike, dec: ArrayLike, point: tuple[float, float], where: str, place: Place
) -> tuple[Float, Float, float, Float]:
    """Hour angle from the tangent point, declination, its declination, and D; in radians."""
    delta, d, d0, D = _distances(ra, dec, point)
    if np.any(D <= 0):
        row = place(int(np.argmax(D <= 0)))
        raise InputError(
            f"the position lies 90 degrees or more from the tangent point {point}",
            where=f"{where}, {row}" if where else row,
            do="give a tangent point inside the field",
        )
    return delta, d, d0, D


def _distances(
    ra: ArrayLike, dec: ArrayLike, point: tuple[float, float]
) -> tuple[Float, Float, float, Float]:
    delta = np.radians(np.asarray(ra, float) - point[0])
    d = np.radians(np.asarray(dec, float))
    d0 = float(np.radians(point[1]))
    return delta, d, d0, np.sin(d) * np.sin(d0) + np.cos(d) * np.cos(d0) * np.cos(delta)


def is_on_plane(ra: ArrayLike, dec: ArrayLike, point: tuple[float, float]) -> Bool:
    """Boolean mask (N,) of positions that `tangent_plane` can project; False for NaN.

    Positions and tangent point (ra, dec) are in degrees.
    """
    return np.asarray(_distances(ra, dec, point)[3] > 0)


def tangent_plane(
    ra: ArrayLike,
    dec: ArrayLike,
    point: tuple[float, float],
    *,
    where: str = "",
    place: Place = row_number,
) -> tuple[Float, Float]:
    """Project sky positions onto a tangent plane.

    Parameters
    ----------
    ra, dec : array_like, shape (N,)
        Right ascension and declination in degrees.
    point : tuple of float
        Tangent point (ra0, dec0), degrees.
    where : str, optional
        Name of the file, for the error message.
    place : callable, optional
        ``place(index)`` is the name of a row of that file, given its index in the arrays.

    Returns
    -------
    xi, eta : ndarray, shape (N,)
        Coordinates in seconds of arc; xi increases to the east, eta to the north.

    Raises
    ------
    InputError
        If a position is 90 degrees or more from the tangent point.
    """
    delta, d, d0, D = _angles(ra, dec, point, where, place)
    xi = np.cos(d) * np.sin(delta) / D
    eta = (np.cos(d0) * np.sin(d) - np.sin(d0) * np.cos(d) * np.cos(delta)) / D
    return ARCSEC * xi, ARCSEC * eta


def tangent_jacobian(
    ra: ArrayLike, dec: ArrayLike, point: tuple[float, float], *, where: str = ""
) -> Float:
    """Derivatives (N, 2, 2) of (xi, eta) with respect to displacements to the east and north.

    Positions (N,) and tangent point (ra, dec) are in degrees.

    ``J[:, 0, 1]`` is d xi / d dec; a displacement to the east is d ra cos(dec).
    """
    delta, d, d0, D = _angles(ra, dec, point, where, row_number)
    out = np.empty((*np.shape(D), 2, 2))
    out[..., 0, 0] = (np.sin(d) * np.sin(d0) * np.cos(delta) + np.cos(d) * np.cos(d0)) / D**2
    out[..., 0, 1] = -np.sin(d0) * np.sin(delta) / D**2
    out[..., 1, 0] = np.sin(d) * np.sin(delta) / D**2
    out[..., 1, 1] = np.cos(delta) / D**2
    return out


def onto_plane(
    ra: Float,
    dec: Float,
    point: tuple[float, float] | None,
    *,
    sigma: Float | None = None,
    rho: Float | None = None,
    motion: Float | None = None,
    sigma_motion: Float | None = None,
    where: str = "",
    place: Place = row_number,
) -> dict[str, Any]:
    """Arguments of `Matches` for stars on a tangent plane, in arcsec.

    They are u, v and tangent_point, rho_uv, and the columns sigma, pm and sigma_pm for u and v if
    these are given.  `ra`, `dec` (N,) and `point` are in degrees; the default point is the mean
    direction.  Errors, motions and their errors (2, N) are to the east (with the factor cos(dec))
    and to the north, in arcsec (per year); `rho` (N,) is the correlation of the errors of
    positions.
    """
    point = mean_direction(ra, dec) if point is None else point
    u, v = tangent_plane(ra, dec, point, where=where, place=place)
    out: dict[str, Any] = {"u": u, "v": v, "tangent_point": (float(point[0]), float(point[1]))}
    if sigma is None and motion is None:
        return out
    J = tangent_jacobian(ra, dec, point, where=where)
    if motion is not None:
        out["pm_u"], out["pm_v"] = np.einsum("nij,jn->in", J, motion)
    for name, errors in (("sigma", sigma), ("sigma_pm", sigma_motion)):
        if errors is not None:
            variance = np.einsum("nij,jn->in", J**2, errors**2)
            out[f"{name}_u"], out[f"{name}_v"] = np.sqrt(variance)
    if sigma is not None and rho is not None:
        out |= errors_of(J @ covariances_of(sigma[0], sigma[1], rho) @ np.swapaxes(J, 1, 2))
    return out


def plane_axes(point: tuple[float, float]) -> Float:
    """Unit vectors to east, north and tangent point (degrees), as rows (3, 3) of a matrix.

    A point on the plane is in the direction (xi, eta, 1) @ rows, with xi and eta in radians.
    """
    a, d = np.radians(point)
    return np.array(
        [
            [-np.sin(a), np.cos(a), 0.0],
            [-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)],
            [np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)],
        ]
    )


def separation(point: tuple[ArrayLike, ArrayLike], ra: ArrayLike, dec: ArrayLike) -> Float:
    """Angular separations (N,) between positions, all in degrees (Vincenty's formula).

    `point` is one position, or the longitudes and latitudes (N,) of as many positions as `ra` and
    `dec`.
    """
    a0, d0, a, d = (np.radians(angle) for angle in (*point, ra, dec))
    cos_a, sin_a = np.cos(a - a0), np.sin(a - a0)
    across = np.hypot(np.cos(d) * sin_a, np.cos(d0) * np.sin(d) - np.sin(d0) * np.cos(d) * cos_a)
    along = np.sin(d0) * np.sin(d) + np.cos(d0) * np.cos(d) * cos_a
    return np.asarray(np.degrees(np.arctan2(across, along)))


def sky_of_plane(xi: ArrayLike, eta: ArrayLike, point: tuple[float, float]) -> tuple[Float, Float]:
    """Right ascension in [0, 360) and declination, in degrees, of positions on a tangent plane.

    `xi` and `eta` are in arcsec, and the tangent point `point` in degrees.
    """
    xi, eta = np.asarray(xi, float) / ARCSEC, np.asarray(eta, float) / ARCSEC
    x, y, z = np.moveaxis(np.stack([xi, eta, np.ones_like(xi)], axis=-1) @ plane_axes(point), -1, 0)
    return np.degrees(np.arctan2(y, x)) % 360.0, np.degrees(np.arctan2(z, np.hypot(x, y)))
