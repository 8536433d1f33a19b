"""Campaigns made with numpy alone: a catalogue, star lists of many exposures, and the true map."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.table import Table

from .fields import MIDDLE, SIDE, Field, distortion, random_polynomial, total
from .truth import ONE, Frame, Piece

FIRST, LAST, EPOCH0 = 2002.0, 2012.0, 2007.0  # dates of the exposures, and of the catalogue
BRIGHT, FAINT = -14.0, -10.0  # instrumental magnitudes
CATALOGUE, MOTION = 0.004, 0.0004  # px and px a year: errors that the catalogue states
TRUE_MOTION = 0.008  # px a year: scatter of the motions that it knows
FALSE, BLENDED = 0.03, 0.02  # of the detections
BLEND = 0.3  # px: scatter of blended detections
REACH = 1750.0  # px: the catalogue's half side
DITHER = 150.0  # px
ARCSEC = 0.05  # a pixel, in the known distortion
NEW = 12  # exposures that are yet to come: one by itself says little of how they deviate
JUMP = 2007.3  # date at which something changes for good
TERMS = [["u", 1, 0], ["v", 1, 0], ["v", 0, 1]]

Map = Callable[[np.ndarray, np.ndarray, Any], np.ndarray]  # mosaic x, y, epoch -> (N, 2)


@dataclass(frozen=True, eq=False)
class CampaignTruth:
    """What a campaign begins with, and what is true of an exposure that is yet to come.

    Parameters
    ----------
    catalogue, log : dict of str to ndarray
        Columns.
    lists : dict of str to dict
        Columns of the star list of each exposure.
    chips : tuple of Piece
    true_map : callable
        Mosaic x, y, epoch and number to true (u, v) (N, 2), without frames: what one of `NEW`
        exposures shows that deviates from the others as they do from each other.
    common : callable
        Mosaic x, y and epoch to the (u, v) (N, 2) from which all exposures deviate.
    beside : callable
        x, y of the mosaic to the displacement (N, 2) that the polynomials do not have.
    known : callable
        The known distortion that matching begins with, in the same way.
    config : dict
        Keys that a user writes, by block, beside those that all campaigns have.
    epoch : float
        At which positions are assessed.
    """

    catalogue: dict[str, np.ndarray]
    log: dict[str, np.ndarray]
    lists: dict[str, dict[str, np.ndarray]]
    chips: tuple[Piece, ...]
    true_map: Callable[..., np.ndarray]
    common: Map
    beside: Field
    known: Map
    config: dict[str, Any]
    epoch: float

    def write(self, folder: Path) -> None:
        """Write catalogue, log, star lists and the known distortion."""
        units = {"mag": "mag", "epoch": "yr"} | {n: "pix/yr" for n in self.catalogue if "pm_" in n}
        units = dict.fromkeys(self.catalogue, "pix") | units
        Table(self.catalogue, units=units).write(folder / "catalog.ecsv")
        Table(self.log).write(folder / "exposures.ecsv")
        (folder / "lists").mkdir()
        for name, columns in self.lists.items():
            Table(columns).write(folder / "lists" / f"{name}.parquet")
        _write_start(self, folder / "start_idc.fits")


def normal(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Normal errors of unit variance."""
    return rng.standard_normal(shape)


@dataclass(frozen=True, eq=False)
class Recipe:
    """What a campaign is made of; all that is None or empty is left out.

    Parameters
    ----------
    chips : tuple of Piece
    exposures : int
    stars : int
        Expected in an exposure.
    deviations : callable
        Random generator and number to scale and shears (n, 3) of exposures.
    rate, bend : callable, optional
        Fields of the drift, in px a year and px a year squared.
    jump : callable, optional
        Field that is there from `JUMP` on.
    varying : callable, optional
        Random generator to the field that an exposure has by itself.
    beside : tuple of callable
        Fields that the model does not have.
    beyond : float
        Years after the last exposure at which positions are assessed.
    displaced : callable, optional
        Mosaic x, y, magnitude and epoch to a displacement of detections (N, 2) in pixels.
    moving : callable, optional
        Random generator and number to motions (n, 2) that the catalogue does not have.
    astray : callable, optional
        Sky position (N, 2) to errors (N, 2) of the catalogue.
    centroids : callable
        Random generator and shape to errors of detections, of unit variance.
    config : dict
        As of `CampaignTruth`.
    """

    chips: tuple[Piece, ...] = ONE
    exposures: int = 20
    stars: int = 300
    deviations: Callable[[np.random.Generator, int], np.ndarray] | None = None
    rate: Field | None = None
    bend: Field | None = None
    jump: Field | None = None
    varying: Callable[[np.random.Generator], Field] | None = None
    beside: tuple[Field, ...] = ()
    beyond: float = 0.0
    displaced: Callable[..., np.ndarray] | None = None
    moving: Callable[..., np.ndarray] | None = None
    astray: Callable[[np.ndarray], np.ndarray] | None = None
    centroids: Callable[[np.random.Generator, tuple[int, ...]], np.ndarray] = normal
    config: Mapping[str, Any] = field(default_factory=dict)


