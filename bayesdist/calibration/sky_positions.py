"""Sky positions of pixels, with their covariance according to a calibration or as random draws.

Let phi be the Legendre products at a pixel, S the covariance of the coefficients, and A the
derivative of the offset on the sky (east, north) with respect to the plane (u, v).  The covariance
of the positions of two stars n and m is

    A_n phi_n S phi_m A_m + A_n T A_m + [n = m] A_n (L + J C J) A_n

where T is the covariance of errors that are common to all stars of an image, L that of errors that
are independent for each star, C that of the centroid in pixels, and J the derivative of the map.
Local errors that are correlated over some pixels also contribute to the covariance of stars on the
same chip, depending on their separation.

`sky_distribution` draws positions with all of these errors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import ChipMap, FurtherError, chosen_chip
from bayesdist.calibration.plane import ARCSEC, SkyPlacement
from bayesdist.data.tangent import plane_axes
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.quantities import (
    Direction,
    Epoch,
    Random,
    direction_in,
    generator_of,
    values_in,
    whole_number,
    year_of,
)
from bayesdist.utils.random import correlation_at, drawn_fields

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord


@dataclass(frozen=True, eq=False)
class SkyPositions:
    """Sky positions of N pixels and their covariance."""

    ra: Float  # (N,), degrees; NaN if the pixel is NaN
    dec: Float  # (N,), degrees
    cov: Float | None  # (N, 2, 2), east and north, mas^2; None if no errors are known
    joint: Float | None = None  # (2 N, 2 N), mas^2, of all stars, east and north alternating

    @property
    def sigma(self) -> Float | None:
        """Standard deviations (2, N) to the east and to the north in mas; None if unknown."""
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
    """Sky positions of pixels, with all errors of the calibration.

    Parameters
    ----------
    calibration : Calibration
    x, y : array_like, shape (N,)
        FITS 1-based pixels.
    chip : array_like
        Chip number of each position, or of all positions.
    epoch : float, str, Time or Quantity, optional
        Date, for a calibration that depends on time.
    point : SkyCoord, or pair of float or Quantity, optional
        Sky position of (u, v) = (0, 0), with u to the east and v to the north; by default that of
        the calibration.
    placement : SkyPlacement, optional
        Position and directions of u and v on the sky, instead of `point`.
    centroids : pair of array_like, optional
        Standard deviations of x and y in pixels.
    joint : bool
        True to compute the joint covariance of all stars.

    Returns
    -------
    SkyPositions

    Raises
    ------
    InputError
        If the plane has no position on the sky and no point is given, or the unit is not an angle.
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
    single, joint_cov = plane_covariances(
        calibration, maps, x, y, chip, epoch=epoch, centroids=centroids, joint=joint
    )
    if single is None:
        return SkyPositions(ra, dec, None)
    cov = np.einsum("nab,nbc,ndc->nad", steps, single, steps)
    if joint_cov is None:
        return SkyPositions(ra, dec, cov)
    joint_cov = np.einsum("nab,nbmc,mdc->namd", steps, joint_cov, steps, optimize=True)
    return SkyPositions(ra, dec, cov, joint_cov.reshape(2 * x.size, 2 * x.size))


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
    """Covariances of (u, v) at FITS 1-based pixels (N,), with all errors of the calibration.

    Parameters
    ----------
    calibration : Calibration
    maps : mapping of int to ChipMap
        Maps of all chips at the epoch, with look-up tables.
    x, y, chip, epoch, centroids, joint
        See `sky_positions`.

    Returns
    -------
    single : ndarray, shape (N, 2, 2), or None
        Covariance of each position; None if no errors are known.
    joint : ndarray, shape (N, 2, N, 2), or None
        Covariance of all positions; None unless `joint` is True.
    """
    if calibration.errors == "none" and not calibration.further and centroids is None:
        return None, None
    slope = np.full((x.size, 2, 2), np.nan)
    for number, chip_map in maps.items():
        rows = chip == number
        slope[rows] = chip_map.slope(x[rows], y[rows])
    star_cov = own_covariances(calibration, slope, centroids)
    shared = shared_covariance(calibration)
    single = star_cov + shared
    for number, chip_map in maps.items():
        rows = chip == number
        from_coefficients = chip_map.covariance_at(x[rows], y[rows])
        if from_coefficients is not None:
            single[rows] += from_coefficients
    if not joint:
        return single, None
    design = designs(calibration, maps, x, y, chip)
    joint_cov = np.einsum(
        "nak,kl,mbl->namb", design, coefficient_covariance(calibration, epoch), design
    )
    joint_cov += shared[None, :, None, :]
    for row in calibration.further:
        if row.correlation:
            nearby = local_correlation(row, x, y, chip)
            joint_cov[:, 0, :, 0] += row.u**2 * nearby
            joint_cov[:, 1, :, 1] += row.v**2 * nearby
    rows = np.arange(x.size)
    joint_cov[rows, :, rows, :] += star_cov
    return single, joint_cov


