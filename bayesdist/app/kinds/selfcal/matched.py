"""The detections of a self-calibration with their stars, and a first solution."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bayesdist.app.kinds.matched import Matched
from bayesdist.app.kinds.selfcal.inputs import Inputs
from bayesdist.app.kinds.selfcal.matches import matches_of
from bayesdist.data.detections import Detections
from bayesdist.data.matches import Matches
from bayesdist.infer.sampler.checkpoints import read_arrays, write_arrays
from bayesdist.infer.selfcal.elimination import Mixture
from bayesdist.infer.selfcal.problem import Problem
from bayesdist.model import DistortionModel
from bayesdist.reading.documents import json_of
from bayesdist.reading.faults import restoring

__all__ = ["SelfcalMatched", "load_matched_selfcal", "selfcal_matched"]

Float = NDArray[np.float64]

DETECTIONS = "detections.h5"
ARRAYS = ("x", "y", "star", "sigma", "theta", "stars", "mixture", "model")


@dataclass(frozen=True, eq=False)
class SelfcalMatched(Matched):
    """Detections beside their stars, by a first solution.

    Parameters
    ----------
    inputs : Inputs
    detections : Detections
        With their stars and errors, on one tangent plane.
    problem : Problem
        Linearised at the first solution.
    theta : ndarray, shape (D,)
        Of the first solution.
    places : ndarray, shape (S, q)
        Its stars.
    mixture : Mixture
        Its errors.
    """

    section: ClassVar[str] = "selfcal"
    has_catalogue: ClassVar[bool] = False

    stars: Matches
    inputs: Inputs = field(kw_only=True)
    detections: Detections = field(kw_only=True)
    problem: Problem = field(kw_only=True)
    theta: Float = field(kw_only=True)
    places: Float = field(kw_only=True)
    mixture: Mixture = field(kw_only=True)

    @property
    def tangent_point(self) -> None:
        """None: u and v lie along the detector."""
        return None

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
    """The detections of an earlier stage.

    Raises
    ------
    InputError
        For a missing or damaged file.
    """
    arrays = read_arrays(folder / DETECTIONS, "", ARRAYS, do="run the stage 'match' again")
    path = folder / DETECTIONS
    with restoring(path, "a file of detections", do="run the stage 'match' again"):
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
