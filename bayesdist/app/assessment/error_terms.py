"""Error model of a run, and the positions, date and random numbers of its assessment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData, assessment_epoch
from bayesdist.app.kinds.kind import kind_of
from bayesdist.app.kinds.parts import StoredLookupTables
from bayesdist.assess import Requirement, pixel_scale_of
from bayesdist.assess.evaluation import EvaluationSettings
from bayesdist.assess.model import ErrorModel, diagnosed_error_model, error_model
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.infer import Posterior
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import LookupTable
from bayesdist.utils import streams


def assessment_rng(config: Config) -> np.random.Generator:
    """Random number generator of the assessment, in its initial state."""
    return streams.assessment_rng(config.sampler.seed)


def evaluation_settings(data: FitData, config: Config) -> EvaluationSettings:
    """Settings of the evaluation of errors, including the dates of the stars."""
    return replace(rehearsal_settings(data, config), dates=data.dates)


def rehearsal_settings(data: FitData, config: Config) -> EvaluationSettings:
    """Settings of an evaluation without the dates of the stars, which only verdicts mention."""
    measured = kind_of(config).measures_centroids
    return EvaluationSettings(
        grid=config.assess.grid,
        epoch=assessment_epoch(data, config),
        draws=config.assess.draws,
        years_ahead=config.assess.years_ahead,
        scale_mas=config.detector.scale_mas,
        single=config.assess.exposure == "single",
        # centroid errors estimated by the fit include no other errors
        contained=() if measured else config.held_in_residuals(data.model.unit),
        given=tuple(block.name for block in config.budget if block.stated),
        field=config.field,
    )


def idle_dates(config: Config, requirements: Sequence[Requirement], where: str = "") -> str:
    """Sentence on dates without effect because the model does not depend on time; empty if none.

    Such dates may document when the data were taken and are therefore not refused. `where` is the
    file of the requirements if it is not the configuration.
    """
    if config.is_dated or config.time() is not None:
        return ""
    named = [f"of {r.where}" for r in requirements if r.epoch is not None]
    if config.assess.epoch is not None and not where:
        named.insert(0, "assess.epoch")
    if not named:
        return ""
    file = f"{where}: " if where else ""
    return (
        f"{file}nothing in the model depends on time, so that the dates given change nothing "
        f"({', '.join(named)})"
    )


def errors_of_fit(solution: Solution, data: FitData, config: Config) -> ErrorModel:
    """Error model of a solution alone, without terms derived from residuals."""
    terms = kind_of(config).error_terms(solution, data, config)
    scale = pixel_scale_of(solution, scale_mas=config.detector.scale_mas)
    return error_model(solution, terms, pixel_scale=scale)


def errors_of_run(
    posterior: Posterior, found: Diagnostics, data: FitData, config: Config
) -> ErrorModel:
    """Error model of a posterior, including terms derived from residuals."""
    kind = kind_of(config)
    domain = kind.domain(data, config)
    return diagnosed_error_model(
        posterior,
        found,
        kind.error_terms(posterior, data, config),
        hierarchy=data.fitted.hierarchy,
        catalogue=data.matched.catalogue_name,
        aligned=domain.aligned,
        single=domain.single,
        frames=domain.frames,
        structure_left=domain.structure_left,
        pixel_scale=pixel_scale_of(posterior, scale_mas=config.detector.scale_mas),
    )


def published_tables(stored: StoredLookupTables, *, held: bool) -> tuple[LookupTable, ...]:
    """Look-up tables with the errors that apply to their user.

    These are the errors at the nodes and the distortion between them, added in quadrature.  The
    same distortion affects the values at the nodes, which are averages over their surroundings.  It
    is added to the tables fitted in this run; `held` is True if the detector's tables are from
    another run.
    """
    out = []
    for table in stored.tables:
        between = stored.between.get(table.chip)
        if table.sigma is not None and between is not None and bool(table.filter) == held:
            total = np.sqrt(table.sigma**2 + between.left.mean[:, None, None])
            table = replace(table, sigma=total)
        out.append(table)
    return tuple(out)
