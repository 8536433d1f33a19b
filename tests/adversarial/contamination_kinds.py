"""Kinds of truth in which some stars are not what their row says, more of them here than there.

A robust fit leaves out what lies far off, and follows what lies within a few standard deviations.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from . import fields
from .star_kinds import BRIGHT, FAINT, OF_MAGNITUDE, centroid_sigma, magnitudes
from .static_kinds import CATALOGUE_WORDS, STRUCTURE
from .truth import SIGMA, Frame, Piece, Truth, kind, mapped, observed, order_config, pixels

MIXED = (
    *("unlabelled", "visit", "blend", "ghost", "lopsided", "one-sided", "one side", "skew"),
    *("two cores", "bimodal", "asymmetric", "contaminat", "two populations"),
)
OF_FALSE = ("false", "chance", "outlier", *MIXED)
OF_LABELS = ("wrong exposure", "label", *MIXED)
# what makes no error smaller where some stars are displaced
NO_HELP = (
    "raise model.order",
    "scale_mas",
    "are too small",
    "depend on position",
    "give larger errors",
)

contaminated = partial(kind, kindest=True, misleading=NO_HELP)

Share = Callable[[np.ndarray, np.ndarray], np.ndarray]  # x, y (N,) -> probability (N,)


def rising(low: float, high: float, axis: int = 0) -> Share:
    """A share that goes linearly from one edge of the detector to the other."""
    return lambda *at: low + (high - low) * (fields.scaled(at[axis]) + 1) / 2


def around(centre: np.ndarray, scale: float, most: float) -> Share:
    """A share that falls off as a Gaussian about a pixel."""

    def share(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        square = (np.asarray(x) - centre[0]) ** 2 + (np.asarray(y) - centre[1]) ** 2
        return most * np.exp(-square / (2 * scale**2))

    return share


def direction(rng: np.random.Generator) -> np.ndarray:
    """A unit vector (2,)."""
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def some_displaced(
    rng: np.random.Generator, share: Share, shift: Callable[[int], np.ndarray]
) -> Callable[..., np.ndarray]:
    """Displacements (N, 2) of some detections, by their probability at a pixel."""

    def of_blends(x: np.ndarray, y: np.ndarray, *_: object) -> np.ndarray:
        return (rng.uniform(size=np.shape(x)) < share(x, y))[:, None] * shift(len(x))

    return of_blends


def displaced(
    rng: np.random.Generator,
    n: int,
    share: Share,
    shift: Callable[[int], np.ndarray],
    false: float = 0.04,
) -> Truth:
    """Stars of a polynomial, some of them displaced.

    Parameters
    ----------
    rng : numpy.random.Generator
    n : int
        Stars.
    share : callable
        Probability that a star is displaced, by its pixels.
    shift : callable
        Number of stars to displacements (n, 2) in pixels.
    false : float
        Fraction of false matches, which are even.
    """
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, n)
    moved = (rng.uniform(size=n) < share(x, y))[:, None] * shift(n)
    stars = observed(rng, x, y, true_map(x, y, None) + moved, false=false)
    return Truth(stars, true_map, order_config(3))


@contaminated("merged_visits_050", *MIXED, n=2000, step=0.05)
@contaminated("merged_visits_150", *MIXED, n=2000, step=0.15)
def merged_visits(rng: np.random.Generator, n: int, step: float) -> Truth:
    """Two visits, the first of which has more stars at one edge and the second at the other, differ
    by a shift; the table does not say which star is of which visit."""
    way = step * direction(rng)
    return displaced(rng, n, rising(0.1, 0.9), lambda m: np.tile(way, (m, 1)))


@contaminated("merged_visits_turned", *MIXED, n=2000)
def merged_visits_turned(rng: np.random.Generator, n: int) -> Truth:
    """Two such visits differ by a rotation, 0.08 px at half a side."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, n)
    w = true_map(x, y, None)
    second = rng.uniform(size=n) < rising(0.1, 0.9)(x, y)
    w = w + second[:, None] * 8e-5 * np.column_stack([-w[:, 1], w[:, 0]])
    return Truth(observed(rng, x, y, w), true_map, order_config(3))


