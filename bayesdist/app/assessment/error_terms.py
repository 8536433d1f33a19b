"""Error model of a run, and the positions, date and random numbers of its assessment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bayesdist.app.config import Config
from bayesdist.app.run import Run
from bayesdist.assess import Requirement, pixel_scale_of
from bayesdist.assess.evaluation import EvaluationSettings
from bayesdist.assess.model import ErrorModel, diagnosed_error_model, error_model
from bayesdist.utils import streams


def assessment_rng(config: Config) -> np.random.Generator:
    """Random number generator of the assessment, in its initial state."""
    return streams.assessment_rng(config.sampler.seed)


def evaluation_settings(run: Run) -> EvaluationSettings:
    """Settings of the evaluation of errors, including the dates of the stars."""
    return replace(rehearsal_settings(run), dates=run.dates)


def rehearsal_settings(run: Run) -> EvaluationSettings:
    """Settings of an evaluation without the dates of the stars, which only verdicts mention."""
    config, measured = run.config, run.kind.measures_centroids
    return EvaluationSettings(
        grid=config.assess.grid,
        epoch=run.epoch,
        draws=config.assess.draws,
        years_ahead=config.assess.years_ahead,
        scale_mas=config.detector.scale_mas,
        single=config.assess.exposure == "single",
        # centroid errors estimated by the fit include no other errors
        contained=() if measured else config.held_in_residuals(run.model.unit),
        given=config.stated_errors,
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


def error_model_of_fit(run: Run) -> ErrorModel:
    """Error model of the fit alone, without terms derived from residuals."""
    fit = run.fit
    terms = run.kind.error_terms(run, fit)
    scale = pixel_scale_of(fit, scale_mas=run.config.detector.scale_mas)
    return error_model(fit, terms, pixel_scale=scale)


def error_model_of_run(run: Run) -> ErrorModel:
    """Error model of a posterior, including terms derived from residuals."""
    posterior, domain = run.posterior, run.kind.domain(run)
    return diagnosed_error_model(
        posterior,
        run.diagnostics,
        run.kind.error_terms(run, posterior),
        hierarchy=run.hierarchy,
        catalogue=run.catalogue_name,
        aligned=domain.aligned,
        single=domain.single,
        frames=domain.frames,
        structure_left=domain.structure_left,
        pixel_scale=pixel_scale_of(posterior, scale_mas=run.config.detector.scale_mas),
    )
