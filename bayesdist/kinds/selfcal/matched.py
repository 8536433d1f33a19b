"""Detections of a self-calibration matched with their stars, and a first solution.

As matches they can be used for the same statistics of residuals, maps and diagrams as those of
other runs.  The stars are fitted to their detections, so that residuals are smaller than the errors
by the corresponding degrees of freedom.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.artefacts.parts import Part
from bayesdist.app.run import Run
from bayesdist.data import MagnitudeErrors
from bayesdist.data.detections import Detections
from bayesdist.data.matches import Matches
from bayesdist.files.documents import json_of
from bayesdist.files.faults import restoring
from bayesdist.files.hdf5 import read_arrays, write_arrays
from bayesdist.kinds.selfcal.infer import SelfCalibrationMode
from bayesdist.kinds.selfcal.infer.calibrate import scatter_by_magnitude
from bayesdist.kinds.selfcal.infer.elimination import Mixture, memberships
from bayesdist.kinds.selfcal.infer.problem import Problem
from bayesdist.kinds.selfcal.inputs import Inputs
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float


def matches_of(
    problem: Problem,
    stars: Float,
    detections: Detections,
    inputs: Inputs,
    unused: Mapping[str, int],
) -> Matches:
    """Detections matched with their stars, in the frame of each exposure's own VAFACTOR.

    Parameters
    ----------
    problem : Problem
        Linearised at a solution.
    stars : ndarray, shape (S, q)
        Stars of the solution.
    detections : Detections
    inputs : Inputs
    unused : mapping of str to int
        Number of detections without a star, by reason.
    """
    p, d = problem, detections
    rows, model = p.rows, p.model
    places = p.star_places(stars)
    if p.dilation is not None:
        o = np.asarray(model.origin)
        places = o + (places - o) / p.dilation[d.exposure[rows], None]
    sigma = np.sqrt(p.var)[:, None] * _axes(p.W)
    numbers = np.array([chip.number for chip in model.chips])
    chip = np.zeros(len(rows), np.int64)
    for code, number in enumerate(numbers[1:], start=1):
        chip[d.chip[rows] == number] = code
    matches = Matches.of_distinct_rows(
        x=d.x[rows],
        y=d.y[rows],
        u=places[:, 0],
        v=places[:, 1],
        sigma_u=sigma[:, 0],
        sigma_v=sigma[:, 1],
        unit=model.unit,
        epoch=None if d.epoch is None else d.epoch[d.exposure[rows]],
        mag=None if d.mag is None else d.mag[rows],
        exposure=d.exposure[rows],
        exposure_names=d.exposure_names,
        chip=chip,
        chip_numbers=tuple(int(n) for n in numbers),
        row=rows,
        sources=(d.source,),
        n_rows=inputs.n_read,
        rejected={**inputs.rejected, **unused},
    )
    if p.shape is None:
        return matches
    W = p.W[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    return matches.with_covariances(p.var[:, None, None] * np.linalg.inv(W))


def _axes(W: Float) -> Float:
    """Error along u and v (N, 2) that corresponds to one pixel: sqrt of the diagonal of W^-1."""
    det = W[:, 0] * W[:, 2] - W[:, 1] ** 2
    return np.sqrt(np.stack([W[:, 2], W[:, 0]], axis=1) / det[:, None])


def magnitude_errors_of(solution: SelfCalibrationMode, matches: Matches) -> MagnitudeErrors | None:
    """Centroid errors by magnitude in the unit of u, v; None if there are no magnitudes."""
    if matches.mag is None:
        return None
    p = solution.problem
    state = p, solution.theta, solution.mixture, solution.stars
    middles, sigma = scatter_by_magnitude(*state, matches.mag)
    sigma = sigma * p.model.pixel_size(solution.theta)
    edges = np.concatenate([[-np.inf], (middles[1:] + middles[:-1]) / 2, [np.inf]])
    n = np.histogram(matches.mag, edges, weights=memberships(*state))[0]
    return MagnitudeErrors(middles, sigma, sigma, n.astype(np.int64), sigma, sigma)


DETECTIONS = "detections.h5"
ARRAYS = ("x", "y", "star", "sigma", "theta", "stars", "mixture", "model")


@dataclass(frozen=True, eq=False)
class FirstSolution(Part):
    """Detections with their stars, and the first solution that matched them."""

    title = "matched detections"
    stage = "match"

    # with star codes and errors, on a common tangent plane
    detections: Detections
    problem: Problem  # linearised at this solution
    theta: Float  # (D,), parameters
    places: Float  # (S, q), stars
    mixture: Mixture  # errors

    def save(self, folder: Path) -> None:
        """Write the detections and the solution to the folder of a run."""
        names, m = ("x", "y", "star", "sigma"), self.mixture
        arrays = {name: getattr(self.detections, name) for name in names}
        arrays |= {"theta": self.theta, "stars": self.places}
        arrays["mixture"] = np.array([m.jitter, m.fraction])
        text = json.dumps(self.problem.model.to_dict())
        arrays["model"] = np.frombuffer(text.encode(), np.uint8)
        write_arrays(folder / DETECTIONS, "", arrays)


def unused_detections(facts: Mapping[str, Any]) -> dict[str, int]:
    """Number of detections without a star, by reason.

    `facts` is the section 'selfcal' of summary.json.
    """
    return dict(facts.get("detections", {}).get("unused", {}))


def load_matched_selfcal(run: Run) -> Run:
    """Run with the detections of an earlier stage, from its folder."""
    inputs: Inputs = run.inputs
    path, content = run.directory / DETECTIONS, "a file of detections"
    do = "run the stage 'match' again"
    arrays = read_arrays(path, "", content, ARRAYS, do=do)
    with restoring(path, content, do=do):
        text = arrays["model"].astype(np.uint8).tobytes().decode()
        model = DistortionModel.from_dict(json_of(text, str(path)))
        detections = replace(
            inputs.detections,
            x=arrays["x"],
            y=arrays["y"],
            star=arrays["star"].astype(np.int64),
            sigma=arrays["sigma"],
        )
        mixture = Mixture(*(float(value) for value in arrays["mixture"]))
    first = arrays["theta"], arrays["stars"], mixture
    facts = run.directory.summary.get("selfcal", {})
    return with_detections(run, detections, model, first, facts=facts)


def with_detections(
    run: Run,
    detections: Detections,
    model: DistortionModel,
    first: tuple[Float, Float, Mixture],
    *,
    facts: Mapping[str, Any],
    table: Table | None = None,
) -> Run:
    """Run with detections that are matched with their stars by a first solution.

    Parameters
    ----------
    run : Run
    detections : Detections
        With star codes and errors.
    model : DistortionModel
    first : tuple
        First solution: parameters (D,), stars (S, q) and outlier mixture.
    facts : mapping of str to object
        Section 'selfcal' of summary.json.
    table : Table, optional
        One row per exposure.
    """
    inputs: Inputs = run.inputs
    theta, places, mixture = first
    problem = inputs.problem(model, detections, theta, theta)
    return run.having(
        stars=matches_of(problem, places, detections, inputs, unused_detections(facts)),
        match_facts=facts,
        match_table=table,
        match_parts={"first": FirstSolution(detections, problem, theta, places, mixture)},
    )
