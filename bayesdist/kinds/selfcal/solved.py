"""Part of a self-calibration: its solution with the gauge."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from astropy.table import Table
from numpy.typing import NDArray

from bayesdist.app.artefacts.parts import Part
from bayesdist.app.store.output import write_table
from bayesdist.data import ReferenceCatalog
from bayesdist.data.matches import Matches
from bayesdist.files.hdf5 import write_arrays
from bayesdist.infer.selfcal import Gauge, SelfCalibrationMode
from bayesdist.model import DistortionModel

SOLUTION, GAUGE = "solution.h5", "gauge.ecsv"


@dataclass(frozen=True, eq=False)
class SelfCalibrated(Part):
    """Mode of a self-calibration with its gauge and matches."""

    title = "solution of detections"
    applies_errors = True

    mode: SelfCalibrationMode
    gauge: Gauge  # degeneracies of the detections, and the constraints that remove them
    fixed: Mapping[str, str]  # constraint on each property of the solution, by its name
    gauge_words: str  # sentence that states the gauge of the solution
    gauge_table: Table  # one row for each property of the solution
    matches: Matches  # detections matched with their stars
    arrays: Mapping[str, NDArray[Any]]  # from which the solution is restored
    # sentences about constraints that contradict the detections
    contradictions: tuple[str, ...] = ()
    references: ReferenceCatalog | None = None  # reference stars that are also in a catalogue
    # point (u, v) where the tangent plane of the stars touches the sky; None if the sky is flat
    contact: tuple[float, float] | None = None

    def save(self, folder: Path) -> None:
        """Write the solution and the gauge to the folder of a run."""
        write_arrays(folder / SOLUTION, "", self.arrays)
        write_table(self.gauge_table, folder / GAUGE)

    def placed(self, stars: Matches, model: DistortionModel) -> Matches:
        """Detections matched with the positions of the solved stars."""
        return self.matches

    def gauge_sentence(self) -> str:
        """Sentence that states the gauge of the solution."""
        return self.gauge_words
