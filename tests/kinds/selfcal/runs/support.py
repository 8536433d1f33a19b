"""Small dithered fields as star lists, and configurations that calibrate them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.config import load_config
from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from tests.app.support import after_stages, write_config
from tests.kinds.selfcal.dithered_fields import DitheredField
from tests.kinds.selfcal.infer.fields import SIZE, field

SCALE_MAS = 50.0
MODEL = {"order": 3, "reference_pixel": (512.0, 512.0)}


def small(seed: int = 3, rolls: tuple[float, ...] = (0, 60, 130), **more: Any) -> DitheredField:
    """Eight exposures, some three hundred stars, one detection in thirty of them false."""
    return field(seed, 8, 600, rolls=rolls, **{"disturbed": 0.03} | more)


def list_table(simulated: DitheredField) -> Table:
    """Detections as an observer has them: x, y, exposure, mag, and of several chips these."""
    d = simulated.detections
    names = np.array(d.exposure_names)[d.exposure]
    table = Table({"x": d.x, "y": d.y, "exposure": names, "mag": d.mag})
    if len(simulated.model.chips) > 1:
        table["chip"] = d.chip
    return table


def write_selfcal(folder: Path, lists: Table, **sections: Any) -> Path:
    """lists.ecsv and config.toml in a folder; the configuration's path."""
    folder.mkdir(parents=True, exist_ok=True)
    lists.write(folder / "lists.ecsv")
    block = {"lists": "lists.ecsv", "match_radius": 0.5, "start_radius": 3.0}
    block |= sections.pop("selfcal", {})
    given = {"detector": {"size": SIZE, "scale_mas": SCALE_MAS}, "model": MODEL} | sections
    return write_config(folder / "config.toml", **{"data": None, "selfcal": block} | given)


def commanded(simulated: DitheredField, sigma: float, rng: np.random.Generator) -> Table:
    """Where the exposures were to point, in pixels, with errors."""
    model, E = simulated.model, len(simulated.model.exposures)
    x, y = (np.full(E, c) for c in model.chips[0].reference_pixel)
    places = model.predict(simulated.theta, x, y, exposure=np.arange(E))
    off = places - places[0] + sigma * rng.standard_normal((E, 2))
    roll = [np.degrees(np.arctan2(M[1, 0], M[0, 0])) for M in frame_matrices(simulated)]
    return Table(
        {
            "exposure": list(model.exposures),
            "du": off[:, 0],
            "dv": off[:, 1],
            "sigma": np.full(E, sigma),
            "roll": roll,
        },
        units={"du": "pix", "dv": "pix", "sigma": "pix", "roll": "deg"},
    )


def frame_matrices(simulated: DitheredField) -> list[np.ndarray]:
    """True linear part of the frame of each exposure."""
    model = simulated.model
    return [model.frame(simulated.theta, e)[0] for e in range(len(model.exposures))]


def affine_left(here: np.ndarray, there: np.ndarray, at: np.ndarray, kind: str) -> np.ndarray:
    """What is left of positions after the best similarity, or linear map, from here to there.

    Parameters
    ----------
    here, there : ndarray, shape (N, 2)
        Pairs that decide, spread evenly over the detector.
    at : ndarray, shape (M, 2)
        Where the map is taken, on the plane of `here`.
    kind : str
        'similarity' or 'linear'.

    Returns
    -------
    ndarray, shape (M, 2)
        The map's change of the positions.
    """
    if kind == "linear":
        design = np.column_stack([np.ones(len(here)), here])
        found = np.linalg.lstsq(design, there - here, rcond=None)[0]
        return np.column_stack([np.ones(len(at)), at]) @ found
    z, w = here @ [1, 1j], (there - here) @ [1, 1j]
    design = np.column_stack([np.ones(len(z)), z])
    found = np.linalg.lstsq(design, w, rcond=None)[0]
    moved = np.column_stack([np.ones(len(at)), at @ [1, 1j]]) @ found
    return np.column_stack([moved.real, moved.imag])


def fitted(folder: Path, config: Path) -> Run:
    """Results of a run after its stages 'match' and 'fit'."""
    given, text = load_config(config)
    run = RunDirectory.plan(folder, given, text, config.parent)
    return after_stages(run, "match", "fit", rehearsed=False)


def directions(run: Run) -> dict[str, dict[str, Any]]:
    """What summary.json says of each property of the solution, by name."""
    return {d["name"]: d for d in run.directory.summary["selfcal"]["gauge"]["directions"]}
