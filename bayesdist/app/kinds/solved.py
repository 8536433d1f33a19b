"""The solution of detections whose stars are not known otherwise, with its gauge and files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from astropy.table import Table
from numpy.typing import NDArray

from bayesdist.app.tables.output import write_table
from bayesdist.data import ReferenceCatalog
from bayesdist.data.matches import Matches
from bayesdist.infer.sampler.checkpoints import write_arrays
from bayesdist.infer.selfcal import Gauge, SelfCalibrationMode

__all__ = ["SOLUTION", "SelfCalibrated"]

SOLUTION, GAUGE = "solution.h5", "gauge.ecsv"


@dataclass(frozen=True, eq=False)
class SelfCalibrated:
    """The mode of a self-calibration, with its gauge and matches.

    Parameters
    ----------
    mode : SelfCalibrationMode
    gauge : Gauge
        Degeneracies of the detections, and the constraints that remove them.
    fixed : mapping of str to str
        What fixes each property of the solution.
    gauge_words : str
        In which gauge the solution stands, as a sentence.
    gauge_table : astropy.table.Table
        One row for each property of the solution.
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
    gauge_words: str
    gauge_table: Table
    matches: Matches
    arrays: Mapping[str, NDArray[Any]]
    contradictions: tuple[str, ...] = ()
    references: ReferenceCatalog | None = None

    def save(self, folder: Path) -> None:
        """Write the files of a run's folder that belong to it."""
        write_arrays(folder / SOLUTION, "", self.arrays)
        write_table(self.gauge_table, folder / GAUGE)
