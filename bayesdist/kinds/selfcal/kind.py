"""Runs that begin with star lists alone."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from bayesdist.app.kind import EvaluatedExposure, FurtherExposures, Outline, Questions, RunKind
from bayesdist.app.run import Run
from bayesdist.app.store.record import provenance_notes
from bayesdist.assess.planning import Schedule
from bayesdist.assess.requirements.requirement import Requirement
from bayesdist.infer import Posterior
from bayesdist.infer.compare.planning import ExposureContent
from bayesdist.kinds.selfcal.config import SelfcalConfig
from bayesdist.kinds.selfcal.fit import SelfCalibrated, fit_selfcal, load_selfcal, sample_detections
from bayesdist.kinds.selfcal.infer import SelfCalibrationMode
from bayesdist.kinds.selfcal.inputs import (
    SelfcalInputs,
    outline_of_selfcal,
    read_selfcal,
    refuse_selfcal,
)
from bayesdist.kinds.selfcal.matching import load_matched_selfcal, match_dithers, selfcal_lines
from bayesdist.kinds.selfcal.patterns.dithers import further_dithers
from bayesdist.report.run import Terminology
from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import Check

if TYPE_CHECKING:
    from bayesdist.kinds.selfcal.report import SelfcalData

DETECTED = Terminology(
    rows="detections",
    all_rows="detections of stars",
    false_rows="false detections",
    rejection="limits of residuals",
    fit="solution",
    fit_title="Solution",
    constraint="the gauge",
    leverage=", less what the fitted stars take of them",
    held="Held by the gauge, and therefore not shown: the detections say nothing of what these"
    " parameters stand for",
    with_shift=", in the gauge of the solution",
    gauge_of_maps="What the gauge holds by convention, shift and rotation of the detector as a"
    " whole among them unless something fixes them, has no error here.",
    relative_map=" That of relative positions is the same in any gauge of shift, rotation and scale"
    " (and skew, where all exposures have one roll angle); the other is that of the run's gauge.",
    residuals=" Stars were fitted to these detections, so that fewer may do so than by chance; the"
    " status has the test that allows for it.",
)


class SelfcalKind(RunKind[SelfcalConfig, SelfcalInputs]):
    """Star lists of dithered exposures; the positions of the stars are fitted as well."""

    section = "selfcal"
    has_catalogue = False
    along_detector = True
    words = DETECTED
    rehearses_fit = True
    new_frames = "affine"  # the orientation on the sky is unknown to a self-calibration
    no_order = (
        "is a self-calibration, whose stars take up what an order too low leaves, so that no star "
        "that is held out shows it"
    )

    def read(self, config: SelfcalConfig, base: Path) -> SelfcalInputs:
        """Detections, and additional constraints."""
        return read_selfcal(config, base)

    def refuse(self, inputs: SelfcalInputs) -> None:
        """Refuse exposures that cannot be aligned, and an unreadable initial distortion."""
        refuse_selfcal(inputs)

    def lines(self, inputs: SelfcalInputs) -> Iterator[str]:
        """Lines about stars and free directions."""
        return selfcal_lines(inputs)

    def outline(self, inputs: SelfcalInputs) -> Outline:
        """Shape of the solution, from the initial model."""
        return outline_of_selfcal(inputs)

    def with_config(self, inputs: SelfcalInputs, config: SelfcalConfig) -> SelfcalInputs:
        """Inputs for another configuration, which differs in the model only."""
        return replace(inputs, config=config)

    def match(self, run: Run) -> Run:
        """Run with the detections of the same stars, and a first solution."""
        return match_dithers(run)

    def load_matched(self, run: Run) -> Run:
        """Run with the detections of an earlier stage."""
        return load_matched_selfcal(run)

    def fit(self, run: Run) -> Run:
        """Run with mode and gauge."""
        return fit_selfcal(run)

    def load_fit(self, run: Run) -> Run:
        """Run with the fit of an earlier stage and its solution."""
        return load_selfcal(run)

    def fit_notes(self, run: Run) -> Iterator[tuple[int, str]]:
        """Sentences about the gauge."""
        gauge = run.part(SelfCalibrated).gauge
        for text in gauge.settled:
            yield logging.INFO, text
        for text in gauge.unsettled:
            yield logging.WARNING, text

    def sample(
        self,
        run: Run,
        *,
        folder: Path | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Posterior:
        """Posterior of the parameters, with the stars eliminated."""
        return sample_detections(run, folder=folder, progress=progress)

    def questions(self, run: Run) -> Questions:
        """Residuals are smaller by the degrees of freedom of the stars."""
        return Questions(
            centroid=run.errors.by_magnitude,
            eliminated=run.part(SelfCalibrated),
        )

    def save_diagnosed(self, run: Run) -> None:
        """Write the catalogue of the stars."""
        from bayesdist.kinds.selfcal.fit import write_stars  # needed by one stage

        solved, directory = run.part(SelfCalibrated), run.directory
        notes = provenance_notes(run.posterior, solved.gauge_words)
        correlated, compute = run.diagnostics.correlated, run.config.resources()
        stars = write_stars(directory.path, solved, correlated, notes, compute)
        directory.summarise(selfcal=directory.summary.get("selfcal", {}) | {"stars": stars})

    def domain(self, run: Run) -> EvaluatedExposure:
        """As of matched stars; exposures overlap partly, which correlates frames with errors."""
        return replace(super().domain(run), frames=True)

    def null_space(self, run: Run) -> Float | None:
        """Directions that only the gauge fixes."""
        return run.part(SelfCalibrated).gauge.null

    def further_exposures(self, run: Run) -> DitheredExposures:
        """Exposures dithered like the existing ones, over the same stars."""
        return DitheredExposures(run, run.part(SelfCalibrated).mode)

    def checks(self, run: Run) -> tuple[Check, ...]:
        """Checks of degeneracies, constraints and detections."""
        solved = run.part(SelfCalibrated)
        named = {
            "Degeneracies": solved.gauge.sentences,
            "Constraints": solved.contradictions,
            "Detections": run.match_facts.get("warnings", ()),
        }
        # settled by the choice of a gauge, so that they are not a fault of the data
        settled = set(solved.gauge.settled)
        return tuple(
            Check("Gauge", name, level="note" if text in settled else "warn", sentence=text)
            for name, texts in named.items()
            for text in texts
        )

    def held_parameters(self, run: Run) -> frozenset[str]:
        """Names of the parameters that the gauge alone constrains."""
        names = run.model.names
        return frozenset(names[k] for k in run.part(SelfCalibrated).gauge.held)

    def report_data(self, run: Run) -> SelfcalData:
        """Gauge, stars and outlines of the exposures."""
        from bayesdist.kinds.selfcal.report import data_of_selfcal  # needed by one stage

        return data_of_selfcal(run)


class DitheredExposures(FurtherExposures):
    """Exposures of a self-calibration; each is informative about stars in other exposures only."""

    dateless = (
        "is a run of a self-calibration, whose exposures count as those at hand with their dates"
    )

    def __init__(self, run: Run, mode: SelfCalibrationMode) -> None:
        super().__init__(run)
        self.mode, self.gain = mode, mode.gain

    @property
    def count(self) -> int:
        """Number of exposures of the run."""
        return len(self.mode.problem.model.exposures)

    def sentence(self, content: ExposureContent) -> str:
        """Sentence on the exposures that are assumed."""
        return f"Exposures are taken to be dithered as these {self.count} are, over the same stars."

    def schedules(
        self, requirement: Requirement, content: ExposureContent, epochs: Sequence[float]
    ) -> list[Schedule]:
        """One schedule, of the same dithers."""
        information = self.gain * self.mode.distortion_information / self.count
        further = further_dithers(self.mode, self.run.config.sampler.seed)
        return [Schedule("dithered like these", information, together=further)]


SELFCAL = SelfcalKind()
