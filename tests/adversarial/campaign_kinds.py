"""Kinds of campaigns: star lists of many exposures, whose truth is outside the fitted family."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from . import fields
from .campaign_truth import BRIGHT, LAST, REACH, CampaignTruth, Recipe, made
from .contamination_kinds import MIXED, direction, rising, some_displaced
from .exposure_kinds import BREATHING, OF_TIME, heavy_deviations, linear, normal_deviations
from .star_kinds import OF_MAGNITUDE
from .static_kinds import CATALOGUE_WORDS, ORDER, STRUCTURE
from .time_kinds import IN_TIME, autoregressive
from .truth import TWO, kind
from .varying_kinds import NO_HELP, OF_FIELDS, VARYING

QUIET = 3e-6  # scatter of scale and shears, where breathing is not what is asked about
RATE = 0.004  # px a year at half a side: of each of the linear terms that drift
BEGIN = 2008.5  # trails of charge are noticed from then on
TRAIL = 0.008  # px a magnitude, at the end and far from the amplifier
OPENING = 0.006  # px a year
PERIOD, RAMP = 68.27, 0.008  # px: of the lithographic pattern of ACS/WFC
OF_GAP = ("gap", "drifts with time")
MAS = 0.02  # px a year: 1 mas a year of a detector with 50 mas a pixel


def drift(rng: np.random.Generator) -> fields.Field:
    """The three linear terms that are fitted."""
    return linear(*(RATE * rng.standard_normal(3)))


def quiet_deviations(rng: np.random.Generator, n: int) -> np.ndarray:
    """Scale and both shears (n, 3) of exposures, which hardly vary."""
    return QUIET / BREATHING * normal_deviations(rng, n)


def chip_by_chip(field: fields.Field) -> fields.Field:
    """A field about the middle of each of two chips: the gap between them has no drift."""

    def of_chip(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        half = fields.SIDE / 4
        return field(x, np.asarray(y) - np.where(np.asarray(y) > 2 * half + 0.5, half, -half))

    return of_chip


def usual(rng: np.random.Generator, **other: object) -> CampaignTruth:
    """A campaign of exposures whose linear terms drift, and what comes beside it."""
    options = {"rate": drift(rng), "deviations": quiet_deviations, "beyond": 1.0} | other
    return made(rng, Recipe(**options))  # type: ignore[arg-type]


def trailing(x: np.ndarray, y: np.ndarray, mag: np.ndarray, epoch: float) -> np.ndarray:
    """Displacements (N, 2) by trails of charge, which grow from `BEGIN` on."""
    size = TRAIL * max(epoch - BEGIN, 0.0) / (LAST - BEGIN)
    trail = size * (mag - BRIGHT) * (fields.SIDE - y) / fields.SIDE
    return np.stack([np.zeros_like(trail), trail], axis=-1)


def wrong_motions(rng: np.random.Generator) -> Callable[..., np.ndarray]:
    """Motions of a fifth of the stars that the catalogue does not have."""
    angle = rng.uniform(0, 2 * np.pi)

    def moving(rng: np.random.Generator, n: int) -> np.ndarray:
        some = rng.uniform(size=n) < 0.2
        way = np.where(rng.uniform(size=n) < 0.5, angle, rng.uniform(0, 2 * np.pi, n))
        size = some * MAS * rng.uniform(1.0, 5.0, n)
        return size[:, None] * np.stack([np.cos(way), np.sin(way)], axis=1)

    return moving


@kind("campaign_inside_chips", inside=True, n=300)
def inside_chips(rng: np.random.Generator, n: int) -> CampaignTruth:
    """The same on two chips, each of which drifts about its middle."""
    return usual(rng, stars=n, chips=TWO, rate=chip_by_chip(drift(rng)))


@kind("campaign_gap", *OF_GAP, n=300)
def gap(rng: np.random.Generator, n: int) -> CampaignTruth:
    """Two chips drift as one detector: the distance between them changes, which is not fitted."""
    return usual(rng, stars=n, chips=TWO)


@kind("campaign_inside_breathing", inside=True, n=300, deviations=normal_deviations)
@kind("campaign_inside", inside=True, n=300)
def inside(rng: np.random.Generator, n: int, **options: object) -> CampaignTruth:
    """What is fitted is what is true: breathing that is normal, a drift that is linear."""
    return usual(rng, stars=n, **options)


@kind("campaign_breathing_t", "breathing", "exposure-to-exposure", n=300)
def breathing_t(rng: np.random.Generator, n: int) -> CampaignTruth:
    """Scale and shears vary with the tails of Student's t of 4 degrees of freedom."""
    return usual(rng, stars=n, deviations=heavy_deviations)


