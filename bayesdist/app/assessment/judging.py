"""A run judged: its errors drawn, its margins, and what its files differ by."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from bayesdist.app.assessment.checks import run_checks
from bayesdist.app.assessment.error_terms import errors_of_run
from bayesdist.app.assessment.settings import (
    assessment_rng,
    evaluation_settings,
    rehearsal_settings,
)
from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.products.made_files import ProductInput
from bayesdist.app.products.product_terms import product_terms
from bayesdist.app.results import Results
from bayesdist.assess import Margin, Requirement
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.error_model import ErrorModel
from bayesdist.assess.evaluation import (
    Evaluation,
    budget_over,
    drawn_errors,
    evaluate,
    judged,
    validity_of,
)
from bayesdist.assess.requirements.margins import judge
from bayesdist.assess.requirements.validity import Horizon
from bayesdist.assess.terms.forms import Known
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.errors import BayesdistError, InputError
from bayesdist.infer import Posterior
from bayesdist.infer.solution import Solution

__all__ = [
    "errors_of",
    "evaluate_run",
    "margins_of",
    "probability_met",
    "rehearse_evaluation",
    "validity_periods_of",
]

log = logging.getLogger("bayesdist")


def evaluate_run(
    errors: ErrorModel,
    posterior: Posterior,
    found: Diagnostics,
    data: FitData,
    product: ProductInput,
    config: Config,
    base: Path,
    *,
    series: Mapping[str, Any] | None = None,
) -> Evaluation:
    """Maps, budget, margins and validity periods of a run.

    Parameters
    ----------
    errors : ErrorModel
    posterior : Posterior
    found : Diagnostics
    data : FitData
    product : ProductInput
        What files are made from: the solution with all errors of the parameters.
    config : Config
    base : Path
        Folder that its files are relative to.
    series : mapping, optional
        As of `run_checks`.
    """
    null = None if data.fitted.solved is None else data.fitted.solved.gauge.null
    assert isinstance(product.solution, Posterior)
    return evaluate(
        errors,
        found,
        config.requirements(),
        evaluation_settings(data, config),
        assessment_rng(config),
        fit=data.fit,
        solution=product.solution,
        checks=run_checks(data, posterior, found, config, series),
        files=_files(product, config, base),
        null=null,
    )


def errors_of(results: Results) -> DrawnErrors:
    """Draws of all errors of a position, as budget and margins have them, and of files."""
    return drawn_errors(
        results.errors,
        results.diagnostics,
        results.settings,
        assessment_rng(results.config),
        files=_files(results.product, results.config, results.base),
    )


def margins_of(results: Results, requirements: Sequence[Requirement]) -> tuple[Margin, ...]:
    """Margins of a run against requirements."""
    return judged(
        results.errors,
        results.diagnostics,
        requirements,
        results.settings,
        assessment_rng(results.config),
        checks=results.checks,
    )


def validity_periods_of(
    results: Results, requirements: Sequence[Requirement]
) -> tuple[Horizon, ...]:
    """Until when requirements are met by a run, where something depends on time."""
    return validity_of(
        results.errors,
        results.diagnostics,
        requirements,
        results.settings,
        assessment_rng(results.config),
    )


def _files(product: ProductInput, config: Config, base: Path) -> tuple[Known, ...]:
    """What the files that are asked for differ by; none where they cannot be made."""
    try:
        return product_terms(product, config, base)
    except BayesdistError as error:  # the export says so, and stops
        log.warning("assess: WARNING: the files were not compared with the solution: %s", error)
        return ()


def probability_met(
    results: Results, requirement: Requirement, candidate: Solution, n_draws: int
) -> float:
    """Probability that a requirement would be met by another solution in place of the run's.

    The same random numbers serve every candidate.
    """
    errors, settings = results.errors, results.settings
    errors = replace(errors, solution=replace(errors.solution, solution=candidate))
    rng = assessment_rng(results.config)
    [margin] = judge(
        drawn_errors(errors, results.diagnostics, settings, rng, n=n_draws),
        [requirement],
        grid=settings.grid,
        epoch=settings.epoch,
        pixel_scale=settings.pixel_scale(errors),
    )
    return margin.probability_met


def rehearse_evaluation(data: FitData, config: Config, n_draws: int) -> None:
    """Budget and margins of a fit, with few draws; nothing is kept.

    Raises
    ------
    InputError
        For terms and requirements that the run could not be judged by.
    """
    settings = replace(rehearsal_settings(data, config), draws=n_draws)
    errors = errors_of_run(data.fit, None, data, config)
    budget_over(errors, settings, assessment_rng(config))
    # without a posterior centroids have no errors yet
    has_mag = data.placed.has_mag
    requirements = [_of_any_star(r, has_mag=has_mag) for r in config.requirements()]
    judge(
        errors.drawn(n_draws, assessment_rng(config)),
        requirements,
        grid=settings.grid,
        epoch=settings.epoch,
        pixel_scale=settings.pixel_scale(errors),
    )


def _of_any_star(requirement: Requirement, *, has_mag: bool) -> Requirement:
    """A requirement without its magnitude, if the matches have such."""
    if requirement.magnitude is not None and not has_mag:
        raise InputError(
            f"names magnitude {requirement.magnitude:g}, and the matches have no magnitudes",
            where=requirement.where,
            do="name their column in [data.columns], or leave magnitude out",
        )
    return replace(requirement, magnitude=None)
