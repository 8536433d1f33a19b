"""`bayesdist plan`: how many more exposures, and when, a requirement takes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bayesdist.app.results import Results, open_results, probability_met
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.tables.margins import judged_requirements
from bayesdist.assess.planning.exposures import Schedule, exposures_needed
from bayesdist.assess.requirements.requirement import Requirement
from bayesdist.errors import InputError
from bayesdist.infer.compare.planning import ExposureContent, exposure_content, exposure_information
from bayesdist.infer.solution.solution import Solution
from bayesdist.utils.arrays import Float

DRAWS = 1000
LATER = 4  # dates that stand for exposures spread evenly


def plan(run: str | Path, *, name: str | None = None, epochs: Sequence[float] = ()) -> str:
    """Exposures like those at hand that a run's requirements would take, as text.

    Of all requirements, or of one `name`; exposures could be taken at `epochs`, decimal years.
    """
    if str(run).endswith(".toml"):
        raise InputError(
            "is a file, not a run",
            where=str(run),
            do=f"compare dither patterns by 'bayesdist plan-dither {run}'",
        )
    with open_results(RunDirectory.open(run)) as results:
        results.run.require("plan", ("fit", "sample", "diagnose", "evaluate"))
        solved = results.fitted.solved
        if solved is not None and epochs:
            raise InputError(
                "is a run of a self-calibration, whose exposures count as those at hand with their "
                "dates",
                where=str(run),
                do="leave --epochs out",
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
        if solved is None:
            content = _content(results)
            lines = [
                f"An exposure is taken to hold {content.n_stars:.0f} matched stars as these do."
            ]
            schedules = [_schedules(results, one, content, epochs) for one in chosen]
        else:
            # an exposure by itself says nothing: as many as these, over other stars, say as much
            n = len(solved.mode.problem.model.exposures)
            lines = [
                f"Exposures are taken to be dithered as these {n} are, over as many other stars."
            ]
            information = solved.mode.distortion_information / n
            schedules = [[Schedule("dithered like these", information)]] * len(chosen)
        for requirement, several in zip(chosen, schedules, strict=True):
            lines += ["", *_lines(results, requirement, several)]
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


def _schedules(
    results: Results, requirement: Requirement, content: ExposureContent, epochs: Sequence[float]
) -> list[Schedule]:
    """Single exposures at dates that matter to a requirement, or at any."""
    solution, epoch = results.solution, results.epoch

    def worth(date: float | None) -> Float:
        return exposure_information(solution, content, date)

    if solution.model.time is None or epoch is None:
        return [Schedule("at any date", worth(None))]
    wanted = requirement.epoch or (requirement.epochs or [epoch])[-1]
    last = float(np.max(results.diagnostics.sample.table.column("epoch")))
    found = [Schedule(f"at {date:.2f}", worth(date)) for date in dict.fromkeys([*epochs, wanted])]
    if wanted > last:
        spread = [worth(float(date)) for date in np.linspace(last, wanted, LATER + 1)[1:]]
        name = f"evenly from {last:.2f} to {wanted:.2f}"
        found.append(Schedule(name, np.sum(spread, axis=0) / len(spread)))
    return found


def _lines(results: Results, requirement: Requirement, schedules: Sequence[Schedule]) -> list[str]:
    """How many exposures of each schedule a requirement takes."""

    def met(candidate: Solution) -> float:
        return probability_met(results, requirement, candidate, DRAWS)

    found = exposures_needed(results.solution, schedules, met, requirement.probability)
    return [f"{requirement.name} (probability {requirement.probability:g} asked for)"] + [
        f"  {need.sentence}" for need in found
    ]
