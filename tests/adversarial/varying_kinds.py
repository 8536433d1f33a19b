"""Kinds of truth whose exposures differ by more than the frames, and the hierarchy of linear
terms, have: positions are those of their mean, or of a single exposure that is yet to come."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from . import fields
from .contamination_kinds import MIXED
from .exposure_kinds import OF_EXPOSURES, deviating, in_frames, pointings
from .truth import SIGMA, Map, Truth, kind, mapped, normal_noise, observed, order_config, pixels

VARYING = ("second order", "second-order", "between exposures", "exposures differ in")
OF_FIELDS = (*VARYING, "atmospher", "smooth field", "exposures deviate from each other")
ONE_EXPOSURE = (*OF_EXPOSURES, "against the other exposures", "have other errors than")
NO_HELP = ("raise model.order", "scale_mas", "depend on position", "are too small")
COINCIDENT = ("coincid", "same star", "each star", "repeated", "several detections")
EXPOSURES = 12

varied = partial(kind, kindest=True, misleading=NO_HELP)

Own = Callable[[np.random.Generator], fields.Field]  # what an exposure has by itself


def varying(
    rng: np.random.Generator,
    n: int,
    own: Own,
    *,
    single: bool,
    exposures: int = EXPOSURES,
    frames: str = "shift_rotation",
) -> Truth:
    """Stars of exposures each of which has a field of its own beside the common map.

    Parameters
    ----------
    rng : numpy.random.Generator
    n : int
        Stars of all exposures.
    own : callable
        A random generator to the field of an exposure.
    single : bool
        Whether positions are those of an exposure that is yet to come, and not the mean's.
    exposures : int
    frames : str
        model.frames; of "none" the exposures are aligned.
    """
    common, (x, y) = mapped(fields.distortion(rng)), pixels(rng, n)
    code = np.arange(n) % exposures
    w = common(x, y, None)
    for k in range(exposures):
        rows = code == k
        w[rows] += own(rng)(x[rows], y[rows])
    pointed = pointings(rng, exposures) if frames != "none" else {}
    names = np.array([f"e{k:02d}" for k in range(exposures)])
    uv = in_frames(w, code, pointed) if pointed else w
    stars = observed(rng, x, y, uv, exposure=names[code])
    return assessed(rng, stars, common, own, single=single, frames=pointed)


def assessed(
    rng: np.random.Generator,
    stars: dict[str, np.ndarray],
    common: Map,
    own: Own,
    *,
    single: bool,
    frames: dict[str, Any],
) -> Truth:
    """The truth of a mean calibration, or of one exposure more."""
    config = order_config(3, **({"frames": "shift_rotation"} if frames else {}))
    if not single:
        return Truth(stars, common, config, frames=frames)
    new = own(rng)

    def true_map(x: np.ndarray, y: np.ndarray, epoch: float | None = None) -> np.ndarray:
        return common(x, y, epoch) + new(x, y)

    return Truth(stars, true_map, config | {"assess": {"exposure": "single"}}, frames=frames)


def still(rng: np.random.Generator) -> fields.Field:
    """No displacement."""
    return fields.total()


@varied("second_order_020", *VARYING, n=3000, rms=0.02)
@varied("second_order_008", *VARYING, n=3000, rms=0.008)
@varied("second_order_020_single", *VARYING, n=3000, rms=0.02, single=True)
@varied("second_order_005_single", *VARYING, n=3000, rms=0.005, single=True)
def second_order(rng: np.random.Generator, n: int, rms: float, single: bool = False) -> Truth:
    """Terms of second order differ from exposure to exposure, by this rms on each axis."""
    return varying(rng, n, lambda rng: fields.random_polynomial(rng, {2: rms}), single=single)


@varied("atmosphere_010", *OF_FIELDS, n=3000, rms=0.010)
@varied("atmosphere_010_single", *OF_FIELDS, n=3000, rms=0.010, single=True)
@varied("atmosphere_004_single", *OF_FIELDS, n=3000, rms=0.004, single=True)
def atmosphere(rng: np.random.Generator, n: int, rms: float, single: bool = False) -> Truth:
    """Each exposure has a smooth field of its own, with a scale of 500 px."""
    return varying(rng, n, lambda rng: fields.smooth(rng, 500, rms, expected=True), single=single)


@varied("refraction", *VARYING, "colour", n=3000)
@varied("refraction_single", *VARYING, "colour", n=3000, single=True)
def refraction(rng: np.random.Generator, n: int, single: bool = False) -> Truth:
    """Refraction displaces stars by their colour along the vertical, which each exposure has in
    another direction; stars are redder on one side, and colours are given.  The true map is that of
    stars of colour 1."""
    common, (x, y) = mapped(fields.distortion(rng)), pixels(rng, n)
    code = np.arange(n) % EXPOSURES
    colours = 1.0 + 0.4 * rng.standard_normal(n) + 0.4 * fields.scaled(y)
    along = np.array([0.0, 0.012]) + 0.006 * rng.standard_normal((EXPOSURES + 1, 2))
    w = common(x, y, None) + (colours - 1.0)[:, None] * along[code]
    frames = pointings(rng, EXPOSURES)
    names = np.array(list(frames))[code]
    stars = observed(rng, x, y, in_frames(w, code, frames), exposure=names, colour=colours)
    return assessed(rng, stars, common, still, single=single, frames=frames)


@varied("one_turned_020", *ONE_EXPOSURE, degrees=0.02)
@varied("one_turned_005", *ONE_EXPOSURE, degrees=0.005)
@varied("one_turned_020_single", *ONE_EXPOSURE, degrees=0.02, single=True)
def one_turned(rng: np.random.Generator, n: int, degrees: float, single: bool = False) -> Truth:
    """One of eight aligned exposures is turned; the true map is that of the others."""
    common, (x, y) = mapped(fields.distortion(rng)), pixels(rng, n)
    code = np.arange(n) % 8
    w = common(x, y, None)
    angle = np.radians(degrees) * rng.choice([-1, 1])
    w = w + (code == 5)[:, None] * angle * np.column_stack([-w[:, 1], w[:, 0]])
    stars = observed(rng, x, y, w, exposure=np.array([f"e{k:02d}" for k in code]))
    return assessed(rng, stars, common, still, single=single, frames={})


@varied("one_stretched", *ONE_EXPOSURE, n=3000)
@varied("one_stretched_single", *ONE_EXPOSURE, n=3000, single=True)
def one_stretched(rng: np.random.Generator, n: int, single: bool = False) -> Truth:
    """One of ten exposures, fitted with shifts and rotations, is out of focus: its scale is off by
    2e-4; the true map is that of the others."""
    common, (x, y) = mapped(fields.distortion(rng)), pixels(rng, n)
    code = np.arange(n) % 10
    scale = np.array([2e-4, 0.0, 0.0]) * (code == 3)[:, None]
    frames = pointings(rng, 10)
    uv = in_frames(deviating(common(x, y, None), scale), code, frames)
    stars = observed(rng, x, y, uv, exposure=np.array(list(frames))[code])
    return assessed(rng, stars, common, still, single=single, frames=frames)


@kind("trailed", *MIXED, "noise", "trail", kindest=True, n=3000)
@kind("trailed_single", *MIXED, "noise", "trail", kindest=True, n=3000, single=True)
def trailed(rng: np.random.Generator, n: int, single: bool = False) -> Truth:
    """Four of ten exposures are trailed by lost guiding: their errors are four times larger along a
    direction, and lopsided."""
    common, (x, y) = mapped(fields.distortion(rng)), pixels(rng, n)
    code = np.arange(n) % 10
    ways = np.array([[np.cos(a), np.sin(a)] for a in rng.uniform(0, np.pi, 10)])
    late = 0.06 * (rng.exponential(size=n) - 1.0) * (code < 4)  # guiding was lost towards the end
    noise = normal_noise(rng, n) + late[:, None] * ways[code]
    frames = pointings(rng, 10)
    uv = in_frames(common(x, y, None), code, frames)
    stars = observed(rng, x, y, uv, noise=noise, exposure=np.array(list(frames))[code])
    return assessed(rng, stars, common, still, single=single, frames=frames)


@varied("two_visits_framed_single", *VARYING, "visit", n=3000)
def two_visits(rng: np.random.Generator, n: int) -> Truth:
    """Five exposures of each of two visits, which differ by the focus: terms of second and third
    order, 0.006 px rms, alike in all exposures of a visit; true is one more of either visit."""
    common, (x, y) = mapped(fields.distortion(rng)), pixels(rng, n)
    code = np.arange(n) % 10
    focus = fields.of_rms(fields.random_polynomial(rng, {2: 1.0, 3: 1.0}), 0.006)
    side = np.where(code < 5, -1.0, 1.0)[:, None]
    frames = pointings(rng, 10)
    uv = in_frames(common(x, y, None) + side * focus(x, y), code, frames)
    stars = observed(rng, x, y, uv, exposure=np.array(list(frames))[code])
    sign = rng.choice([-1.0, 1.0])

    def new(rng: np.random.Generator) -> fields.Field:
        return lambda x, y: sign * focus(x, y)

    return assessed(rng, stars, common, new, single=True, frames=frames)


@kind("repeated_3", *COINCIDENT, kindest=True, times=3)
@kind("repeated_6", *COINCIDENT, kindest=True, times=6)
def repeated(rng: np.random.Generator, n: int, times: int) -> Truth:
    """Each star so many times, at nearly the same pixel, and without its name; all rows of a star
    have the error of the catalogue in common, which is as large as that of a centroid."""
    true_map = mapped(fields.distortion(rng))
    stars = n // times
    x, y = pixels(rng, stars)
    at = true_map(x, y, None) + 0.02 * rng.standard_normal((stars, 2))
    x, y = (np.repeat(a, times) for a in (x, y))
    of = np.repeat(at, times, axis=0)
    detected = np.column_stack([x, y]) + SIGMA * rng.standard_normal((x.size, 2))
    x, y = detected.clip(0.6, fields.SIDE + 0.4).T
    columns = observed(
        rng, x, y, of, noise=np.zeros((x.size, 2)), sigma=np.hypot(SIGMA, 0.02), false=0.0
    )
    return Truth(columns, true_map, order_config(3))
