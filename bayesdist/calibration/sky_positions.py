"""Positions on the sky of pixels, with the covariance that a calibration gives them.

With phi the Legendre products at a pixel, S the covariance of the coefficients and A the derivative
of a step on the sky (east, north) by one on the plane, two stars n and m have the covariance

    A_n phi_n S phi_m A_m + A_n T A_m + [n = m] A_n (L + J C J) A_n

where T are errors that all stars of an image share, L those of each star by itself, C that of its
centroid in pixels and J the slope of the map.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.calibration.plane import ARCSEC
from bayesdist.data.sky.tangent import plane_axes, sky_of_plane, tangent_jacobian
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.quantities import (
    Direction,
    Epoch,
    Random,
    direction_in,
    generator_of,
    values_in,
    year_of,
)

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord


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
    centroids: tuple[ArrayLike, ArrayLike] | None = None,
    joint: bool = False,
) -> SkyPositions:
    """Positions on the sky of FITS 1-based pixels (N,), with all errors that the calibration knows.

    `chip` is the chip number of each, or of all.  `point` is the sky position of (u, v) = (0, 0) in
    degrees, u to the east and v to the north, in place of the calibration's own; `centroids` are
    standard deviations of x and y in pixels; with `joint` the covariance of all stars is there.
    InputError for a plane that does not touch the sky and no point, or a unit that is no angle.
    """
    epoch = None if epoch is None else year_of(epoch)
    at = _placed(calibration, x, y, chip, epoch, point)
    step = at.step
    if calibration.errors == "none" and not calibration.further and centroids is None:
        return SkyPositions(at.ra, at.dec, None)
    own, shared = _own(calibration, at.slope, centroids), _shared(calibration)
    single = own + shared
    for number, one in at.maps.items():
        mine = at.chip == number
        found = one.covariance_at(at.x[mine], at.y[mine])
        if found is not None:
            single[mine] += found
    cov = np.einsum("nab,nbc,ndc->nad", step, single, step)
    if not joint:
        return SkyPositions(at.ra, at.dec, cov)
    design = _designs(calibration, at.maps, at.x, at.y, at.chip)
    whole = np.einsum("nak,kl,mbl->namb", design, _coefficients(calibration, epoch), design)
    whole += shared[None, :, None, :]
    rows = np.arange(at.x.size)
    whole[rows, :, rows, :] += own
    whole = np.einsum("nab,nbmc,mdc->namd", step, whole, step, optimize=True)
    return SkyPositions(at.ra, at.dec, cov, whole.reshape(2 * at.x.size, 2 * at.x.size))


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
    centroids: tuple[ArrayLike, ArrayLike] | None = None,
) -> SkyCoord:
    """Random draws of positions on the sky, as a SkyCoord of distributions.

    Parameters
    ----------
    calibration : Calibration
    x, y : array_like, shape (N,)
        FITS 1-based pixels.
    n_draws : int
    rng : int or numpy.random.Generator
        Seed, or source of the random numbers.
    chip : array_like, optional
        Chip number of each position, or of all; it may be left out for a single chip.
    epoch : float, str, Time, date or Quantity, optional
        Needed by a calibration that depends on time.
    point : SkyCoord, or pair of float or Quantity, optional
        Sky position of (u, v) = (0, 0), u to the east and v to the north, in place of the
        calibration's own.
    centroids : pair of array_like, optional
        Standard deviations of x and y in pixels.

    Returns
    -------
    SkyCoord, shape (N,)
        ICRS, with `astropy.uncertainty.Distribution` of `n_draws` values as ra and dec.  A draw has
        the same errors of the calibration for all stars, so that the covariance between positions
        is that of ``sky_positions(..., joint=True)`` within its Monte-Carlo error.

    Raises
    ------
    InputError
        For fewer than two draws, a calibration without errors, a plane that does not touch the sky
        and no point, or a unit that is no angle.

    Notes
    -----
    ``sky.ra.pdf_std()``, transformations to other frames, offsets and the separation from a plain
    SkyCoord work on distributions.  Indexing with a single number and the separation of two such
    objects do not in astropy 8; for these ``SkyCoord(sky.ra.distribution, sky.dec.distribution)``
    is a plain SkyCoord of shape (N, n_draws).
    """
    from astropy import units as apu
    from astropy.coordinates import SkyCoord
    from astropy.uncertainty import Distribution

    if n_draws < 2:
        raise InputError(f"n_draws is {n_draws}", do="ask for two draws or more")
    if calibration.errors == "none" and not calibration.further and centroids is None:
        raise InputError(
            "has no errors to draw from",
            where=calibration.name,
            do="give a calibration with a covariance, or the errors of the centroids",
        )
    if chip is None and len(calibration.numbers) > 1:
        raise InputError(
            "has several chips, and none is named",
            where=calibration.name,
            do=f"give chip, one of {', '.join(map(str, calibration.numbers))}",
        )
    generator = generator_of(rng)
    epoch = None if epoch is None else year_of(epoch)
    numbers = calibration.numbers[0] if chip is None else chip
    at = _placed(calibration, x, y, numbers, epoch, point)
    design = _designs(calibration, at.maps, at.x, at.y, at.chip)
    root = _root(_coefficients(calibration, epoch))
    plane = design @ (root @ generator.standard_normal((len(root), n_draws)))  # (N, 2, n_draws)
    plane += _root(_shared(calibration)) @ generator.standard_normal((2, n_draws))
    own = _root(_own(calibration, at.slope, centroids))
    plane += own @ generator.standard_normal((at.x.size, 2, n_draws))
    east, north = np.moveaxis(np.radians((at.step @ plane) / 3.6e6), 1, 0)
    axes = np.stack([plane_axes((ra, dec)) for ra, dec in zip(at.ra, at.dec, strict=True)])
    vectors = (
        axes[:, 2, :, None]
        + east[:, None] * axes[:, 0, :, None]
        + north[:, None] * axes[:, 1, :, None]
    )
    ra = np.degrees(np.arctan2(vectors[:, 1], vectors[:, 0]))
    # draws on one side of the meridian of each star, so that their mean and scatter make sense
    ra = at.ra[:, None] + (ra - at.ra[:, None] + 180.0) % 360.0 - 180.0
    dec = np.degrees(np.arctan2(vectors[:, 2], np.hypot(vectors[:, 0], vectors[:, 1])))
    return SkyCoord(Distribution(ra * apu.deg), Distribution(dec * apu.deg))


@dataclass(frozen=True, eq=False)
class _Placed:
    """Pixels (N,) with their positions on the sky."""

    maps: dict[int, ChipMap]
    x: Float
    y: Float
    chip: Int
    ra: Float  # degrees; NaN for a pixel that is no number
    dec: Float
    slope: Float  # (N, 2, 2), derivatives of (u, v) with respect to (x, y)
    step: Float  # (N, 2, 2), of (east, north) in mas with respect to (u, v)


def _placed(
    calibration: Calibration,
    x: ArrayLike,
    y: ArrayLike,
    chip: ArrayLike,
    epoch: float | None,
    point: Direction | None,
) -> _Placed:
    px, py = (np.atleast_1d(values_in(one, "pix", name)) for name, one in (("x", x), ("y", y)))
    numbers = np.broadcast_to(np.asarray(chip, np.int64), px.shape)
    touching = None if point is None else direction_in(point, "point")
    origin, unit = _touching(calibration, touching)
    maps = calibration.with_tables(calibration.at(epoch, origin="stated"))
    plane = np.full((2, px.size), np.nan)
    slope = np.full((px.size, 2, 2), np.nan)
    for number, one in maps.items():
        mine = numbers == number
        plane[:, mine] = one.at(px[mine], py[mine])
        slope[mine] = one.slope(px[mine], py[mine])
    ra, dec = sky_of_plane(unit * plane[0], unit * plane[1], origin)
    step = np.full((px.size, 2, 2), np.nan)
    known = np.isfinite(ra)
    # mas on the sky by a unit of the plane
    step[known] = 1e3 * unit * np.linalg.inv(tangent_jacobian(ra[known], dec[known], origin))
    return _Placed(maps, px, py, numbers, ra, dec, slope, step)


def _shared(calibration: Calibration) -> Float:
    """Covariance (2, 2) on the plane of errors that all stars of an image share."""
    rows = [row for row in calibration.further if row.shared]
    return np.diag([float(sum(r.u**2 for r in rows)), float(sum(r.v**2 for r in rows))])


def _root(cov: Float) -> Float:
    """Matrices R with R R^T equal to covariances (..., n, n), which may be singular."""
    values, vectors = np.linalg.eigh(cov)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


def _touching(
    calibration: Calibration, point: tuple[float, float] | None
) -> tuple[tuple[float, float], float]:
    """Point where the plane touches the sky, and arcseconds in its unit."""
    plane = calibration.plane
    if plane.kind == "aperture":
        raise InputError(
            "lies in V2, V3 or the Ideal system of an aperture, and not on the sky",
            where=calibration.name,
            do="put it into the image's header by a pipeline, or give a file in TPV or SIP",
        )
    if point is None:
        point = plane.point
    if point is None:
        raise InputError(
            "does not say where its plane touches the sky",
            where=calibration.name,
            do="give --point RA DEC, the sky position of u, v = 0, if u is east and v is north",
        )
    if calibration.unit not in ARCSEC:
        raise InputError(
            f"is in {calibration.unit}, which is no angle on the sky",
            where=calibration.name,
            do="give a calibration in arcsec, mas or deg",
        )
    return point, ARCSEC[calibration.unit]


def _own(
    calibration: Calibration, slope: Float, centroids: tuple[ArrayLike, ArrayLike] | None
) -> Float:
    """Covariances (N, 2, 2) on the plane of errors that each star has by itself."""
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


def _coefficients(calibration: Calibration, epoch: float | None) -> Float:
    """Covariance of the coefficients of all chips; zero where there is none."""
    found = calibration.joint_covariance(calibration.numbers, epoch, origin="stated")
    n = 2 * calibration.model.n_terms * len(calibration.numbers)
    return np.zeros((n, n)) if found is None else found


def _designs(
    calibration: Calibration, maps: dict[int, ChipMap], x: Float, y: Float, chip: Int
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
