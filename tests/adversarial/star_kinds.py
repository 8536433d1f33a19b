"""Kinds of truth whose stars are not measured as is quoted; the map is in the family."""

from __future__ import annotations

import numpy as np

from . import fields
from .static_kinds import CATALOGUE_WORDS, STRUCTURE
from .truth import (
    FALSE,
    SIGMA,
    Map,
    Truth,
    kind,
    mapped,
    normal_noise,
    observed,
    order_config,
    pixels,
)

QUOTED = ("quoted", "errors are too small", "jitter", "noise")
OF_MAGNITUDE = ("magnitude", "brightness", "bright stars", "faint stars")

BRIGHT, FAINT = -14.0, -10.0  # instrumental magnitudes


def magnitudes(rng: np.random.Generator, n: int) -> np.ndarray:
    """Instrumental magnitudes (n,), faint stars more often than bright ones."""
    return FAINT - (FAINT - BRIGHT) * (1 - np.sqrt(rng.uniform(size=n)))


def centroid_sigma(mag: np.ndarray) -> np.ndarray:
    """What is quoted of each star, on either axis."""
    return np.hypot(0.01, 0.04 * 10 ** (0.2 * (mag - FAINT)))


@kind("inside_magnitudes", inside=True)
def inside_magnitudes(rng: np.random.Generator, n: int) -> Truth:
    """Errors are as quoted, by magnitude; nothing depends on magnitude or colour."""
    true_map = mapped(fields.distortion(rng))
    (x, y), mag = pixels(rng, n), magnitudes(rng, n)
    columns = {"mag": mag, "colour": 1.0 + 0.6 * rng.standard_normal(n)}
    sigma = centroid_sigma(mag)[:, None]
    stars = observed(rng, x, y, true_map(x, y, None), sigma=sigma, **columns)
    return Truth(stars, true_map, order_config(3))


@kind("inside_tilted", inside=True, quoted=True)
@kind("tilted_as_round", *QUOTED, "axis", "axes", quoted=False)
def tilted(rng: np.random.Generator, n: int, quoted: bool) -> Truth:
    """Errors along u and v are correlated by 0.9 on one side of the detector, and by -0.9 on the
    other; the table states it, or only the errors on both axes."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, n)
    rho = np.where(x < fields.SIDE / 2, 0.9, -0.9)
    a, b = rng.standard_normal((2, n))
    noise = SIGMA * np.stack([a, rho * a + np.sqrt(1 - rho**2) * b], axis=1)
    more = {"rho_uv": rho} if quoted else {}
    stars = observed(rng, x, y, true_map(x, y, None), noise=noise, **more)
    return Truth(stars, true_map, order_config(3))


@kind("noise_corner", *QUOTED, "corner")
def noise_corner(rng: np.random.Generator, n: int) -> Truth:
    """Errors are five times the quoted ones in one corner, a sixteenth of the detector."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, n)
    corner = (x > 0.75 * fields.SIDE) & (y > 0.75 * fields.SIDE)
    noise = normal_noise(rng, n, SIGMA * np.where(corner, 5.0, 1.0)[:, None])
    return Truth(observed(rng, x, y, true_map(x, y, None), noise=noise), true_map, order_config(3))


