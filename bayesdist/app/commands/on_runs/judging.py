"""A run judged: its errors drawn, its margins, and what its files differ by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from bayesdist.app.assessment.error_terms import assessment_rng
from bayesdist.app.products.product_terms import file_errors
from bayesdist.app.results import Results
from bayesdist.assess import Margin, Requirement
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.evaluation import drawn_errors, judged, validity_of
from bayesdist.assess.requirements.margins import judge
from bayesdist.assess.requirements.validity import ValidityPeriod
from bayesdist.infer.solution.solution import Solution


def errors_of(results: Results) -> DrawnErrors:
    """Draws of all errors of a position, as budget and margins have them, and of files."""
    files = file_errors(results.product, results.config, results.base)
    given = results.errors, results.diagnostics, results.settings
    return drawn_errors(*given, assessment_rng(results.config), files=files)


def margins_of(results: Results, requirements: Sequence[Requirement]) -> tuple[Margin, ...]:
    """Margins of a run against requirements."""
    given = results.errors, results.diagnostics, requirements, results.settings
    return judged(*given, assessment_rng(results.config), checks=results.checks)


def validity_periods_of(
    results: Results, requirements: Sequence[Requirement]
) -> tuple[ValidityPeriod, ...]:
    """Until when requirements are met by a run, where something depends on time."""
    given = results.errors, results.diagnostics, requirements, results.settings
    return validity_of(*given, assessment_rng(results.config))


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
