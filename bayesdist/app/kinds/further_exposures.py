"""Further exposures of a run, which `bayesdist plan` counts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesdist.app.run import Run
from bayesdist.assess.planning import Schedule
from bayesdist.assess.requirements.requirement import Requirement
from bayesdist.infer.compare.planning import ExposureContent, exposure_information
from bayesdist.utils.arrays import Float

LATER = 4  # number of dates that represent evenly spread exposures


class FurtherExposures:
    """Further exposures of a run with a catalogue: each has stars like those of the existing ones.

    `gain` is the information of a further exposure relative to the mean of the existing ones.
    """

    gain = 1.0

    def __init__(self, run: Run) -> None:
        self.run = run

    @property
    def count(self) -> int:
        """Number of exposures of the run."""
        return max(len(self.run.placed.exposure_names), 1)

    @property
    def dateless(self) -> str:
        """Clause on why dates of further exposures do not matter; empty if they do."""
        if self.run.solution.model.time is not None:
            return ""
        return "does not depend on time, so that the dates of further exposures do not matter"

    def sentence(self, content: ExposureContent) -> str:
        """Sentence that states which exposures are assumed."""
        return f"An exposure is taken to hold {content.n_stars:.0f} matched stars as these do."

    def schedules(
        self, requirement: Requirement, content: ExposureContent, epochs: Sequence[float]
    ) -> list[Schedule]:
        """Schedules at relevant dates, or one schedule if dates do not matter."""
        solution, epoch = self.run.solution, self.run.epoch

        def worth(date: float | None) -> Float:
            return exposure_information(solution, content, date)

        if solution.model.time is None or epoch is None:
            return [Schedule("at any date", worth(None))]
        wanted = requirement.epoch or (requirement.epochs or [epoch])[-1]
        last = float(np.max(self.run.diagnostics.sample.table.column("epoch")))
        schedules = [
            Schedule(f"at {date:.2f}", worth(date), single_date=True)
            for date in dict.fromkeys([*epochs, wanted])
        ]
        if wanted > last:
            spread = [worth(float(date)) for date in np.linspace(last, wanted, LATER + 1)[1:]]
            name = f"evenly from {last:.2f} to {wanted:.2f}"
            schedules.append(Schedule(name, np.sum(spread, axis=0) / len(spread)))
        return schedules
