"""Part of a self-calibration: its solution with the gauge."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bayesdist.app.artefacts.parts import Part
from bayesdist.app.store.output import write_table
from bayesdist.data import ReferenceCatalog
from bayesdist.data.matches import Matches
from bayesdist.diagnose.correlated import Discrepancy, DiscrepancyPriors
from bayesdist.diagnose.residuals.misfit import Misfit
from bayesdist.diagnose.score.result import ScoreTest
from bayesdist.files.hdf5 import write_arrays
from bayesdist.kinds.selfcal.diagnose.correlated import selfcal_discrepancy
from bayesdist.kinds.selfcal.diagnose.eliminated import taken_by_stars
from bayesdist.kinds.selfcal.diagnose.tests import dithered_misfit, selfcal_score_tests
from bayesdist.kinds.selfcal.infer import Gauge, SelfCalibrationMode
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int

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

    # -- bayesdist.diagnose.diagnostics.FittedStars -----------------------------------------------

    def misfits(self) -> tuple[Misfit, ...]:
        """Structure in the residuals of all chips."""
        return (dithered_misfit(self.mode),)

    def absorbed(self, rows: Int) -> Float:
        """Fraction (N,) of the variance of the detections that fitted positions of stars absorb."""
        solved_rows = self.mode.problem.rows
        fraction = np.zeros(max(int(solved_rows.max(initial=-1)), int(rows.max(initial=-1))) + 1)
        fraction[solved_rows] = taken_by_stars(self.mode)
        return fraction[rows]

    def discrepancy(self, *, rng: np.random.Generator, priors: DiscrepancyPriors) -> Discrepancy:
        """Correlated errors beyond the model."""
        return selfcal_discrepancy(self.mode, rng=rng, priors=priors)

    def score_tests(self, stars: Matches) -> tuple[ScoreTest, ...]:
        """Score tests of the residuals, with the stars eliminated."""
        return selfcal_score_tests(self.mode, mag=stars.mag, colour=stars.colour, epoch=stars.epoch)

    # -- bayesdist.app.artefacts.parts.Part -------------------------------------------------------

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
