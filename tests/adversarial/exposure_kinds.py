"""Kinds of truth with many exposures, dates, or the same stars again and again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from . import fields
from .static_kinds import CATALOGUE_WORDS, STRUCTURE
from .truth import (
    SIGMA,
    Frame,
    Map,
    Truth,
    catalogue_row,
    kind,
    mapped,
    observed,
    order_config,
    pixels,
)

BREATHING = 2e-5  # scatter of scale and shears
EPOCH0 = 2007.0
TDD = {"epoch0": EPOCH0, "terms": [["u", 1, 0], ["v", 1, 0], ["v", 0, 1]]}
OF_EXPOSURES = ("breathing", "exposure-to-exposure", "between exposures", "of an exposure")
OF_TIME = ("extrapolat", "linear drift", "curvature", "too few dates", "two dates", "beyond the")

Scatter = Callable[[np.random.Generator, int], np.ndarray]  # deviations (E, 3)


def normal_deviations(rng: np.random.Generator, n: int) -> np.ndarray:
    """Scale and both shears (n, 3) of exposures."""
    return BREATHING * rng.standard_normal((n, 3))


def heavy_deviations(rng: np.random.Generator, n: int) -> np.ndarray:
    """The same with the tails of Student's t of 4 degrees of freedom, and the same scatter."""
    return BREATHING * rng.standard_t(4, (n, 3)) / np.sqrt(2)


