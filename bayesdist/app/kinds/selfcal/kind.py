"""Runs that begin with star lists alone."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from bayesdist.app.config import Config, SelfcalConfig
from bayesdist.app.kinds.fit_data import FitData, StarReader
from bayesdist.app.kinds.fitted import Fitted
from bayesdist.app.kinds.kind import EvaluationDomain, Questions, RunKind
from bayesdist.app.kinds.matched import Outline
from bayesdist.app.kinds.selfcal.fit import fit_selfcal, load_selfcal, sample_detections
from bayesdist.app.kinds.selfcal.inputs import (
    Inputs,
    outline_of_selfcal,
    read_selfcal,
    refuse_selfcal,
)
from bayesdist.app.kinds.selfcal.matched import SelfcalMatched, load_matched_selfcal
from bayesdist.app.kinds.selfcal.matching import match_dithers, selfcal_lines
from bayesdist.app.kinds.selfcal.solved import SelfCalibrated
from bayesdist.app.store.output import provenance_notes
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.infer import Posterior
from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import Check


class SelfcalKind(RunKind[SelfcalConfig, Inputs, SelfcalMatched]):
    """Star lists of dithered exposures; the positions of the stars are fitted as well."""

    rows = "detections"
    chooser = "limits of residuals"
    rehearses_fit = True
    new_frames = "affine"  # the orientation on the sky is unknown to a self-calibration
    no_order = (
        "is a self-calibration, whose stars take up what an order too low leaves, so that no star "
        "that is held out shows it"
    )

    def read(self, config: SelfcalConfig, base: Path) -> Inputs:
        """Detections, and additional constraints."""
        return read_selfcal(config, base)

    def refuse(self, inputs: Inputs) -> None:
        """Refuse exposures that cannot be aligned, and an unreadable initial distortion."""
        refuse_selfcal(inputs)

    def lines(self, inputs: Inputs) -> Iterator[str]:
        """Lines about stars and free directions."""
        return selfcal_lines(inputs)

    def outline(self, inputs: Inputs) -> Outline:
        """Shape of the solution, from the initial model."""
        return outline_of_selfcal(inputs)

    def match(self, inputs: Inputs, config: SelfcalConfig) -> SelfcalMatched:
        """Detections of the same stars, and a first solution."""
        return match_dithers(inputs)

    def load_matched(
        self, folder: Path, inputs: Inputs, config: SelfcalConfig, summary: Mapping[str, Any]
    ) -> SelfcalMatched:
        """Detections of an earlier stage."""
        return load_matched_selfcal(folder, inputs, summary)

    def fit(
        self, matched: SelfcalMatched, config: SelfcalConfig, base: Path, reader: StarReader
    ) -> Fitted:
        """Mode and gauge."""
        return fit_selfcal(matched)

    def load_fitted(self, folder: Path, matched: Callable[[], SelfcalMatched]) -> Fitted:
        """Fit of an earlier stage with its solution."""
        return load_selfcal(folder, matched)

    def fit_notes(self, data: FitData, config: SelfcalConfig) -> Iterator[tuple[int, str]]:
        """Sentences about the gauge."""
        gauge = data.fitted.part(SelfCalibrated).gauge
        for text in gauge.settled:
            yield logging.INFO, text
        for text in gauge.unsettled:
            yield logging.WARNING, text

    def sample(
        self,
        data: FitData,
        config: Config,
        *,
        folder: Path | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Posterior:
        """Posterior of the parameters, with the stars eliminated."""
        return sample_detections(data, config, folder=folder, progress=progress)

    def questions(self, data: FitData, config: SelfcalConfig) -> Questions:
        """Residuals are smaller by the degrees of freedom of the stars."""
        return Questions(
            centroid=data.fitted.errors.by_magnitude,
            eliminated=data.fitted.part(SelfCalibrated).mode,
        )

    def save_diagnosed(
        self,
        run: RunDirectory,
        data: FitData,
        posterior: Posterior,
        diagnostics: Diagnostics,
        config: SelfcalConfig,
    ) -> None:
        """Write the catalogue of the stars."""
        from bayesdist.app.kinds.selfcal.stars import write_stars  # needed by one stage

        solved = data.fitted.part(SelfCalibrated)
        notes = provenance_notes(posterior, solved.gauge_words)
        correlated, compute = diagnostics.correlated, config.resources()
        stars = write_stars(run.path, solved, correlated, notes, compute)
        run.summarise(selfcal=run.summary.get("selfcal", {}) | {"stars": stars})

    def domain(self, data: FitData, config: Config) -> EvaluationDomain:
        """As of matched stars; exposures overlap partly, which correlates frames with errors."""
        return replace(super().domain(data, config), frames=True)

    def null_space(self, data: FitData) -> Float | None:
        """Directions that only the gauge fixes."""
        return data.fitted.part(SelfCalibrated).gauge.null

    def checks(self, data: FitData, series: Mapping[str, Any]) -> tuple[Check, ...]:
        """Checks of degeneracies, constraints and detections."""
        solved = data.fitted.part(SelfCalibrated)
        named = {
            "Degeneracies": solved.gauge.sentences,
            "Constraints": solved.contradictions,
            "Detections": data.matched.warnings,
        }
        # settled by the choice of a gauge, so that they are not a fault of the data
        settled = set(solved.gauge.settled)
        return tuple(
            Check("Gauge", name, level="note" if text in settled else "warn", sentence=text)
            for name, texts in named.items()
            for text in texts
        )

    def report_parts(
        self,
        run: RunDirectory,
        data: FitData,
        posterior: Posterior,
        diagnostics: Diagnostics,
        epoch: float | None,
    ) -> dict[str, Any]:
        """Gauge and stars, and the words of a self-calibration."""
        from bayesdist.app.kinds.selfcal.report import report_fields  # needed by one stage

        return report_fields(run, data.fitted, posterior, epoch)


SELFCAL = SelfcalKind()
