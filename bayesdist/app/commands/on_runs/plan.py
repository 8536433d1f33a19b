"""`bayesdist plan`: how many more exposures, and when, a requirement takes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bayesdist.app.commands.on_runs.judging import probability_met
from bayesdist.app.results import Results, open_results
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.tables.margins import judged_requirements
from bayesdist.assess.planning.exposures import Schedule, exposures_needed
from bayesdist.assess.requirements.requirement import Requirement
from bayesdist.errors import InputError
from bayesdist.infer.compare.planning import ExposureContent, exposure_content, exposure_information
from bayesdist.infer.solution import Solution

__all__ = ["plan"]

DRAWS = 1000
LATER = 4  # dates that stand for exposures spread evenly


def plan(run: str | Path, *, name: str | None = None, epochs: Sequence[float] = ()) -> str:
    """Exposures like those at hand that a run's requirements would take, as text.

    Of all requirements, or of one `name`; exposures could be taken at `epochs`, decimal years.
    """
    with open_results(RunDirectory.open(run)) as results:
        results.run.require("plan", ("fit", "sample", "diagnose", "evaluate"))
        if results.config.selfcal is not None:
            raise InputError(
                "is a run of a self-calibration, where an exposure is worth what it overlaps",
                where=str(run),
                do="plan with matched stars",
            )
        requirements = judged_requirements(results.run)
        chosen = [r for r in requirements if name is None or r.name == name]
        if not chosen:
            known = ", ".join(repr(r.name) for r in requirements)
            raise InputError(
                f"has no requirement {name!r}" if known else "has no requirements",
                where=str(run),
                do=f"name one of {known}" if known else "judge some with 'bayesdist requirements'",
            )
        content = _content(results)
        lines = [f"An exposure is taken to hold {content.n_stars:.0f} matched stars as these do."]
        for requirement in chosen:
            lines += ["", *_lines(results, requirement, content, epochs)]
        return "\n".join(lines)


def _content(results: Results) -> ExposureContent:
    """The average exposure of the run."""
    stars = results.diagnostics.sample
    jitter = float(np.mean(results.posterior.hyper.get("j", [0.0])))
    sigma = np.stack([np.asarray(stars.table.sigma_u), np.asarray(stars.table.sigma_v)], axis=1)
    true = np.ones(len(stars))
    if stars.outlier_probability is not None:
        true = 1.0 - stars.outlier_probability
    return exposure_content(
        results.posterior.model,
        stars.table,
        true[:, None] / (sigma**2 + jitter**2),
        n_total=stars.n_total,
        n_exposures=max(len(results.data.placed.exposure_names), 1),
    )


def _lines(
    results: Results,
    requirement: Requirement,
    content: ExposureContent,
    epochs: Sequence[float],
) -> list[str]:
    solution, time = results.solution, results.posterior.model.time
    schedules = []
    if time is None:
        schedules.append(Schedule("at any date", exposure_information(solution, content, None)))
    else:
        epoch, seen = results.epoch, results.diagnostics.sample.table.epoch
        assert epoch is not None
        assert seen is not None
        wanted = requirement.epoch or (requirement.epochs or [epoch])[-1]
        last = float(np.max(seen))
        for date in dict.fromkeys([*epochs, wanted]):
            schedules.append(
                Schedule(f"at {date:.2f}", exposure_information(solution, content, date))
            )
        if wanted > last:
            dates = np.linspace(last, wanted, LATER + 1)[1:]
            spread = [exposure_information(solution, content, float(d)) for d in dates]
            schedules.append(
                Schedule(
                    f"evenly from {last:.2f} to {wanted:.2f}", np.sum(spread, axis=0) / len(spread)
                )
            )

    def met(candidate: Solution) -> float:
        return probability_met(results, requirement, candidate, DRAWS)

    found = exposures_needed(solution, schedules, met, requirement.probability)
    return [f"{requirement.name} (probability {requirement.probability:g} asked for)"] + [
        f"  {need.sentence}" for need in found
    ]
