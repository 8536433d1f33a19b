"""The solution of a self-calibration, as all stages after the fit take it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.selfcal.gauge import gauge_table, gauge_words
from bayesdist.app.tables.output import write_table
from bayesdist.data.matches import Matches
from bayesdist.infer.sampler.checkpoints import read_arrays, write_arrays
from bayesdist.infer.selfcal import Gauge, SelfCalibrationMode

__all__ = ["SelfCalibrated", "arrays_of", "read_solution"]

Float = NDArray[np.float64]

SOLUTION, GAUGE = "solution.h5", "gauge.ecsv"
ARRAYS = ("theta", "stars", "mixture", "held", "n_free", "reference")


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
    """

    mode: SelfCalibrationMode
    gauge: Gauge
    fixed: Mapping[str, str]
    matches: Matches
    arrays: Mapping[str, NDArray[Any]]
    contradictions: tuple[str, ...] = ()

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
