"""Checks of a run other than those of an evaluation: kind of run, sampling, fit, residuals."""

from __future__ import annotations

from bayesdist.app.run import Run
from bayesdist.assess.requirements.verdict import assumption_checks
from bayesdist.utils.checks import Check, in_order


def checks_of_run(run: Run) -> tuple[Check, ...]:
    """Checks of a run that has been sampled, or of a fit alone, including its diagnostics."""
    return in_order((*checks_besides_diagnostics(run), *run.diagnostics.checks))


def checks_besides_diagnostics(run: Run) -> tuple[Check, ...]:
    """Checks of a run that has been sampled, or of a fit alone, in addition to its diagnostics."""
    catalogue = motions = None
    if run.kind.has_catalogue:
        stars = run.catalogue
        states_errors = stars is not None and stars.sigma_u is not None
        states_motion_errors = stars is not None and stars.sigma_pm_u is not None
        catalogue = states_errors or run.config.states_catalogue
        motions = states_motion_errors or run.config.states_motions
    return (
        *run.kind.checks(run),
        *assumption_checks(
            run.posterior if run.is_sampled else None,
            run.diagnostics,
            run.model.time,
            catalogue_stated=catalogue,
            motions_stated=motions,
        ),
    )
