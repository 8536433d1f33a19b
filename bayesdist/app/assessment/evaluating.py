"""Evaluation of a run: maps, budget, margins and validity periods, for any requirements."""

from __future__ import annotations

from collections.abc import Sequence

from bayesdist.app.assessment.checks import checks_besides_diagnostics
from bayesdist.app.assessment.error_terms import assessment_rng
from bayesdist.app.products.made_files import product_of_run
from bayesdist.app.products.product_terms import file_errors
from bayesdist.app.run import Run
from bayesdist.assess import Margin, Requirement
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.evaluation import Evaluation, drawn_errors, evaluate, judged, validity_of
from bayesdist.assess.requirements.margins import ValidityPeriod


def evaluation_of_run(run: Run) -> Evaluation:
    """Maps, budget, margins and validity periods of a run that was sampled.

    Diagnostics that the run does not have yet are computed.
    """
    if run.stored_diagnostics is None:
        run = run.having(diagnostics=run.diagnostics)
    config = run.config
    return evaluate(
        run.error_model,
        run.diagnostics,
        config.requirements(),
        run.evaluation_settings,
        assessment_rng(config),
        fit=run.fit,
        solution=run.solution,
        checks=checks_besides_diagnostics(run),
        files=file_errors(product_of_run(run), config, run.base),
        null=run.kind.null_space(run),
    )


def drawn_errors_of_run(run: Run) -> DrawnErrors:
    """Draws of all position errors, as for budget and margins, including those of products."""
    files = file_errors(product_of_run(run), run.config, run.base)
    arguments = run.error_model, run.diagnostics, run.evaluation_settings
    return drawn_errors(*arguments, assessment_rng(run.config), files=files)


def margins_of_run(run: Run, requirements: Sequence[Requirement]) -> tuple[Margin, ...]:
    """Margins of a run for the given requirements."""
    requirements = run.config.within_field(requirements)
    arguments = run.error_model, run.diagnostics, requirements, run.evaluation_settings
    return judged(*arguments, assessment_rng(run.config), checks=run.checks)


def validity_periods_of_run(
    run: Run, requirements: Sequence[Requirement]
) -> tuple[ValidityPeriod, ...]:
    """Validity periods of requirements, if anything depends on time."""
    arguments = run.error_model, run.diagnostics, requirements, run.evaluation_settings
    return validity_of(*arguments, assessment_rng(run.config))