@kind("campaign_lithography", *STRUCTURE, n=300)
def lithography(rng: np.random.Generator, n: int) -> CampaignTruth:
    """Columns are displaced by 0.01 px either way, with a period of 68 px and sharp edges."""
    phase = rng.uniform(0, 68.0)

    def ridges(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        side = np.where((np.asarray(x) + phase) % 68.0 < 34.0, 1.0, -1.0)
        return 0.01 * np.stack([side, np.zeros_like(side)], axis=-1)

    return usual(rng, stars=n, beside=(ridges,))


@kind("campaign_order_4", *ORDER, n=300)
def order_4(rng: np.random.Generator, n: int) -> CampaignTruth:
    """The truth has terms of one order more than is fitted, 0.005 px rms together."""
    more = fields.of_rms(fields.random_polynomial(rng, {4: 1.0}), 0.005)
    return usual(rng, stars=n, beside=(more,))


@kind("campaign_trails", *OF_MAGNITUDE, "charge transfer", "cte", n=300)
def trails(rng: np.random.Generator, n: int) -> CampaignTruth:
    """Trails draw stars along y in the last years, 0.008 px per magnitude fainter than the
    brightest, at full distance from the amplifier and at the end; the true map is without them."""
    return usual(rng, stars=n, displaced=trailing)


@kind("campaign_motions", *CATALOGUE_WORDS, "motion", n=300)
def motions(rng: np.random.Generator, n: int) -> CampaignTruth:
    """A fifth of the stars move by 1 to 5 mas a year that the catalogue does not have, half of
    them all in one direction."""
    return usual(rng, stars=n, moving=wrong_motions(rng))


@kind("campaign_gap_step", *OF_GAP, n=300)
def gap_opening(rng: np.random.Generator, n: int) -> CampaignTruth:
    """The gap between two chips, each of which drifts about its middle, opens and shears."""
    return usual(rng, stars=n, chips=TWO, rate=fields.total(_chips_drift(rng), _opening(rng)))


def _chips_drift(rng: np.random.Generator) -> fields.Field:
    return chip_by_chip(drift(rng))


def _opening(rng: np.random.Generator) -> fields.Field:
    """The upper chip moves by `OPENING` a year in any direction."""
    angle = rng.uniform(0, 2 * np.pi)
    step = OPENING * np.array([np.cos(angle), np.sin(angle)])
    return lambda x, y: (np.asarray(y) > fields.MIDDLE)[..., None] * step


def long_tails(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Errors of unit variance with the tails of Student's t of 5 degrees of freedom."""
    return rng.standard_t(5, shape) / np.sqrt(5 / 3)


# what other campaigns may have together, each by itself
INGREDIENTS: dict[str, Callable[[np.random.Generator], dict[str, Any]]] = {
    "breathing": lambda rng: {"deviations": heavy_deviations},
    "centroids": lambda rng: {"centroids": long_tails},
    "motions": lambda rng: {"moving": wrong_motions(rng)},
    "trails": lambda rng: {"displaced": trailing},
    "sawtooth": lambda rng: {
        "beside": (fields.sawtooth(rng, PERIOD, RAMP),),
        "config": {"tables": {"method": "field", "step": [128, 128]}},
    },
}


@kind("campaign_together", *OF_GAP, *STRUCTURE, "motion", n=300, names=tuple(INGREDIENTS))
@kind("campaign_centroids_t", n=300, names=("centroids",))
def together(rng: np.random.Generator, n: int, names: tuple[str, ...]) -> CampaignTruth:
    """Some of the ingredients on two chips that drift, each about its middle."""
    options: dict[str, Any] = {"chips": TWO, "rate": _chips_drift(rng), "stars": n}
    for name in names:
        options |= INGREDIENTS[name](rng)
    return usual(rng, **options)


@kind("campaign_sawtooth_in_tables", *STRUCTURE, n=600)
def sawtooth_in_tables(rng: np.random.Generator, n: int) -> CampaignTruth:
    """Ramps of 68 pixels with sharp edges under tables of 64, as those of ACS/WFC have."""
    pattern = fields.sawtooth(rng, PERIOD, RAMP)
    tables = {"tables": {"method": "field", "step": [64, 64]}}
    rate = _chips_drift(rng)
    return usual(rng, chips=TWO, rate=rate, stars=n, beside=(pattern,), config=tables)


@kind("campaign_curved", *OF_TIME, *STRUCTURE, n=300)
def curved(rng: np.random.Generator, n: int) -> CampaignTruth:
    """A drift whose rate changes by a twentieth of its size a year, four years on."""
    rate = linear(*(RATE * rng.choice([-1, 1], 3)))
    bend = linear(*(0.025 * RATE * rng.choice([-1, 1], 3)))
    return usual(rng, stars=n, rate=rate, bend=bend, beyond=4.0)


@kind("campaign_catalogue", *CATALOGUE_WORDS, *STRUCTURE, n=300)
def catalogue(rng: np.random.Generator, n: int) -> CampaignTruth:
    """The catalogue has a distortion of its own, 0.01 px rms on each axis."""
    low = fields.random_polynomial(rng, dict.fromkeys(range(1, 4), 1.0))
    own = fields.of_rms(fields.total(low, fields.smooth(rng, 300, 0.3)), 0.01)

    def astray(sky: np.ndarray) -> np.ndarray:
        x, y = (sky / REACH * fields.SIDE / 2 + fields.MIDDLE).T
        return own(x, y)

    return usual(rng, stars=n, astray=astray)


varied = partial(kind, kindest=True, misleading=NO_HELP)


@varied("campaign_tail_by_position", *MIXED, n=300)
def tail_by_position(rng: np.random.Generator, n: int) -> CampaignTruth:
    """Detections have a tail to one side of the detector, half of them in the upper rows."""
    way = 0.06 * direction(rng)
    blends = some_displaced(rng, rising(0.0, 0.5, 1), lambda m: rng.exponential(size=(m, 1)) * way)
    return usual(rng, stars=n, displaced=blends)


@varied("campaign_second_order", *VARYING, n=300)
def second_order(rng: np.random.Generator, n: int) -> CampaignTruth:
    """Terms of second order differ from exposure to exposure, by 0.01 px rms."""
    return usual(rng, stars=n, varying=lambda rng: fields.random_polynomial(rng, {2: 0.01}))


@varied("campaign_atmosphere", *OF_FIELDS, n=300)
def atmosphere(rng: np.random.Generator, n: int) -> CampaignTruth:
    """Each exposure has a smooth field of its own, 0.008 px rms at a scale of 500 px."""
    return usual(rng, stars=n, varying=lambda rng: fields.smooth(rng, 500, 0.008, expected=True))


@varied("campaign_ar1", *IN_TIME, n=200, exposures=30)
def ar1(rng: np.random.Generator, n: int, exposures: int) -> CampaignTruth:
    """Scale and shears are an autoregressive chain, beside a drift; positions are those of
    exposures that continue it."""
    return usual(
        rng,
        stars=n,
        exposures=exposures,
        deviations=lambda rng, n: autoregressive(rng, n, 0.95, 2 * BREATHING),
    )


@varied("campaign_chip_moved", *OF_GAP, "chip", "break", n=300)
def chip_moved(rng: np.random.Generator, n: int) -> CampaignTruth:
    """One of two chips is displaced by 0.04 px midway, and turned by 0.01 px at its side."""
    step, turn = 0.04 * direction(rng), 2e-5 * rng.choice([-1.0, 1.0])

    def moved(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        around = np.stack([-(np.asarray(y) - 1536.0), np.asarray(x) - fields.MIDDLE], axis=-1)
        return (np.asarray(y) > fields.MIDDLE)[..., None] * (step + turn * around)

    return usual(rng, stars=n, chips=TWO, rate=_chips_drift(rng), jump=moved)
