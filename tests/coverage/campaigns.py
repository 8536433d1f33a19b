"""Small campaigns of known truth, carried through the application as far as its assessment."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.table import Table
from scipy.interpolate import RegularGridInterpolator

from bayesdist.app.config import load_config
from bayesdist.app.run import Run
from bayesdist.app.stages import make_stages
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.model import Chip, DistortionModel, TimeDependence
from bayesdist.simulate import simulate_matches

SIDE, NODES = 2048, 64  # pixels: of the detector, and between the nodes of its pattern
STARS, FALSE, JITTER = 4000, 0.03, 0.01
FIRST, LAST, BEYOND = 2002.0, 2012.0, 2017.0  # dates of the data, and the last one assessed
EXPOSURES = 16
DRIFTING = (("u", 1, 0), ("v", 1, 0), ("v", 0, 1))
BRIGHT, FAINT = -14.0, -10.0
OFFSET = 0.004  # px: the reference catalogue's error, one shift of all stars, as the user gives it

CONFIG = """
[data]
matches = "stars.parquet"
unit = "pix"
columns = {{sigma_u = "su", sigma_v = "sv"}}
[detector]
name = "A"
size = [{side}, {side}]
[model]
order = 3
reference_pixel = [{middle}, {middle}]
{model}
[sampler]
seed = {seed}
target_ess = 400
[assess]
grid = [17, 17]
draws = 2000
{assess}
[[budget]]
name = "reference catalogue"
kind = "systematic"
sigma_u = {offset}
sigma_v = {offset}
"""
DRIFT = """frames = "shift_rotation"
[model.tdd]
epoch0 = 2004.5
terms = [["u", 1, 0], ["v", 1, 0], ["v", 0, 1]]
"""


@dataclass(frozen=True)
class Kind:
    """What campaigns of one kind have beside a polynomial of order 3.

    Parameters
    ----------
    pattern : float
        Rms in pixels, on each axis, of a pattern that the model leaves out.
    drift : bool
        Whether linear terms drift, and exposures have a shift and a rotation each.
    """

    pattern: float = 0.0
    drift: bool = False


KINDS = {
    "polynomial": Kind(),
    "pattern": Kind(pattern=0.02),
    "drift": Kind(drift=True),
    "drift and pattern": Kind(pattern=0.02, drift=True),
}


class Pattern:
    """Independent normal offsets of nodes laid over the detector anyhow, bilinear in between.

    Divided by the root of the sum of the squares of the four weights, so that the offsets of all
    places have the same normal distribution.
    """

    def __init__(self, rng: np.random.Generator, rms: float) -> None:
        nodes = NODES * np.arange(SIDE // NODES + 2)
        self._begin = rng.uniform(0, NODES, 2)
        values = rms * rng.standard_normal((nodes.size, nodes.size, 2))
        self._between = RegularGridInterpolator((nodes, nodes), values)

    def __call__(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        at = np.stack([y, x], axis=-1) - 0.5 + self._begin
        t = at / NODES % 1
        return self._between(at) / np.sqrt(np.prod(t**2 + (1 - t) ** 2, axis=-1))[..., None]


@dataclass(frozen=True, eq=False)
class Campaign:
    """Truth and data.

    Parameters
    ----------
    model : DistortionModel
    theta : ndarray, shape (D,)
    pattern : Pattern
    stars : Table
    rng : numpy.random.Generator
        For what is not data: the places, and the stars there.
    """

    model: DistortionModel
    theta: np.ndarray
    pattern: Pattern
    stars: Table
    rng: np.random.Generator


def centroid_sigma(mag: np.ndarray) -> np.ndarray:
    """Quoted error of both axes, in pixels."""
    return np.hypot(0.01, 0.05 * 10 ** (0.2 * (np.asarray(mag) - FAINT)))


def campaign(kind: Kind, seed: int) -> Campaign:
    rng = np.random.default_rng([12, seed])
    names = tuple(f"e{k:02d}" for k in range(EXPOSURES)) if kind.drift else ("only",)
    model = DistortionModel(
        3,
        (Chip(1, "A", (SIDE, SIDE), (SIDE / 2, SIDE / 2)),),
        frames="shift_rotation" if kind.drift else "none",
        exposures=names,
        time=TimeDependence(DRIFTING, (2004.5,)) if kind.drift else None,
        origin=(SIDE / 2, SIDE / 2),
    )
    theta = np.zeros(model.n_params)
    for axis in (0, 1):
        c = 3.0 * rng.standard_normal(model.n_terms) / (1 + np.arange(model.n_terms))
        c[0] += SIDE / 2
        c[1 + axis] += SIDE / 2
        theta[model.coefficient_slice(1, axis)] = c
    theta[model.tdd_slice(1)] = 1e-5 * rng.standard_normal(model.n_tdd)
    for block in model.local_blocks:
        theta[block] = [5.0, 5.0, 1e-3] * rng.standard_normal(3)
    mag = rng.uniform(BRIGHT, FAINT, STARS)
    matches, _ = simulate_matches(
        model,
        theta,
        STARS,
        rng=rng,
        sigma=lambda m: (centroid_sigma(m),) * 2,
        mag=mag,
        fraction=FALSE,
        jitter=JITTER,
        epochs=np.linspace(FIRST, LAST, EXPOSURES) if kind.drift else None,
    )
    pattern = Pattern(rng, kind.pattern)
    seen = np.column_stack([matches.u, matches.v]) + pattern(matches.x, matches.y)
    columns = {"x": matches.x, "y": matches.y, "u": seen[:, 0], "v": seen[:, 1]}
    columns |= {"su": matches.sigma_u, "sv": matches.sigma_v, "mag": mag}
    if kind.drift:
        columns |= {"epoch": matches.epoch, "exposure": np.array(names)[matches.exposure]}
    return Campaign(model, theta, pattern, Table(columns), rng)


def assessed(kind: Kind, seed: int, stars: Table, folder: Path) -> Run:
    """As `bayesdist run` has it when budget and margins are made."""
    stars.write(folder / "stars.parquet")
    text = CONFIG.format(
        side=SIDE,
        middle=SIDE / 2,
        seed=seed + 1,
        model=DRIFT if kind.drift else "",
        assess=f"epoch = {BEYOND}" if kind.drift else "",
        offset=OFFSET,
    )
    (folder / "config.toml").write_text(text)
    config, text = load_config(folder / "config.toml")
    directory = RunDirectory.plan(folder / "run", config, text, folder)
    results = Run.of(directory)
    directory.begin()
    return make_stages(results, ("fit", "sample", "diagnose"))
