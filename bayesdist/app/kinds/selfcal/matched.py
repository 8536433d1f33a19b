"""The detections of a self-calibration with their stars, also as pairs, and a first solution.

So the usual statistics of residuals, maps of bins and diagrams serve self-calibrations too.  Stars
follow their detections: residuals are smaller than the errors by what that takes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from astropy.table import Table

from bayesdist.app.kinds.matched import Matched
from bayesdist.app.kinds.selfcal.inputs import Inputs
from bayesdist.data import MagnitudeErrors
from bayesdist.data.detections import Detections
from bayesdist.data.matches import Matches
from bayesdist.files.documents import json_of
from bayesdist.files.faults import restoring
from bayesdist.files.hdf5 import read_arrays, write_arrays
from bayesdist.infer.selfcal import SelfCalibrationMode
from bayesdist.infer.selfcal.calibrate import scatter_by_magnitude
from bayesdist.infer.selfcal.elimination import Mixture, memberships
from bayesdist.infer.selfcal.problem import Problem
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float


def matches_of(
    problem: Problem,
    stars: Float,
    detections: Detections,
    inputs: Inputs,
    unused: Mapping[str, int],
) -> Matches:
    """Detections of the stars beside these, in the frame of each exposure's own VAFACTOR.

    `problem`: linearised at a solution with these `stars` (S, q). `unused`: detections that are of
    no star, by reason.
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
    return Matches.of_distinct_rows(
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


def _axes(W: Float) -> Float:
    """Error along u and along v (N, 2) of a pixel of error: of W^-1."""
    det = W[:, 0] * W[:, 2] - W[:, 1] ** 2
    return np.sqrt(np.stack([W[:, 2], W[:, 0]], axis=1) / det[:, None])


def magnitude_errors_of(solution: SelfCalibrationMode, matches: Matches) -> MagnitudeErrors | None:
    """Errors of centroids by magnitude, in the unit of u, v; None without magnitudes."""
    if matches.mag is None:
        return None
    p = solution.problem
    given = p, solution.theta, solution.mixture, solution.stars
    middles, sigma = scatter_by_magnitude(*given, matches.mag)
    sigma = sigma * p.model.pixel_size(solution.theta)
    edges = np.concatenate([[-np.inf], (middles[1:] + middles[:-1]) / 2, [np.inf]])
    n = np.histogram(matches.mag, edges, weights=memberships(*given))[0]
    return MagnitudeErrors(middles, sigma, sigma, n.astype(np.int64), sigma, sigma)


DETECTIONS = "detections.h5"
ARRAYS = ("x", "y", "star", "sigma", "theta", "stars", "mixture", "model")


@dataclass(frozen=True, eq=False)
class SelfcalMatched(Matched):
    """Detections beside their stars, by a first solution."""

    section: ClassVar[str] = "selfcal"
    has_catalogue: ClassVar[bool] = False
    along_detector: ClassVar[bool] = True

    inputs: Inputs = field(kw_only=True)
    # with their stars and errors, on one tangent plane
    detections: Detections = field(kw_only=True)
    problem: Problem = field(kw_only=True)  # linearised at the first solution
    theta: Float = field(kw_only=True)  # (D,), of the first solution
    places: Float = field(kw_only=True)  # (S, q), its stars
    mixture: Mixture = field(kw_only=True)  # its errors

    @property
    def unused(self) -> dict[str, int]:
        """Detections that are of no star, by reason."""
        return dict(self.facts.get("detections", {}).get("unused", {}))

    def save(self, folder: Path) -> None:
        """Write the files of a run's folder that belong to it."""
        names, m = ("x", "y", "star", "sigma"), self.mixture
        arrays = {name: getattr(self.detections, name) for name in names}
        arrays |= {"theta": self.theta, "stars": self.places}
        arrays["mixture"] = np.array([m.jitter, m.fraction])
        text = json.dumps(self.problem.model.to_dict())
        arrays["model"] = np.frombuffer(text.encode(), np.uint8)
        write_arrays(folder / DETECTIONS, "", arrays)
        super().save(folder)


def load_matched_selfcal(
    folder: Path, inputs: Inputs, summary: Mapping[str, Any]
) -> SelfcalMatched:
    """The detections of an earlier stage."""
    path, what, do = folder / DETECTIONS, "a file of detections", "run the stage 'match' again"
    arrays = read_arrays(path, "", what, ARRAYS, do=do)
    with restoring(path, what, do=do):
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
    return selfcal_matched(inputs, detections, model, first, facts=summary.get("selfcal", {}))


def selfcal_matched(
    inputs: Inputs,
    detections: Detections,
    model: DistortionModel,
    first: tuple[Float, Float, Mixture],
    *,
    facts: Mapping[str, Any],
    table: Table | None = None,
) -> SelfcalMatched:
    """Detections with codes of stars and errors, by a first solution: parameters, stars, errors."""
    theta, places, mixture = first
    problem = inputs.problem(model, detections, theta, theta)
    unused = facts.get("detections", {}).get("unused", {})
    return SelfcalMatched(
        matches_of(problem, places, detections, inputs, unused),
        facts=facts,
        table=table,
        inputs=inputs,
        detections=detections,
        problem=problem,
        theta=theta,
        places=places,
        mixture=mixture,
    )
