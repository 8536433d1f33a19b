"""Sky positions as distributions: random draws of all errors of a calibration."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import chosen_chip
from bayesdist.calibration.plane import SkyPlacement
from bayesdist.calibration.sky_positions import (
    coefficient_covariance,
    designs,
    own_covariances,
    placement_of,
    shared_covariance,
)
from bayesdist.data.sky import plane_axes
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float
from bayesdist.utils.matern import drawn_fields
from bayesdist.utils.quantities import (
    Direction,
    Epoch,
    Random,
    generator_of,
    values_in,
    whole_number,
    year_of,
)

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord


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
            "has no errors that could be drawn",
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
