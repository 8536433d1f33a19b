"""The solution of a self-calibration, as all stages after the fit take it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.selfcal.gauge import fixed_by, gauge_table, gauge_words
from bayesdist.app.selfcal.matched import SelfcalMatched
from bayesdist.app.selfcal.matches import matches_of
from bayesdist.app.tables.output import write_table
from bayesdist.data import ReferenceCatalog
from bayesdist.data.matches import Matches
from bayesdist.infer.sampler.checkpoints import read_arrays, write_arrays
from bayesdist.infer.selfcal import Gauge, SelfCalibrationMode
from bayesdist.infer.selfcal.elimination import Mixture, expand
from bayesdist.infer.selfcal.gauge import Decision
from bayesdist.infer.selfcal.mode import gauge_of
from bayesdist.model import DistortionModel

__all__ = ["SelfCalibrated", "arrays_of", "read_solution", "solved_of"]

Float = NDArray[np.float64]

SOLUTION, GAUGE = "solution.h5", "gauge.ecsv"
ARRAYS = ("theta", "stars", "mixture", "held", "n_free", "reference")
RELINEARISED = 3  # times a problem is linearised anew about a solution that is read


@dataclass(frozen=True, eq=False)
class SelfCalibrated:
    """The mode of a self-calibration, with its gauge and matches.

    Parameters
    ----------
    mode : SelfCalibrationMode
    gauge : Gauge
        What the detections leave free, and what fixes it.
    fixed : mapping of str to str
        What fixes each property of the solution.
    matches : Matches
        Detections beside their stars.
    arrays : mapping
        From which the solution is made again.
    contradictions : tuple of str
        Where what is known beside the detections does not go with them, as sentences.
    references : ReferenceCatalog or None
        Stars that a catalogue has, too.
    """

    mode: SelfCalibrationMode
    gauge: Gauge
    fixed: Mapping[str, str]
    matches: Matches
    arrays: Mapping[str, NDArray[Any]]
    contradictions: tuple[str, ...] = ()
    references: ReferenceCatalog | None = None

    @property
    def gauge_words(self) -> str:
        """In which gauge the solution stands, as a sentence."""
        return gauge_words(self.gauge, self.fixed, self.mode.problem.model)

    def save(self, folder: Path) -> None:
        """Write the files of a run's folder that belong to it."""
        write_arrays(folder / SOLUTION, "", self.arrays)
        table = gauge_table(self.gauge, self.fixed, self.mode.problem.model)
        write_table(table, folder / GAUGE)


def arrays_of(solution: SelfCalibrationMode, reference: Float) -> dict[str, NDArray[Any]]:
    """A solution as arrays; `reference` is where what is known beside it was linearised."""
    mixture, decision = solution.mixture, solution.decision
    counts = (0, 0) if decision is None else (decision.n_null, decision.n_open)
    held = np.setdiff1d(np.arange(len(solution.theta)), solution.free)
    return {
        "theta": solution.theta,
        "stars": solution.stars,
        "mixture": np.array([mixture.jitter, mixture.fraction]),
        "held": held if decision is None else decision.held,
        "n_free": np.array(counts),
        "reference": reference,
    }


def read_solution(folder: Path) -> dict[str, NDArray[Any]]:
    """The arrays of an earlier stage.

    Raises
    ------
    InputError
        For a missing or damaged file.
    """
    return read_arrays(folder / SOLUTION, "", ARRAYS, do="run the stage 'fit' again")


def solved_of(
    matched: SelfcalMatched, model: DistortionModel, arrays: Mapping[str, NDArray[Any]]
) -> SelfCalibrated:
    """The solution that `arrays_of` made arrays of: what the fit has is what later stages read."""
    inputs, held = matched.inputs, arrays["held"].astype(np.int64)
    theta, stars = arrays["theta"], arrays["stars"]
    jitter, fraction = (float(v) for v in arrays["mixture"])
    n_null, n_open = (int(n) for n in arrays["n_free"])
    mixture, known = Mixture(jitter, fraction), inputs.known_for(model)
    problem = inputs.problem(model, matched.detections, theta, matched.theta)
    for _ in range(RELINEARISED):
        problem = problem.at(theta, stars)
    found = expand(problem, theta, mixture, stars)
    solution = SelfCalibrationMode(
        problem,
        theta,
        problem.found_again(theta, found.stars),
        mixture,
        np.setdiff1d(np.arange(model.n_params), held),
        found,
        known(arrays["reference"]),
        Decision(n_null, n_open, held),
    )
    gauge = gauge_of(problem, theta, known(theta), solution)
    places = solution.stars
    return SelfCalibrated(
        solution,
        gauge,
        fixed_by(gauge, solution, known),
        matches_of(problem, places, matched.detections, inputs, matched.unused),
        arrays,
        tuple(known.contradictions(theta)),
        inputs.catalog,
    )
