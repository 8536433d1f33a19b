"""Kinds of truth of dithered exposures without a catalogue: self-calibrations."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from . import fields
from .contamination_kinds import MIXED, direction, rising, some_displaced
from .exposure_kinds import OF_EXPOSURES, Scatter, deviating, heavy_deviations, pixels_of
from .star_kinds import BRIGHT, OF_MAGNITUDE, magnitudes
from .static_kinds import ORDER, STRUCTURE
from .time_kinds import IN_TIME, autoregressive
from .truth import SIGMA, Frame, Map, Truth, kind, mapped
from .varying_kinds import NO_HELP, OF_FIELDS, VARYING

FALSE = 0.02  # fraction of detections that are displaced
FALSE_SIGMA = 0.6  # px: by which, on each axis
SPURIOUS = 0.02  # detections of nothing, as a fraction of the others
IN_EXPOSURE = 600  # stars
DETECTIONS = 14 * IN_EXPOSURE
LEAST_EXPOSURES = 4
MOST_STEPS = 500  # of the sampler
STEPS = (200.0, 600.0)  # px: of the dithers
ROLLS = ((0.0, 60.0), (0.0, 90.0), (0.0, 60.0, 130.0))  # degrees
OF_MOTIONS = ("motion", "drift", "date", "epoch")

Shift = Callable[..., np.ndarray]  # x, y, magnitude, years and number of the star to pixels (N, 2)


def small_distortion(rng: np.random.Generator) -> fields.Field:
    """A distortion of a few pixels: stars are found without one to begin with."""
    return fields.random_polynomial(rng, {1: 1.5, 2: 0.8, 3: 0.4})


def dithers(rng: np.random.Generator, n: int) -> dict[str, Frame]:
    """Frames of exposures by name, the first of them that of the map."""
    rolls = ROLLS[rng.integers(len(ROLLS))]
    at, out = np.zeros(2), {"e00": Frame((0.0, 0.0), 0.0)}
    for k in range(1, n):
        angle = rng.uniform(0, 2 * np.pi)
        step = rng.uniform(*STEPS) * np.array([np.cos(angle), np.sin(angle)])
        at = at + step if np.abs(at + step).max() < 900 else at - step
        roll = np.radians(rolls[k % len(rolls)]) + 1e-3 * rng.standard_normal()
        out[f"e{k:02d}"] = Frame((float(at[0]), float(at[1])), roll)
    return out


def dithered(
    rng: np.random.Generator,
    n: int,
    true_map: Map,
    *,
    deviations: Scatter | None = None,
    varying: Callable[[np.random.Generator], fields.Field] | None = None,
    displaced: Shift | None = None,
    motions: float = 0.0,
    years: float = 0.0,
) -> Truth:
    """Detections of the same stars in exposures that are dithered and rolled.

    Parameters
    ----------
    rng : numpy.random.Generator
    n : int
        Detections, about so many.
    true_map : callable
    deviations : callable, optional
        Of scale and shears of the exposures.
    varying : callable, optional
        A random generator to the field that an exposure has by itself.
    displaced : callable, optional
        By which detections are displaced on the detector.
    motions : float
        Of a star on each axis: standard deviation in pixels a year.
    years : float
        From the first exposure to the last; without them exposures have no dates.
    """
    n = max(LEAST_EXPOSURES, round(n / IN_EXPOSURE))
    frames, reach = dithers(rng, n), 2600.0
    sky = rng.uniform(-reach, reach, (int(IN_EXPOSURE * (2 * reach / fields.SIDE) ** 2), 2))
    mag = magnitudes(rng, len(sky))
    moving = motions * rng.standard_normal(sky.shape)
    own = None if deviations is None else deviations(rng, n)
    when = np.linspace(0.0, years, n)
    parts: dict[str, list[np.ndarray]] = {}
    for k, (name, frame) in enumerate(frames.items()):
        w = frame.undone(sky + when[k] * moving)
        near = np.flatnonzero(np.abs(w).max(axis=1) < 1150)
        w = w[near]
        if own is not None:  # inverted to first order: they are small
            w = 2 * w - deviating(w, np.tile(own[k], (len(w), 1)))
        x, y = pixels_of(true_map, w)
        if varying is not None:
            x, y = pixels_of(true_map, w - varying(rng)(x, y))
        at = np.stack([x, y], axis=1)
        if displaced is not None:
            at = at + displaced(x, y, mag[near])
        at = at + SIGMA * rng.standard_normal(at.shape)
        wrong = rng.uniform(size=len(at)) < FALSE
        at = at + wrong[:, None] * FALSE_SIGMA * rng.standard_normal(at.shape)
        on = (at.min(axis=1) > 0.5) & (at.max(axis=1) < fields.SIDE + 0.5)
        star = near[on]
        spurious = rng.uniform(0.5, fields.SIDE + 0.5, (int(SPURIOUS * len(star)), 2))
        at = np.concatenate([at[on], spurious])
        of_nothing = frame.seen(true_map(*spurious.T, None))
        columns = {
            "x": at[:, 0],
            "y": at[:, 1],
            "mag": np.concatenate([mag[star], magnitudes(rng, len(spurious))]),
            "exposure": np.full(len(at), name),
            "u": np.concatenate([sky[star], of_nothing])[:, 0],
            "v": np.concatenate([sky[star], of_nothing])[:, 1],
        }
        for key, values in columns.items():
            parts.setdefault(key, []).append(values)
    stars = {key: np.concatenate(values) for key, values in parts.items()}
    selfcal: dict[str, Any] = {"lists": "stars.ecsv", "start_radius": 8.0}
    config: dict[str, Any] = {
        "selfcal": selfcal,
        "model": {"order": 3, "reference_pixel": [fields.MIDDLE, fields.MIDDLE]},
        # where many detections are doubtful the sampler takes long
        "sampler": {"max_steps": MOST_STEPS},
    }
    dates = dict(zip(frames, 2010.0 + when, strict=True)) if years else {}
    if dates:
        selfcal["exposures"] = "exposures.ecsv"
    return Truth(stars, true_map, config, None, frames, dates)


@kind("selfcal_inside", n=DETECTIONS, inside=True)
def inside(rng: np.random.Generator, n: int) -> Truth:
    """What is fitted is what is true."""
    return dithered(rng, n, mapped(small_distortion(rng)))


@kind("selfcal_one_order_more_3", *ORDER, n=DETECTIONS, rms=0.003)
@kind("selfcal_one_order_more_10", *ORDER, n=DETECTIONS, rms=0.010)
def one_order_more(rng: np.random.Generator, n: int, rms: float) -> Truth:
    """The truth has order 4 as well."""
    more = fields.of_rms(fields.random_polynomial(rng, {4: 1.0}), rms)
    return dithered(rng, n, mapped(small_distortion(rng), more))


@kind("selfcal_smooth_270", *STRUCTURE, n=DETECTIONS)
def smooth(rng: np.random.Generator, n: int) -> Truth:
    """A Gaussian random field beside the polynomial."""
    more = fields.smooth(rng, 270, 0.004)
    return dithered(rng, n, mapped(small_distortion(rng), more))


@kind("selfcal_lithography_300", *STRUCTURE, n=DETECTIONS)
def lithography(rng: np.random.Generator, n: int) -> Truth:
    """Columns and rows are displaced periodically."""
    more = fields.ridges(rng, 300.0, 0.004)
    return dithered(rng, n, mapped(small_distortion(rng), more))


@kind("selfcal_breathing_t", *OF_EXPOSURES, n=DETECTIONS)
def breathing(rng: np.random.Generator, n: int) -> Truth:
    """Scale and shears vary from exposure to exposure."""
    return dithered(rng, n, mapped(small_distortion(rng)), deviations=heavy_deviations)


@kind("selfcal_charge_trails", *OF_MAGNITUDE, "charge transfer", "cte", n=DETECTIONS)
def charge_trails(rng: np.random.Generator, n: int) -> Truth:
    """Trails draw stars along y, 0.005 px per magnitude fainter than the brightest at full
    distance from the amplifier; the true map is that of stars without trails."""

    def trail(x: np.ndarray, y: np.ndarray, mag: np.ndarray) -> np.ndarray:
        along = 0.005 * (mag - BRIGHT) * (fields.SIDE - y) / fields.SIDE
        return np.stack([np.zeros_like(along), along], axis=1)

    return dithered(rng, n, mapped(small_distortion(rng)), displaced=trail)


@kind("selfcal_motions", *OF_MOTIONS, *OF_EXPOSURES, n=DETECTIONS)
def motions(rng: np.random.Generator, n: int) -> Truth:
    """Stars move by 0.004 px a year over six years, and are taken to stand still."""
    return dithered(rng, n, mapped(small_distortion(rng)), motions=0.004, years=6.0)


varied = partial(kind, kindest=True, misleading=NO_HELP)


@varied("selfcal_second_order", *OF_EXPOSURES, *VARYING, n=DETECTIONS)
def second_order(rng: np.random.Generator, n: int) -> Truth:
    """Terms of second order differ from exposure to exposure, by 0.01 px rms."""
    more = partial(fields.random_polynomial, rms_of_order={2: 0.01})
    return dithered(rng, n, mapped(small_distortion(rng)), varying=more)


@varied("selfcal_atmosphere", *OF_EXPOSURES, *OF_FIELDS, n=DETECTIONS)
def atmosphere(rng: np.random.Generator, n: int) -> Truth:
    """Each exposure has a smooth field of its own, 0.008 px rms at a scale of 500 px."""
    more = partial(fields.smooth, scale=500, rms=0.008, expected=True)
    return dithered(rng, n, mapped(small_distortion(rng)), varying=more)


@varied("selfcal_scales", *OF_EXPOSURES, *IN_TIME, n=DETECTIONS)
def scales(rng: np.random.Generator, n: int) -> Truth:
    """Columns are stretched against rows from exposure to exposure, more and more so."""

    def stretching(rng: np.random.Generator, n: int) -> np.ndarray:
        return autoregressive(rng, n, 0.9, 4e-5) * np.array([0.0, 1.0, 0.0])

    return dithered(rng, n, mapped(small_distortion(rng)), deviations=stretching)


@varied("selfcal_tail_by_position", *MIXED, n=DETECTIONS)
def tail_by_position(rng: np.random.Generator, n: int) -> Truth:
    """Detections have a tail to one side of the detector, half of them in the upper rows."""
    way = 0.06 * direction(rng)
    blends = some_displaced(rng, rising(0.0, 0.5, 1), lambda m: rng.exponential(size=(m, 1)) * way)
    return dithered(rng, n, mapped(small_distortion(rng)), displaced=blends)
