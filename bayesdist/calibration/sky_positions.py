"""Positions on the sky of pixels, with the covariance that a calibration gives them.

With phi the Legendre products at a pixel, S the covariance of the coefficients and A the derivative
of a step on the sky (east, north) by one on the plane, two stars n and m have the covariance

    A_n phi_n S phi_m A_m + A_n T A_m + [n = m] A_n (L + J C J) A_n

where T are errors that all stars of an image share, L those of each star by itself, C that of its
centroid in pixels and J the slope of the map.  Of local errors that are correlated over some pixels
a part is in the covariance of stars of one chip, by their separation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.calibration.further import FurtherError
from bayesdist.calibration.plane import ARCSEC, SkyPlacement
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.matern import correlation_at
from bayesdist.utils.quantities import Direction, Epoch, direction_in, values_in, year_of


@dataclass(frozen=True, eq=False)
class SkyPositions:
    """Positions on the sky (N,) and their covariance."""

    ra: Float  # degrees; NaN for a pixel that is no number
    dec: Float
    cov: Float | None  # (N, 2, 2), to the east and to the north, mas^2; None where nothing is known
    joint: Float | None = None  # (2 N, 2 N), the same of all stars, east and north in turn

    @property
    def sigma(self) -> Float | None:
        """Standard deviations (2, N) to the east and to the north, mas."""
        if self.cov is None:
            return None
        return np.sqrt(np.einsum("naa->an", self.cov))


def sky_positions(
    calibration: Calibration,
    x: ArrayLike,
    y: ArrayLike,
    chip: ArrayLike,
    *,
    epoch: Epoch | None = None,
    point: Direction | None = None,
    placement: SkyPlacement | None = None,
    centroids: tuple[ArrayLike, ArrayLike] | None = None,
    joint: bool = False,
) -> SkyPositions:
    """Positions on the sky of FITS 1-based pixels (N,), with all errors that the calibration knows.

    `chip` is the chip number of each, or of all.  `point` is the sky position of (u, v) = (0, 0) in
    degrees, u to the east and v to the north, in place of the calibration's own; `placement` gives
    other directions of u and v; `centroids` are standard deviations of x and y in pixels; with
    `joint` the covariance of all stars is there.
    InputError for a plane that does not touch the sky and no point, or a unit that is no angle.
    """
    x, y = (np.atleast_1d(values_in(a, "pix", name)) for name, a in (("x", x), ("y", y)))
    epoch = None if epoch is None else year_of(epoch)
    chip = np.broadcast_to(np.asarray(chip, np.int64), x.shape)
    placement = placement or placement_of(calibration, point)
    maps = calibration.with_tables(calibration.at(epoch, origin="stated"))
    plane = np.full((2, x.size), np.nan)
    for number, chip_map in maps.items():
        rows = chip == number
        plane[:, rows] = chip_map.at(x[rows], y[rows])
    ra, dec = placement.sky(plane)
    steps = placement.steps(ra, dec)
    single, whole = plane_covariances(
        calibration, maps, x, y, chip, epoch=epoch, centroids=centroids, joint=joint
    )
    if single is None:
        return SkyPositions(ra, dec, None)
    cov = np.einsum("nab,nbc,ndc->nad", steps, single, steps)
    if whole is None:
        return SkyPositions(ra, dec, cov)
    whole = np.einsum("nab,nbmc,mdc->namd", steps, whole, steps, optimize=True)
    return SkyPositions(ra, dec, cov, whole.reshape(2 * x.size, 2 * x.size))


def plane_covariances(
    calibration: Calibration,
    maps: Mapping[int, ChipMap],
    x: Float,
    y: Float,
    chip: Int,
    *,
    epoch: float | None = None,
    centroids: tuple[ArrayLike, ArrayLike] | None = None,
    joint: bool = False,
) -> tuple[Float | None, Float | None]:
    """Covariances of u, v at FITS 1-based pixels (N,), with all errors that the calibration knows.

    `maps` are those of all chips at the epoch, look-up tables included; other arguments as for
    `sky_positions`.  The first result (N, 2, 2) is for each position and the second (N, 2, N, 2)
    for all, None unless it is asked for with `joint`; both are None if no errors are known.
    """
    if calibration.errors == "none" and not calibration.further and centroids is None:
        return None, None
    slope = np.full((x.size, 2, 2), np.nan)
    for number, chip_map in maps.items():
        rows = chip == number
        slope[rows] = chip_map.slope(x[rows], y[rows])
    own = own_covariances(calibration, slope, centroids)
    shared = shared_covariance(calibration)
    single = own + shared
    for number, chip_map in maps.items():
        rows = chip == number
        from_coefficients = chip_map.covariance_at(x[rows], y[rows])
        if from_coefficients is not None:
            single[rows] += from_coefficients
    if not joint:
        return single, None
    design = designs(calibration, maps, x, y, chip)
    whole = np.einsum(
        "nak,kl,mbl->namb", design, coefficient_covariance(calibration, epoch), design
    )
    whole += shared[None, :, None, :]
    for row in calibration.further:
        if row.correlation:
            nearby = local_correlation(row, x, y, chip)
            whole[:, 0, :, 0] += row.u**2 * nearby
            whole[:, 1, :, 1] += row.v**2 * nearby
    rows = np.arange(x.size)
    whole[rows, :, rows, :] += own
    return single, whole


def placement_of(
    calibration: Calibration,
    point: Direction | None = None,
    *,
    position_angle: float | None = None,
    mirrored: bool = False,
    pixel_scale: float | None = None,
) -> SkyPlacement:
    """Placement of the plane of a calibration on the sky.

    `point` (degrees) is the sky position of (u, v) = (0, 0), in place of that of the plane.
    `position_angle` (degrees, from north to east) is that of the v axis, 0 by default, or of V3 for
    a plane in an aperture with known axes; u is 90 degrees east of v, or west if `mirrored`.
    `pixel_scale` is the size of a pixel in arcsec, for u and v in pixels.
    InputError for a plane in an aperture without position angle, a plane without point, and u and v
    in pixels of unknown size.
    """
    plane = calibration.plane
    if plane.kind == "aperture" and position_angle is None:
        raise InputError(
            "lies in V2, V3 or the Ideal system of an aperture, and not on the sky",
            where=calibration.name,
            do="put it into the image's header by a pipeline, or give a file in TPV or SIP",
        )
    place = plane.point if point is None else direction_in(point, "point")
    if place is None:
        raise InputError(
            "does not say where its plane touches the sky",
            where=calibration.name,
            do="give the point (--point RA DEC on the command line), the sky position of u, v = 0, "
            "if u is east and v is north",
        )
    if calibration.unit in ARCSEC:
        unit = ARCSEC[calibration.unit]
    elif pixel_scale is not None:
        unit = pixel_scale
    else:
        raise InputError(
            f"is in {calibration.unit}, which is no angle on the sky",
            where=calibration.name,
            do="give a calibration in arcsec, mas or deg",
        )
    matrix = np.eye(2)
    if position_angle is not None:
        c, s = np.cos(np.radians(position_angle)), np.sin(np.radians(position_angle))
        matrix = np.array([[c, s], [-s, c]])
        if mirrored:
            matrix = matrix @ np.diag([-1.0, 1.0])
        if plane.kind == "aperture" and plane.to_v2v3 is not None and plane.v2v3 is not None:
            # V2 and V3 are spherical: a step in V2 is an arc shorter by cos V3
            cosine = np.cos(np.radians(plane.v2v3[1] / 3600.0))
            matrix = matrix @ np.diag([cosine, 1.0]) @ plane.to_v2v3
    elif mirrored:
        matrix = np.diag([-1.0, 1.0])
    return SkyPlacement(place, unit * matrix)


def shared_covariance(calibration: Calibration) -> Float:
    """Covariance (2, 2) on the plane of errors that all stars of an image share."""
    rows = [row for row in calibration.further if row.shared]
    return np.diag([float(sum(r.u**2 for r in rows)), float(sum(r.v**2 for r in rows))])


def local_correlation(row: FurtherError, x: Float, y: Float, chip: Int) -> Float:
    """Correlations (N, N) of a local error between different stars; 0 between chips."""
    at = np.column_stack([x, y])
    separation = np.linalg.norm(at[:, None] - at, axis=2)
    out = np.where(chip[:, None] == chip, correlation_at(separation, row.correlation), 0.0)
    np.fill_diagonal(out, 0.0)
    return out


def own_covariances(
    calibration: Calibration, slope: Float, centroids: tuple[ArrayLike, ArrayLike] | None
) -> Float:
    """Covariances (N, 2, 2) on the plane of local errors, and those of each star by itself."""
    alone = [row for row in calibration.further if not row.shared]
    out = np.zeros(slope.shape)
    out[:, 0, 0] = sum(row.u**2 for row in alone)
    out[:, 1, 1] = sum(row.v**2 for row in alone)
    if centroids is not None:
        sigma = np.stack(
            [np.broadcast_to(values_in(s, "pix", "centroids"), len(slope)) for s in centroids]
        )
        out += np.einsum("nab,bn,ncb->nac", slope, sigma**2, slope)
    return out


def coefficient_covariance(calibration: Calibration, epoch: float | None) -> Float:
    """Covariance of the coefficients of all chips; zero where there is none."""
    found = calibration.joint_covariance(calibration.numbers, epoch, origin="stated")
    n = 2 * calibration.model.n_terms * len(calibration.numbers)
    return np.zeros((n, n)) if found is None else found


def designs(
    calibration: Calibration, maps: Mapping[int, ChipMap], x: Float, y: Float, chip: Int
) -> Float:
    """Derivatives (N, 2, n) of positions by the coefficients of all chips."""
    K = calibration.model.n_terms
    out = np.zeros((x.size, 2, 2 * K * len(maps)))
    for k, (number, one) in enumerate(maps.items()):
        mine = np.flatnonzero(chip == number)
        phi = one.design(x[mine], y[mine])
        for axis in (0, 1):
            start = (2 * k + axis) * K
            out[mine, axis, start : start + K] = phi
    return out