@kind("noise_axis", *QUOTED, "axis", "axes")
def noise_axis(rng: np.random.Generator, n: int) -> Truth:
    """Errors of v are twice the quoted ones."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, n)
    noise = normal_noise(rng, n, SIGMA * np.array([1.0, 2.0]))
    return Truth(observed(rng, x, y, true_map(x, y, None), noise=noise), true_map, order_config(3))


@kind("noise_bright", *QUOTED, *OF_MAGNITUDE)
def noise_bright(rng: np.random.Generator, n: int) -> Truth:
    """Errors of stars brighter than the middle magnitude are three times the quoted ones."""
    true_map = mapped(fields.distortion(rng))
    (x, y), mag = pixels(rng, n), magnitudes(rng, n)
    sigma = centroid_sigma(mag)[:, None]
    noise = normal_noise(rng, n, sigma * np.where(mag < -12.0, 3.0, 1.0)[:, None])
    stars = observed(rng, x, y, true_map(x, y, None), noise=noise, sigma=sigma, mag=mag)
    return Truth(stars, true_map, order_config(3))


@kind("two_populations", *QUOTED)
def two_populations(rng: np.random.Generator, n: int) -> Truth:
    """Errors of 30 % of the stars are three times the quoted ones."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, n)
    factor = np.where(rng.uniform(size=n) < 0.3, 3.0, 1.0)[:, None]
    noise = normal_noise(rng, n, SIGMA * factor)
    return Truth(observed(rng, x, y, true_map(x, y, None), noise=noise), true_map, order_config(3))


@kind("charge_trails", *OF_MAGNITUDE, "charge transfer", "cte", n=3000)
def charge_trails(rng: np.random.Generator, n: int) -> Truth:
    """Trails draw stars along y, 0.005 px per magnitude fainter than the brightest at full
    distance from the amplifier; the true map is that of stars without trails."""
    true_map = mapped(fields.distortion(rng))
    (x, y), mag = pixels(rng, n), magnitudes(rng, n)
    trail = 0.005 * (mag - BRIGHT) * (fields.SIDE - y) / fields.SIDE
    stars = observed(rng, x, y, true_map(x, y - trail, None), mag=mag)
    return Truth(stars, true_map, order_config(3))


@kind("brighter_fatter", *OF_MAGNITUDE, "brighter-fatter", n=3000)
def brighter_fatter(rng: np.random.Generator, n: int) -> Truth:
    """Bright stars are displaced along y in proportion to their flux, up to 0.01 px, and more so
    in the upper rows; the true map is that of faint stars."""
    true_map = mapped(fields.distortion(rng))
    (x, y), mag = pixels(rng, n), magnitudes(rng, n)
    shift = 0.01 * 10 ** (-0.4 * (mag - BRIGHT)) * (1 + fields.scaled(y))
    stars = observed(rng, x, y, true_map(x, y - shift, None), mag=mag)
    return Truth(stars, true_map, order_config(3))


@kind("colour_gradient", "colour", "color", kindest=True, n=3000, lateral=0.008, tilt=0.9)
@kind("colour_with_column", "colour", "color", n=3000)
@kind("colour_without_column", "colour", "color", *STRUCTURE, n=3000, column=False)
def colour(
    rng: np.random.Generator,
    n: int,
    column: bool = True,
    lateral: float = 0.004,
    tilt: float = 0.5,
) -> Truth:
    """Lateral colour, so many px per magnitude at half a side from the middle, of stars that are
    redder on one side of the field; the true map is that of stars of colour 1."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, n)
    colours = 1.0 + 0.6 * rng.standard_normal(n) + tilt * fields.scaled(x)
    moved = lateral * (colours - 1.0)[:, None] * fields.radius(x, y)
    columns = {"colour": colours} if column else {}
    stars = observed(rng, x, y, true_map(x, y, None) + moved, **columns)
    return Truth(stars, true_map, order_config(3))


@kind("blends", *STRUCTURE, "skew", "blend", "crowd", "asymmetric", n=3000)
def blends(rng: np.random.Generator, n: int) -> Truth:
    """Stars crowd towards the middle, and there 10 % of all are blends, displaced to one side."""
    true_map = mapped(fields.distortion(rng))
    even, middle = pixels(rng, n), fields.MIDDLE + 350 * rng.standard_normal((2, n))
    crowd = (rng.uniform(size=n) < 0.5) & (np.abs(middle - fields.MIDDLE).max(axis=0) < 1020)
    x, y = np.where(crowd, middle, even)
    blended = rng.uniform(size=n) < 0.2 * crowd
    shift = blended[:, None] * rng.exponential([0.05, 0.025], (n, 2))
    return Truth(observed(rng, x, y, true_map(x, y, None) + shift), true_map, order_config(3))


@kind("wrong_epochs", *CATALOGUE_WORDS, *QUOTED, "motion", "epoch")
def wrong_epochs(rng: np.random.Generator, n: int) -> Truth:
    """Motions of the stars since the catalogue's epoch are left out: 0.03 px of each star by
    itself, and 0.01 px of all on the mean."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, n)
    angle = rng.uniform(0, 2 * np.pi)
    motion = 0.01 * np.array([np.cos(angle), np.sin(angle)]) + 0.03 * rng.standard_normal((n, 2))
    return Truth(observed(rng, x, y, true_map(x, y, None) + motion), true_map, order_config(3))