@contaminated("tail_by_position_030", *MIXED, n=2500, size=0.03)
@contaminated("tail_by_position_080", *MIXED, n=2500, size=0.08)
def tail_by_position(rng: np.random.Generator, n: int, size: float) -> Truth:
    """Errors have an exponential tail to one side: of half of the stars at one edge, of none at
    the other."""
    way = size * direction(rng)
    return displaced(rng, n, rising(0.0, 0.5, 1), lambda m: rng.exponential(size=(m, 1)) * way)


@contaminated("tail_turning", *MIXED, n=2500)
def tail_turning(rng: np.random.Generator, n: int) -> Truth:
    """A quarter of the stars have a tail outwards from the middle, as of coma."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, n)
    tailed = (rng.uniform(size=n) < 0.35)[:, None] * rng.exponential(0.06, (n, 1))
    stars = observed(rng, x, y, true_map(x, y, None) + tailed * fields.radius(x, y))
    return Truth(stars, true_map, order_config(3))


@contaminated("halo_400", *OF_FALSE, n=2500, width=400.0, sigmas=4.0)
@contaminated("halo_900", *OF_FALSE, n=2500, width=900.0, sigmas=2.5)
def halo(rng: np.random.Generator, n: int, width: float, sigmas: float) -> Truth:
    """About a bright star 45 % of the matches are false, and all displaced in one direction."""
    centre, way = rng.uniform(500, fields.SIDE - 500, 2), sigmas * SIGMA * direction(rng)
    share = around(centre, width / 2.355, 0.45)
    return displaced(rng, n, share, lambda m: way + 0.5 * SIGMA * rng.standard_normal((m, 2)))


@contaminated("ghost_ring", *OF_FALSE, n=2500)
def ghost_ring(rng: np.random.Generator, n: int) -> Truth:
    """In a ring that a reflection lights, stars are drawn towards its middle by 0.05 px, half of
    them."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, n)
    away = np.column_stack([x, y]) - rng.uniform(700, 1350, 2)
    r = np.linalg.norm(away, axis=1)
    lit = (np.abs(r - 550) < 180) & (rng.uniform(size=n) < 0.5)
    moved = -0.05 * lit[:, None] * away / r[:, None]
    return Truth(observed(rng, x, y, true_map(x, y, None) + moved), true_map, order_config(3))


@contaminated("blends_of_faint_stars", *MIXED, *OF_MAGNITUDE, n=2500)
def blends_of_faint_stars(rng: np.random.Generator, n: int) -> Truth:
    """Faint stars on the crowded side are drawn to brighter neighbours, which lie further into
    the crowd; the true map is that of stars alone."""
    true_map = mapped(fields.distortion(rng))
    (x, y), mag = pixels(rng, n), magnitudes(rng, n)
    share = rising(0.0, 0.5)(x, y) * (mag - BRIGHT) / (FAINT - BRIGHT)
    pull = (rng.uniform(size=n) < share) * rng.exponential(0.06, n)
    moved = pull[:, None] * np.array([1.0, 0.0])
    sigma = centroid_sigma(mag)[:, None]
    stars = observed(rng, x, y, true_map(x, y, None) + moved, sigma=sigma, mag=mag)
    return Truth(stars, true_map, order_config(3))


@contaminated("saturated_corner", *MIXED, *OF_MAGNITUDE, "corner", n=2500)
def saturated_corner(rng: np.random.Generator, n: int) -> Truth:
    """Bright stars in one corner are saturated, and displaced along a spike by 0.1 px."""
    true_map = mapped(fields.distortion(rng))
    (x, y), mag = pixels(rng, n), magnitudes(rng, n)
    corner = around(np.array([fields.SIDE, fields.SIDE]), 600.0, 1.0)(x, y)
    saturated = (mag < -11.8) & (rng.uniform(size=n) < corner)
    moved = 0.1 * saturated[:, None] * direction(rng)
    sigma = centroid_sigma(mag)[:, None]
    stars = observed(rng, x, y, true_map(x, y, None) + moved, sigma=sigma, mag=mag)
    return Truth(stars, true_map, order_config(3))