def deviating(w: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Positions (N, 2) under scale, shear along the axes and across them, (N, 3)."""
    scale, plus, cross = deviations.T
    u, v = w.T
    return w + np.stack([(scale + plus) * u + cross * v, cross * u + (scale - plus) * v], axis=-1)


def pointings(rng: np.random.Generator, n: int) -> dict[str, Frame]:
    """Frames of exposures, by name."""
    return {
        f"e{k:02d}": Frame(tuple(5.0 * rng.standard_normal(2)), 1e-3 * rng.standard_normal())
        for k in range(n)
    }


def in_frames(w: np.ndarray, code: np.ndarray, frames: dict[str, Frame]) -> np.ndarray:
    """Positions (N, 2) as each exposure, by code, points."""
    out = np.empty_like(w)
    for k, frame in enumerate(frames.values()):
        out[code == k] = frame.seen(w[code == k])
    return out


def drifting(static: Map, rate: fields.Field, bend: fields.Field | None = None) -> Map:
    """A map with a drift in pixels a year, and an acceleration in pixels a year squared."""

    def true_map(x: np.ndarray, y: np.ndarray, epoch: Any = None) -> np.ndarray:
        years = np.asarray(epoch - EPOCH0)[..., None]
        out = static(x, y, None) + years * rate(x, y)
        return out if bend is None else out + years**2 * bend(x, y)

    return true_map


def linear(u_x: float, v_x: float, v_y: float) -> fields.Field:
    """The field of the three terms that are fitted, by their sizes at half a side."""
    c = np.zeros((2, 2, 2))
    c[0, 1, 0], c[1, 1, 0], c[1, 0, 1] = u_x, v_x, v_y
    return fields.polynomial(c)


def campaign(
    rng: np.random.Generator,
    n: int,
    true_map: Map,
    *,
    exposures: int,
    dates: tuple[float, float] | None = None,
    beyond: float = 4.0,
    deviations: Scatter | None = None,
    catalogue: Callable[..., np.ndarray] | None = None,
) -> Truth:
    """Stars of exposures that point somewhere else each, fitted with shifts and rotations.

    Parameters
    ----------
    rng : numpy.random.Generator
    n : int
        Stars of all exposures.
    true_map : callable
    exposures : int
    dates : tuple of float, optional
        Of the first and the last one; without dates there is no drift.
    beyond : float
        Years after the last one at which positions are assessed.
    deviations : callable, optional
        Of scale and shears of the exposures.
    catalogue : callable, optional
        x, y, epoch to its errors (N, 2).
    """
    frames, (x, y) = pointings(rng, exposures), pixels(rng, n)
    code = np.arange(n) % exposures
    columns = {"exposure": np.array(list(frames))[code]}
    epoch, config, assessed = None, order_config(3, frames="shift_rotation"), None
    if dates is not None:
        columns["epoch"] = epoch = np.linspace(*dates, exposures)[code]
        config["model"]["tdd"] = TDD
        if catalogue is None:
            config["budget"].append(catalogue_row(0.0, "proper motions"))
        assessed = dates[1] + beyond
    w = true_map(x, y, epoch)
    if deviations is not None:
        w = deviating(w, deviations(rng, exposures)[code])
    if catalogue is not None:
        w = w + catalogue(x, y, epoch)
    stars = observed(rng, x, y, in_frames(w, code, frames), **columns)
    return Truth(stars, true_map, config, assessed, frames)


@kind("inside_exposures", n=3000, inside=True)
def inside_exposures(rng: np.random.Generator, n: int) -> Truth:
    """Exposures differ by shifts and rotations only, which are fitted."""
    return campaign(rng, n, mapped(fields.distortion(rng)), exposures=16)


@kind("inside_drift", n=3000, inside=True)
def inside_drift(rng: np.random.Generator, n: int) -> Truth:
    """The drift is linear, as is fitted, and assessed four years on."""
    rate = linear(*(0.005 * rng.standard_normal(3)))
    true_map = drifting(mapped(fields.distortion(rng)), rate)
    return campaign(rng, n, true_map, exposures=12, dates=(2002.0, 2012.0))


@kind("breathing_t", *OF_EXPOSURES, n=3000, deviations=heavy_deviations)
@kind("breathing", *OF_EXPOSURES, n=3000, deviations=normal_deviations)
def breathing(rng: np.random.Generator, n: int, deviations: Scatter) -> Truth:
    """Scale and shears vary from exposure to exposure."""
    true_map = mapped(fields.distortion(rng))
    return campaign(rng, n, true_map, exposures=16, deviations=deviations)


@kind("breathing_unframed", *OF_EXPOSURES, n=3000)
def breathing_unframed(rng: np.random.Generator, n: int) -> Truth:
    """Four aligned exposures whose scale and shears vary, fitted without frames."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, n)
    code = np.arange(n) % 4
    w = deviating(true_map(x, y, None), normal_deviations(rng, 4)[code])
    stars = observed(rng, x, y, w, exposure=np.array([f"e{k}" for k in code]))
    return Truth(stars, true_map, order_config(3))


@kind("breathing_new_exposure", *OF_EXPOSURES, n=3000)
def breathing_new(rng: np.random.Generator, n: int) -> Truth:
    """Scale and shears vary, and the positions are those in an exposure that is yet to come."""
    truth = breathing(rng, n, normal_deviations)
    own = normal_deviations(rng, 1)

    def true_map(x: np.ndarray, y: np.ndarray, epoch: Any = None) -> np.ndarray:
        return deviating(truth.true_map(x, y, epoch), own)

    config = truth.config | {"assess": truth.config.get("assess", {}) | {"exposure": "single"}}
    return replace(truth, true_map=true_map, config=config)


@kind("drift_two_dates", *OF_EXPOSURES, *OF_TIME, n=3000)
def two_dates(rng: np.random.Generator, n: int) -> Truth:
    """A drift from two exposures that breathe, six years apart, four years on."""
    rate = linear(*(0.005 * rng.standard_normal(3)))
    true_map = drifting(mapped(fields.distortion(rng)), rate)
    return campaign(
        rng, n, true_map, exposures=2, dates=(2004.0, 2010.0), deviations=normal_deviations
    )


@kind("drift_curved", *OF_TIME, *STRUCTURE, n=3000)
def curved(rng: np.random.Generator, n: int) -> Truth:
    """A drift whose rate changes by a tenth of its size a year, four years on."""
    rate = linear(*(0.004 * rng.choice([-1, 1], 3)))
    bend = linear(*(0.0002 * rng.choice([-1, 1], 3)))
    true_map = drifting(mapped(fields.distortion(rng)), rate, bend)
    return campaign(rng, n, true_map, exposures=12, dates=(2002.0, 2012.0))


@kind("motions_sheared", *CATALOGUE_WORDS, "motion", n=3000)
def motions_sheared(rng: np.random.Generator, n: int) -> Truth:
    """The catalogue's motions are off by a linear field, 0.002 px a year at half a side, which
    the fit takes for a drift of the detector."""
    true_map = drifting(mapped(fields.distortion(rng)), linear(*(0.004 * rng.standard_normal(3))))
    wrong = fields.random_polynomial(rng, {1: 0.002})

    def catalogue(x: np.ndarray, y: np.ndarray, epoch: np.ndarray) -> np.ndarray:
        return (epoch - EPOCH0)[:, None] * wrong(x, y)

    return campaign(rng, n, true_map, exposures=12, dates=(2002.0, 2012.0), catalogue=catalogue)


SAME = (*CATALOGUE_WORDS, "same star", "each star", "err together")


@kind("same_stars_unnamed", *SAME, "coincid", kindest=True, n=3000, named=False)
@kind("stars_that_move", "motion", "stars move", n=3000, moving=0.2)
@kind("same_stars", *SAME, n=3000)
def same_stars(rng: np.random.Generator, n: int, moving: float = 0.0, named: bool = True) -> Truth:
    """The same stars in ten dithered exposures: they share the catalogue's errors, 0.01 px.

    With a fraction of them that moves, the exposures have dates over ten years, and motions of
    0.01 px a year are not in the catalogue.  Where they are not `named` the table does not say
    which star a row is of.
    """
    exposures, quoted = 10, np.hypot(SIGMA, 0.01)
    true_map = mapped(fields.distortion(rng))
    sky = rng.uniform(-1100, 1100, (int(1.16 * n / exposures), 2))
    error = 0.01 * rng.standard_normal(sky.shape)
    dithers = rng.uniform(-100, 100, (exposures, 2))
    frames = {
        f"e{k:02d}": Frame(tuple(d), 1e-3 * rng.standard_normal()) for k, d in enumerate(dithers)
    }
    parts: dict[str, list[np.ndarray]] = {}
    for k, (name, frame) in enumerate(frames.items()):
        x, y = pixels_of(true_map, frame.undone(sky))
        seen = (np.minimum(x, y) > 0.5) & (np.maximum(x, y) < fields.SIDE + 0.5)
        x, y = (p[seen] + SIGMA * rng.standard_normal(seen.sum()) for p in (x, y))
        columns = {"x": x, "y": y, "star": np.flatnonzero(seen), "code": np.full(x.size, k)}
        for key, values in (columns | {"exposure": np.full(x.size, name)}).items():
            parts.setdefault(key, []).append(values)
    of = {key: np.concatenate(values) for key, values in parts.items() if key != "code"}
    inside = (np.minimum(of["x"], of["y"]) > 0.5) & (np.maximum(of["x"], of["y"]) < 2048.5)
    of = {key: values[inside] for key, values in of.items()}
    star = of["star"]
    seen_at, config, assessed = sky[star] + error[star], order_config(3), None
    if moving:
        dates = dict(zip(frames, np.linspace(2002.0, 2012.0, exposures), strict=True))
        of["epoch"] = np.array([dates[name] for name in of["exposure"]])
        move = (rng.uniform(size=(len(sky), 1)) < moving) * rng.standard_normal(sky.shape)
        seen_at = seen_at + (of["epoch"] - EPOCH0)[:, None] * 0.01 * move[star]
        config["model"]["tdd"], assessed = TDD, 2012.0
    config["model"]["frames"] = "shift_rotation"
    if not named:
        del of["star"]
    stars = observed(
        rng,
        of.pop("x"),
        of.pop("y"),
        seen_at,
        noise=np.zeros((star.size, 2)),  # the centroids have it
        sigma=quoted,
        **of,
    )
    return Truth(stars, true_map, config, assessed, frames)


def pixels_of(true_map: Map, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels x, y (N,) that a map without drift takes to positions (N, 2)."""
    at = w + fields.MIDDLE
    for _ in range(30):  # distortions change by a few percent from place to place
        inner = np.clip(at, -200, fields.SIDE + 200)
        at = at + w - true_map(*inner.T, None) - (at - inner)
    return at[:, 0], at[:, 1]