RADIUS = ("match radius", "match_radius", "truncat", "cut off")
NO_RADIUS = ("raise model.order", "scale_mas", "are too small", "depend on position")


@kind("stated_100_cut_025", *RADIUS, kindest=True, misleading=NO_RADIUS, cut=0.25, stated=1.0)
@kind("stated_060_cut_015", *RADIUS, kindest=True, misleading=NO_RADIUS, cut=0.15, stated=0.6)
@kind("stated_015_cut_040", *RADIUS, kindest=True, misleading=NO_RADIUS, cut=0.4, stated=0.15)
def stated_radius(rng: np.random.Generator, n: int, cut: float, stated: float) -> Truth:
    """The radius of the match is not the one that is stated; a fifth of the matches are false, and
    even within the true radius."""
    stars, true_map = matched_within(rng, n, cut, noise=0.04, off=0.06, false=0.2)
    outliers = {"model": "uniform", "match_radius": stated}
    return Truth(stars, true_map, order_config(3) | {"outliers": outliers})


@kind("cut_at_4.0", *RADIUS, sigmas=4.0)
@kind("cut_at_3.0", *RADIUS, sigmas=3.0)
@kind("cut_at_2.4", *RADIUS, sigmas=2.4)
def cut(rng: np.random.Generator, n: int, sigmas: float) -> Truth:
    """Only stars within so many sigmas (of one axis, 0.05 px) of a nominal solution were matched,
    which is off by 0.08 px rms; false matches are even within that radius."""
    radius = sigmas * 0.05
    stars, true_map = matched_within(rng, n, radius, noise=0.05, off=0.08, false=FALSE)
    outliers = {"model": "uniform", "match_radius": radius}
    return Truth(stars, true_map, order_config(3) | {"outliers": outliers})


def matched_within(
    rng: np.random.Generator, n: int, radius: float, *, noise: float, off: float, false: float
) -> tuple[dict[str, np.ndarray], Map]:
    """Stars that were matched within a radius of a nominal solution, and the true map.

    The nominal solution is off by a smooth field of rms `off`.  Of the matches a fraction `false`
    are false, and even within the radius.
    """
    true_map = mapped(fields.distortion(rng))
    error = fields.smooth(rng, 700, off / np.sqrt(2))
    x, y = pixels(rng, 8 * n)
    residual = normal_noise(rng, x.size, noise)
    kept = np.linalg.norm(residual - error(x, y), axis=1) < radius
    chance = rng.uniform(size=x.size) < false * kept.mean()  # of those that stay
    inner = radius * np.sqrt(rng.uniform(size=(x.size, 1)))
    angle = rng.uniform(0, 2 * np.pi, x.size)
    anywhere = error(x, y) + inner * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    residual = np.where(chance[:, None], anywhere, residual)
    rows = np.flatnonzero(kept | chance)[:n]
    x, y, residual = x[rows], y[rows], residual[rows]
    uv = true_map(x, y, None)
    return observed(rng, x, y, uv, noise=residual, sigma=noise, false=0.0), true_map