def placement_of(
    calibration: Calibration,
    point: Direction | None = None,
    *,
    position_angle: float | None = None,
    mirrored: bool = False,
    pixel_scale: float | None = None,
) -> SkyPlacement:
    """Placement of the plane of a calibration on the sky.

    Parameters
    ----------
    calibration : Calibration
    point : SkyCoord, or pair of float or Quantity, optional
        Sky position of (u, v) = (0, 0); by default that of the plane.
    position_angle : float, optional
        Position angle, in degrees from north to east, of the v axis, or of V3 for a plane in an
        aperture with known axes; 0 by default.
    mirrored : bool
        True if u is 90 degrees west of v; by default it is 90 degrees east of it.
    pixel_scale : float, optional
        Pixel scale in arcsec per pixel, for u and v in pixels.

    Returns
    -------
    SkyPlacement

    Raises
    ------
    InputError
        If the position angle is missing for a plane in an aperture, the plane has no position on
        the sky and no point is given, or u and v are in pixels of unknown size.
    """
    plane = calibration.plane
    if plane.kind == "aperture" and position_angle is None:
        raise InputError(
            "is in V2, V3 or the Ideal system of an aperture, not on the sky",
            where=calibration.name,
            do="let a pipeline add it to the image's header, or give a TPV or SIP file",
        )
    place = plane.point if point is None else direction_in(point, "point")
    if place is None:
        raise InputError(
            "does not state the tangent point of its plane",
            where=calibration.name,
            do="if u is east and v is north, give the sky position of u, v = 0 (point in Python, "
            "--point RA DEC on the command line)",
        )
    if calibration.unit in ARCSEC:
        unit = ARCSEC[calibration.unit]
    elif pixel_scale is not None:
        unit = pixel_scale
    else:
        raise InputError(
            f"is in {calibration.unit}, which is not an angle",
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
            # V2 and V3 are spherical coordinates: the arc of a step in V2 is shorter by cos V3
            cosine = np.cos(np.radians(plane.v2v3[1] / 3600.0))
            matrix = matrix @ np.diag([cosine, 1.0]) @ plane.to_v2v3
    elif mirrored:
        matrix = np.diag([-1.0, 1.0])
    return SkyPlacement(place, unit * matrix)


def shared_covariance(calibration: Calibration) -> Float:
    """Covariance (2, 2) of (u, v) of errors that are common to all stars of an image."""
    rows = [row for row in calibration.further if row.shared]
    return np.diag([float(sum(r.u**2 for r in rows)), float(sum(r.v**2 for r in rows))])


def local_correlation(row: FurtherError, x: Float, y: Float, chip: Int) -> Float:
    """Correlations (N, N) of a local error between stars; 0 between chips and on the diagonal.

    x and y (N,) are pixels, and `chip` (N,) has the chip number of each star.
    """
    at = np.column_stack([x, y])
    separation = np.linalg.norm(at[:, None] - at, axis=2)
    out = np.where(chip[:, None] == chip, correlation_at(separation, row.correlation), 0.0)
    np.fill_diagonal(out, 0.0)
    return out


def own_covariances(
    calibration: Calibration, slope: Float, centroids: tuple[ArrayLike, ArrayLike] | None
) -> Float:
    """Covariances (N, 2, 2) of (u, v) of each star: local, random and centroid errors.

    `slope` (N, 2, 2) are the derivatives of (u, v) with respect to the pixels, and `centroids` the
    standard deviations of x and y in pixels.
    """
    not_shared = [row for row in calibration.further if not row.shared]
    out = np.zeros(slope.shape)
    out[:, 0, 0] = sum(row.u**2 for row in not_shared)
    out[:, 1, 1] = sum(row.v**2 for row in not_shared)
    if centroids is not None:
        sigma = np.stack(
            [np.broadcast_to(values_in(s, "pix", "centroids"), len(slope)) for s in centroids]
        )
        out += np.einsum("nab,bn,ncb->nac", slope, sigma**2, slope)
    return out


def coefficient_covariance(calibration: Calibration, epoch: float | None) -> Float:
    """Covariance (n, n) of the n coefficients of all chips; zero if no errors are known."""
    cov = calibration.joint_covariance(calibration.numbers, epoch, origin="stated")
    n = 2 * calibration.model.n_terms * len(calibration.numbers)
    return np.zeros((n, n)) if cov is None else cov


def designs(
    calibration: Calibration, maps: Mapping[int, ChipMap], x: Float, y: Float, chip: Int
) -> Float:
    """Derivatives (N, 2, n) of (u, v) with respect to the coefficients of all chips.

    `maps` are the maps of the chips by number, and x, y and `chip` (N,) the pixels and chip
    numbers.
    """
    K = calibration.model.n_terms
    out = np.zeros((x.size, 2, 2 * K * len(maps)))
    for k, (number, chip_map) in enumerate(maps.items()):
        rows = np.flatnonzero(chip == number)
        phi = chip_map.design(x[rows], y[rows])
        for axis in (0, 1):
            start = (2 * k + axis) * K
            out[rows, axis, start : start + K] = phi
    return out


def sky_distribution(
    calibration: Calibration,
    x: ArrayLike,
    y: ArrayLike,
    *,
    n_draws: int = 1000,
    rng: Random,
    chip: ArrayLike | None = None,
    epoch: Epoch | None = None,
    point: Direction | None = None,
    placement: SkyPlacement | None = None,
    centroids: tuple[ArrayLike, ArrayLike] | None = None,
) -> SkyCoord:
    """Random draws of positions on the sky, as a SkyCoord of distributions.

    Parameters
    ----------
    calibration : Calibration
    x, y : array_like, shape (N,)
        FITS 1-based pixels.
    n_draws : int
        Number of draws, at least 2.
    rng : int or numpy.random.Generator
        Seed or random generator.
    chip : array_like, optional
        Chip number of each position, or of all positions; not needed if there is only one chip.
    epoch : float, str, Time, date or Quantity, optional
        Date, for a calibration that depends on time.
    point : SkyCoord, or pair of float or Quantity, optional
        Sky position of (u, v) = (0, 0), with u to the east and v to the north; by default that of
        the calibration.
    placement : SkyPlacement, optional
        Position and directions of u and v on the sky, instead of `point`.
    centroids : pair of array_like, optional
        Standard deviations of x and y in pixels.

    Returns
    -------
    SkyCoord, shape (N,)
        ICRS positions; ra and dec are `astropy.uncertainty.Distribution` of `n_draws` values.  All
        stars of a draw have the same errors of the calibration, so that the covariance between
        positions agrees with ``sky_positions(..., joint=True)`` within its Monte-Carlo error.

    Raises
    ------
    InputError
        If fewer than two draws are requested, the calibration has no errors, the plane has no
        position on the sky and no point is given, or the unit is not an angle.

    Notes
    -----
    Distributions support ``sky.ra.pdf_std()``, transformations to other frames, offsets, and the
    separation from a plain SkyCoord.  In astropy 8 they do not support indexing with a single
    number or the separation of two such objects.  For these, use the plain SkyCoord of shape
    (N, n_draws) ``SkyCoord(sky.ra.distribution, sky.dec.distribution)``.
    """
    from astropy import units as apu
    from astropy.coordinates import SkyCoord
    from astropy.uncertainty import Distribution

    n_draws = whole_number(n_draws, "n_draws", least=2)
    if calibration.errors == "none" and not calibration.further and centroids is None:
        raise InputError(
            "has no errors to draw",
            where=calibration.name,
            do="give a calibration with a covariance, or the errors of the centroids",
        )
    if chip is None:
        chosen_chip(calibration.numbers, chip, where=calibration.name)
    generator = generator_of(rng)
    epoch = None if epoch is None else year_of(epoch)
    px, py = (np.atleast_1d(values_in(a, "pix", name)) for name, a in (("x", x), ("y", y)))
    numbers = np.broadcast_to(
        np.asarray(calibration.numbers[0] if chip is None else chip, np.int64), px.shape
    )
    placement = placement or placement_of(calibration, point)
    maps = calibration.with_tables(calibration.at(epoch, origin="stated"))
    plane, slope = np.full((2, px.size), np.nan), np.full((px.size, 2, 2), np.nan)
    for number, chip_map in maps.items():
        rows = numbers == number
        plane[:, rows] = chip_map.at(px[rows], py[rows])
        slope[rows] = chip_map.slope(px[rows], py[rows])
    ra, dec = placement.sky(plane)
    root = _root(coefficient_covariance(calibration, epoch))
    design = designs(calibration, maps, px, py, numbers)
    errors = design @ (root @ generator.standard_normal((len(root), n_draws)))  # (N, 2, n_draws)
    errors += _root(shared_covariance(calibration)) @ generator.standard_normal((2, n_draws))
    star_covariance = own_covariances(calibration, slope, centroids)
    for row in calibration.further:
        if not row.correlation:
            continue
        fraction = sum(part for part, _ in row.correlation)
        for axis, sigma in enumerate((row.u, row.v)):
            star_covariance[:, axis, axis] -= fraction * sigma**2
            for number in np.unique(numbers):
                on_chip = np.flatnonzero(numbers == number)
                at = np.column_stack([px[on_chip], py[on_chip]])
                field = drawn_fields(at, row.correlation, n_draws, generator)
                errors[on_chip, axis] += sigma * field
    star_root = _root(star_covariance)
    errors += star_root @ generator.standard_normal((px.size, 2, n_draws))
    steps = placement.steps(ra, dec)  # mas to the east and to the north
    drawn_ra, drawn_dec = _moved(ra, dec, np.radians((steps @ errors) / 3.6e6))
    return SkyCoord(Distribution(drawn_ra * apu.deg), Distribution(drawn_dec * apu.deg))


def _moved(ra: Float, dec: Float, offset: Float) -> tuple[Float, Float]:
    """RA and Dec (N, n) in degrees after small offsets (N, 2, n) to east and north in radians."""
    axes = np.stack(
        [plane_axes(direction) for direction in zip(ra.tolist(), dec.tolist(), strict=True)]
    )
    vectors = axes[:, 2, :, None] + np.einsum("nad,nax->nxd", offset, axes[:, :2])
    x, y, z = np.moveaxis(vectors, 1, 0)
    moved = np.degrees(np.arctan2(y, x))
    # no jumps by 360 degrees between the draws of a star, so that mean and scatter are meaningful
    moved = ra[:, None] + (moved - ra[:, None] + 180.0) % 360.0 - 180.0
    return moved, np.degrees(np.arctan2(z, np.hypot(x, y)))


def _root(cov: Float) -> Float:
    """Matrix square roots R, with R R^T = cov, of covariances (..., n, n) that may be singular."""
    values, vectors = np.linalg.eigh(cov)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])
