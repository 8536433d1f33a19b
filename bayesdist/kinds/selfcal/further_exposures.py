"""Further exposures of a self-calibration, which `bayesdist plan` counts."""

from __future__ import annotations

from collections.abc import Sequence

from bayesdist.app.kinds.further_exposures import FurtherExposures
from bayesdist.app.run import Run
from bayesdist.assess.planning.futures import Schedule
from bayesdist.assess.requirements.requirement import Requirement
from bayesdist.infer.compare.planning import ExposureContent
from bayesdist.kinds.selfcal.infer import SelfCalibrationMode
from bayesdist.kinds.selfcal.patterns.dithers import further_dithers


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
