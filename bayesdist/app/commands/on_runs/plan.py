"""`bayesdist plan`: number and dates of further exposures that requirements need."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bayesdist.app.assessment.error_terms import assessment_rng
from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.tables.margins import judged_requirements
from bayesdist.assess.evaluation import with_measured_centroids
from bayesdist.assess.model import with_diagnosed_errors, with_shared_stars
from bayesdist.assess.planning import (
    ExistingData,
    Futures,
    Need,
    Schedule,
    exposures_needed,
)
from bayesdist.assess.requirements.requirement import Requirement
from bayesdist.errors import InputError
from bayesdist.infer.compare.planning import (
    ExposureContent,
    exposure_content,
    with_information,
)
from bayesdist.infer.solution.solution import Solution
from bayesdist.utils.arrays import Float


def plan(run: str | Path, *, name: str | None = None, epochs: Sequence[float] = ()) -> str:
    """Number of exposures like the existing ones that the requirements of a run need, as text.

    Parameters
    ----------
    run : path
    name : str, optional
        Name of one requirement; all by default.
    epochs : sequence of float
        Possible dates of further exposures, in decimal years.
    """
    if str(run).endswith(".toml"):
        raise InputError(
            "is a file, not a run",
            where=str(run),
            do=f"compare dither patterns by 'bayesdist plan-dither {run}'",
        )
    with Run.of(RunDirectory.open(run)) as opened:
        opened.directory.require("plan", ("fit", "sample", "diagnose", "evaluate"))
        exposures = opened.kind.further_exposures(opened)
        if epochs and exposures.dateless:
            raise InputError(exposures.dateless, where=str(run), do="leave out --epochs")
        content = content_of(opened)
        needs = needs_of(opened, content, name=name, epochs=epochs)
        lines = [exposures.sentence(content)]
    for requirement, several in needs:
        lines.append("")
        lines.append(f"{requirement.name} (probability {requirement.probability:g} asked for)")
        for need in several:
            lines.append(f"  {need.sentence}")
            if need.by_number:
                lines.append(f"    probability by number of exposures: {need.table}")
    return "\n".join(lines)


def needs_of(
    run: Run,
    content: ExposureContent,
    *,
    name: str | None = None,
    epochs: Sequence[float] = (),
) -> list[tuple[Requirement, tuple[Need, ...]]]:
    """Number of exposures that each requirement of a run needs, for each schedule.

    Parameters
    ----------
    run : Run
        Run that was evaluated.
    content : ExposureContent
        Average exposure of the run, from `content_of`.
    name : str, optional
        Name of one requirement; all by default.
    epochs : sequence of float
        Dates of further exposures in decimal years.

    Returns
    -------
    list of tuple of Requirement and tuple of Need

    Raises
    ------
    InputError
        If there is no such requirement.
    """
    requirements = judged_requirements(run.directory)
    chosen = [r for r in requirements if name is None or r.name == name]
    if not chosen:
        names = ", ".join(repr(r.name) for r in requirements)
        raise InputError(
            f"has no requirement {name!r}" if names else "has no requirements",
            where=str(run.directory.path),
            do=f"name one of {names}" if names else "judge some with 'bayesdist requirements'",
        )
    now = {row["name"]: row["probability_met"] for row in run.directory.summary["margins"]}
    future, out = futures_of(run, content), []
    for requirement in chosen:
        needs = exposures_needed(
            schedules_of(run, requirement, content, epochs),
            future(requirement).probability,
            requirement.probability,
            now=now[requirement.name],
        )
        out.append((requirement, needs))
    return out


def content_of(run: Run) -> ExposureContent:
    """Average exposure of the run."""
    stars = run.diagnostics.sample
    jitter = float(np.mean(run.posterior.hyper.get("j", [0.0])))
    sigma = np.stack([np.asarray(stars.table.sigma_u), np.asarray(stars.table.sigma_v)], axis=1)
    true = np.ones(len(stars))
    if stars.outlier_probability is not None:
        true = 1.0 - stars.outlier_probability
    return exposure_content(
        run.posterior.model,
        stars.table,
        true[:, None] / (sigma**2 + jitter**2),
        n_total=stars.n_total,
        n_exposures=run.kind.further_exposures(run).count,
    )


def schedules_of(
    run: Run,
    requirement: Requirement,
    content: ExposureContent,
    epochs: Sequence[float] = (),
) -> list[Schedule]:
    """Schedules of exposures: at relevant dates, or one schedule if dates do not matter."""
    return run.kind.further_exposures(run).schedules(requirement, content, epochs)


def futures_of(run: Run, content: ExposureContent) -> Callable[[Requirement], Futures]:
    """Function that predicts the run with more exposures, for any requirement."""
    settings, errors = run.evaluation_settings, run.error_model
    errors = with_measured_centroids(errors, run.diagnostics, settings)
    diagnostics = run.diagnostics
    hierarchy = run.hierarchy
    # further exposures of the same stars do not reduce the effect of catalogue errors
    independent = with_diagnosed_errors(
        run.posterior, replace(diagnostics, catalogue=None), hierarchy, noise_alone=True
    )

    def solution(information: Float) -> Solution:
        extended = with_information(independent, information)
        if diagnostics.catalogue is None or hierarchy is None:
            return extended
        return with_shared_stars(extended, hierarchy, diagnostics.catalogue)

    exposures = run.kind.further_exposures(run)
    weight = np.mean([np.sum([m[axis, 0, 0] for m in content.moments.values()]) for axis in (0, 1)])
    seed = int(assessment_rng(run.config).integers(2**63))

    def of(requirement: Requirement) -> Futures:
        return Futures(
            errors,
            requirement,
            ExistingData(exposures.count, float(weight), content.n_stars, exposures.gain),
            solution,
            settings.grid,
            settings.epoch,
            settings.pixel_scale(errors),
            seed,
            run.config.discrepancy.priors(),
        )

    return of