def deviating(w: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Positions (N, 2) under scale, shear along the axes and across them, (3,)."""
    scale, plus, cross = deviation
    return w @ np.array([[1 + scale + plus, cross], [cross, 1 + scale - plus]]).T


def centroid_sigma(mag: np.ndarray) -> np.ndarray:
    """Error of a detection, on either axis."""
    return np.hypot(0.01, 0.04 * 10 ** (0.2 * (mag - FAINT)))


def made(rng: np.random.Generator, recipe: Recipe) -> CampaignTruth:
    """The campaign of a recipe."""
    static = total(distortion(rng), *recipe.beside)
    nearly = random_polynomial(rng, {1: 0.05, 2: 0.05})

    def common(x: np.ndarray, y: np.ndarray, epoch: float) -> np.ndarray:
        out = np.stack([x - MIDDLE, y - MIDDLE], axis=-1) + static(x, y)
        for power, change in ((1, recipe.rate), (2, recipe.bend)):
            if change is not None:
                out = out + (epoch - EPOCH0) ** power * change(x, y)
        if recipe.jump is not None and epoch > JUMP:
            out = out + recipe.jump(x, y)
        return out

    n = recipe.exposures
    epochs = np.sort(rng.uniform(FIRST, LAST, n))
    epochs[[0, -1]] = FIRST, LAST
    deviations = np.zeros((n + NEW, 3))
    if recipe.deviations is not None:
        deviations = recipe.deviations(rng, n + NEW)
    of_each = [total()] * (n + NEW)
    if recipe.varying is not None:
        of_each = [recipe.varying(rng) for _ in range(n + NEW)]
    sky = _Sky(rng, recipe)
    va = 1 + 5e-5 * np.sin(2 * np.pi * epochs + rng.uniform(0, 2 * np.pi))
    names = [f"e{k:02d}" for k in range(n)]

    def shown(x: np.ndarray, y: np.ndarray, epoch: float, k: int) -> np.ndarray:
        return deviating(common(x, y, epoch), deviations[k]) + of_each[k](x, y)

    lists = {}
    for k, (name, epoch, factor) in enumerate(zip(names, epochs, va, strict=True)):
        frame = Frame(tuple(rng.uniform(-DITHER, DITHER, 2)), rng.uniform(0, 2 * np.pi))
        target = frame.undone(sky.at(epoch) / factor)
        lists[name] = _detected(rng, recipe, sky.mag, target, partial(shown, k=k), epoch)
    return CampaignTruth(
        catalogue=sky.catalogue(rng),
        log={"exposure": np.array(names), "epoch": epochs, "vafactor": va}
        | {"filter": np.full(n, "F606W"), "pa_v3": np.zeros(n)},
        lists=lists,
        chips=recipe.chips,
        true_map=lambda x, y, epoch, k=0: shown(x, y, epoch, n + k),
        common=common,
        beside=total(*recipe.beside),
        known=lambda x, y, epoch: common(x, y, EPOCH0) + nearly(x, y),
        config=dict(recipe.config),
        epoch=LAST + recipe.beyond,
    )


class _Sky:
    """The stars as they are, and as the catalogue has them."""

    def __init__(self, rng: np.random.Generator, recipe: Recipe) -> None:
        n = int(recipe.stars * (2 * REACH / SIDE) ** 2)
        self.position = rng.uniform(-REACH, REACH, (n, 2))
        self.mag = FAINT - (FAINT - BRIGHT) * (1 - np.sqrt(rng.uniform(size=n)))
        self.known = TRUE_MOTION * rng.standard_normal((n, 2))
        self.unknown = np.zeros((n, 2)) if recipe.moving is None else recipe.moving(rng, n)
        self._astray = recipe.astray

    def at(self, epoch: float) -> np.ndarray:
        """Positions (N, 2) at a date."""
        return self.position + (epoch - EPOCH0) * (self.known + self.unknown)

    def catalogue(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Columns of the catalogue."""
        n = len(self.mag)
        seen = self.position + CATALOGUE * rng.standard_normal((n, 2))
        if self._astray is not None:
            seen = seen + self._astray(self.position)
        motion = self.known + MOTION * rng.standard_normal((n, 2))
        return {
            "u": seen[:, 0],
            "v": seen[:, 1],
            "sigma_u": np.full(n, CATALOGUE),
            "sigma_v": np.full(n, CATALOGUE),
            "pm_u": motion[:, 0],
            "pm_v": motion[:, 1],
            "sigma_pm_u": np.full(n, MOTION),
            "sigma_pm_v": np.full(n, MOTION),
            "mag": self.mag + 26.0,
            "epoch": np.full(n, EPOCH0),
        }


def _detected(
    rng: np.random.Generator,
    recipe: Recipe,
    mag: np.ndarray,
    target: np.ndarray,
    true_map: Map,
    epoch: float,
) -> dict[str, np.ndarray]:
    """Columns of the star list of one exposure, from positions along the axes of its map."""
    x, y = _mosaic_of(lambda x, y: true_map(x, y, epoch), target)
    columns: dict[str, list[np.ndarray]] = {key: [] for key in ("x", "y", "chip", "mag", "q")}
    for chip in recipe.chips:
        here = (x > 0.5) & (x < chip.columns + 0.5)
        here &= (y > chip.below + 0.5) & (y < chip.below + chip.rows + 0.5)
        at, m = np.stack([x[here], y[here]], axis=1), mag[here]
        if recipe.displaced is not None:
            at = at + recipe.displaced(at[:, 0], at[:, 1], m, epoch)
        at = at + centroid_sigma(m)[:, None] * recipe.centroids(rng, at.shape)
        blended = rng.uniform(size=len(at)) < BLENDED
        at = at + blended[:, None] * BLEND * rng.standard_normal(at.shape)
        n_false = rng.poisson(FALSE * len(at))
        false = rng.uniform(0.5, [chip.columns + 0.5, chip.rows + 0.5], (n_false, 2))
        at = np.concatenate([at - [0.0, chip.below], false])
        m = np.concatenate([m, rng.uniform(BRIGHT, FAINT, n_false)])
        m = m + 0.02 * rng.standard_normal(m.size)
        on = (at.min(axis=1) > 0.5) & (at[:, 0] < chip.columns + 0.5) & (at[:, 1] < chip.rows + 0.5)
        parts = (at[:, 0], at[:, 1], np.full(len(at), chip.number), m, np.full(len(at), 0.02))
        for key, values in zip(columns, parts, strict=True):
            columns[key].append(values[on])
    return {key: np.concatenate(parts) for key, parts in columns.items()}


def _mosaic_of(
    true_map: Callable[[np.ndarray, np.ndarray], np.ndarray], w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mosaic x, y (N,) that a map takes to positions (N, 2)."""
    at = w + MIDDLE
    for _ in range(30):  # distortions change by a few percent from place to place
        inner = np.clip(at, -200, SIDE + 200)
        at = at + w - true_map(*inner.T) - (at - inner)
    return at[:, 0], at[:, 1]


def _write_start(truth: CampaignTruth, path: Path) -> None:
    """The known distortion as an IDCTAB: monomials about the middle of each chip, in arcsec."""
    order = 3
    powers = [(i, j) for i in range(1, order + 1) for j in range(i + 1)]  # x^j y^(i-j)
    zero = None
    rows: dict[str, list[Any]] = {}
    for chip in truth.chips:
        middle = ((chip.columns + 1) / 2, (chip.rows + 1) / 2)
        x, y = (
            a.ravel()
            for a in np.meshgrid(np.linspace(1, chip.columns, 40), np.linspace(1, chip.rows, 40))
        )
        design = np.stack(
            [(x - middle[0]) ** j * (y - middle[1]) ** (i - j) for i, j in [(0, 0), *powers]], 1
        )
        scale = np.abs(design).max(axis=0)
        uv = truth.known(*chip.mosaic(x, y), EPOCH0)
        fitted = np.linalg.lstsq(design / scale, uv, rcond=None)[0] / scale[:, None] * ARCSEC
        zero = fitted[0] if zero is None else zero
        v2v3 = [200.0, 200.0] + (fitted[0] - zero) * [1, -1]  # the parity of ACS/WFC
        row: dict[str, Any] = {
            "DETCHIP": chip.number,
            "DIRECTION": "FORWARD",
            "XSIZE": chip.columns,
            "YSIZE": chip.rows,
            "XREF": middle[0],
            "YREF": middle[1],
            "V2REF": v2v3[0],
            "V3REF": v2v3[1],
            "SCALE": ARCSEC,
        }
        for axis, name in enumerate(("CX", "CY")):
            row |= {f"{name}{i}{j}": fitted[k + 1, axis] for k, (i, j) in enumerate(powers)}
        for key, value in row.items():
            rows.setdefault(key, []).append(value)
    primary = fits.PrimaryHDU()
    primary.header.update({"INSTRUME": "ACS", "DETECTOR": "WFC", "NORDER": order, "PARITY": -1})
    fits.HDUList([primary, fits.BinTableHDU(Table(rows))]).writeto(path)