@contaminated("false_35_gradient", *OF_FALSE, n=2500)
def false_35_gradient(rng: np.random.Generator, n: int) -> Truth:
    """Of the matches 10 % are false at one edge and 60 % at the other, and more of the false ones
    lie towards the crowded side."""
    toward = direction(rng)

    def chance(m: int) -> np.ndarray:
        r, angle = np.sqrt(rng.uniform(size=m)), rng.uniform(0, 2 * np.pi, m)
        at = np.column_stack([np.cos(angle), np.sin(angle)]) * r[:, None]
        flip = rng.uniform(size=m) > (1 + at @ toward) / 2  # density 1 + z along the gradient
        return np.where(flip[:, None], -at, at)

    return displaced(rng, n, rising(0.1, 0.6), chance, false=0.0)


@kind("motions_missing", *MIXED, *CATALOGUE_WORDS, "motion", kindest=True, n=2500)
def motions_missing(rng: np.random.Generator, n: int) -> Truth:
    """A third of the stars have no motions in the catalogue, nearly all on one side, where a
    survey ends; a bulk motion of 0.04 px is left in these."""
    way = 0.04 * direction(rng)
    return displaced(rng, n, rising(-0.3, 0.95), lambda m: way + 0.02 * rng.standard_normal((m, 2)))


@kind("half_another_epoch", *MIXED, *CATALOGUE_WORDS, *STRUCTURE, "epoch", kindest=True, n=2500)
def half_another_epoch(rng: np.random.Generator, n: int) -> Truth:
    """Half of the field is from another epoch: its stars have moved by 0.03 px all together and by
    0.015 px each; the true map is that of either epoch."""
    way, edge = 0.03 * direction(rng), rng.uniform(0.4, 0.6) * fields.SIDE
    return displaced(
        rng, n, lambda x, y: x > edge, lambda m: way + 0.015 * rng.standard_normal((m, 2))
    )


@contaminated("two_cores_by_row", *MIXED, n=2500)
def two_cores_by_row(rng: np.random.Generator, n: int) -> Truth:
    """Images are double towards the upper rows, and a centroid is that of the one or the other,
    0.07 px apart; the true map is that of the first."""
    way = 0.07 * direction(rng)
    return displaced(rng, n, rising(0.0, 0.5, 1), lambda m: np.tile(way, (m, 1)))


@contaminated("wrong_exposure_names", *OF_LABELS, n=3000)
def wrong_exposure_names(rng: np.random.Generator, n: int) -> Truth:
    """Six exposures a tenth of a pixel apart; a quarter of the stars of the upper rows have the
    name of the exposure before, none of the lower rows."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, n)
    code = rng.integers(6, size=n)
    shifts = 0.1 * np.cumsum(np.tile(direction(rng), (6, 1)), axis=0)
    wrong = rng.uniform(size=n) < rising(0.0, 0.4, 1)(x, y)
    names = np.array([f"e{k}" for k in (code - wrong) % 6])
    frames = {f"e{k}": Frame((float(s[0]), float(s[1])), 0.0) for k, s in enumerate(shifts)}
    stars = observed(rng, x, y, true_map(x, y, None) + shifts[code], exposure=names)
    config = order_config(3, frames="shift_rotation")
    return Truth(stars, true_map, config, None, frames)


CHANNELS = (
    Piece(1, fields.SIDE, fields.SIDE, 0.0),
    Piece(2, fields.SIDE, fields.SIDE, fields.SIDE),
)


@contaminated("wrong_chip", *OF_LABELS, "wrong chip", n=3000)
def wrong_chip(rng: np.random.Generator, n: int) -> Truth:
    """Two channels see the same field through optics that differ by 0.1 px rms; of 6 % of the rows,
    most of them of one side, the number of the channel is that of the other one."""
    first = mapped(fields.distortion(rng))
    apart = fields.of_rms(fields.random_polynomial(rng, {0: 1.0, 1: 1.0, 2: 1.0}), 0.1)

    def true_map(x: np.ndarray, y: np.ndarray, epoch: float | None = None) -> np.ndarray:
        second = np.asarray(y) > fields.SIDE + 0.5  # in the mosaic above the first one
        y = y - fields.SIDE * second
        return first(x, y, epoch) + second[..., None] * apart(x, y)

    x, y = pixels(rng, n)
    second = rng.uniform(size=n) < 0.5
    wrong = rng.uniform(size=n) < rising(0.0, 0.12)(x, y)
    seen = true_map(x, y + fields.SIDE * second)
    stars = observed(rng, x, y, seen, chip=np.where(second ^ wrong, 2, 1))
    return Truth(stars, true_map, order_config(3), chips=CHANNELS)
