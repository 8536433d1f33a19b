"""A session's solution evaluated: its errors, its checks, what its files differ by."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

from bayesdist.app.checks import run_checks
from bayesdist.app.product_terms import product_terms
from bayesdist.app.session import Session
from bayesdist.assess import Margin, Requirement
from bayesdist.assess.drawn import DrawnErrors
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
from bayesdist.assess.solution import Solution
from bayesdist.assess.terms.forms import Known
from bayesdist.checks import Check, in_order
from bayesdist.errors import BayesdistError, InputError

__all__ = [
    "all_checks",
    "errors_of",
    "evaluated",
    "margins_of",
    "probability_met",
    "rehearse_evaluation",
    "validity_periods_of",
]

log = logging.getLogger("bayesdist")


def evaluated(session: Session, requirements: Sequence[Requirement]) -> Evaluation:
    """Maps, budget, margins and validity periods of a run."""
    return evaluate(
        session.errors,
        session.diagnostics,
        requirements,
        session.evaluation_settings,
        session.rng("assess"),
        fit=session.fit,
        solution=session.solution,
        checks=run_checks(session),
        files=_files(session),
        null=session.free_directions,
    )


def all_checks(session: Session) -> tuple[Check, ...]:
    """All checks of a run that is not evaluated."""
    return in_order((*run_checks(session), *session.diagnostics.checks))


def errors_of(session: Session) -> DrawnErrors:
    """Draws of all errors of a position, as budget and margins have them, and of files."""
    return drawn_errors(
        session.errors,
        session.diagnostics,
        session.evaluation_settings,
        session.rng("assess"),
        files=_files(session),
    )


def margins_of(session: Session, requirements: Sequence[Requirement]) -> tuple[Margin, ...]:
    """Margins of a run against requirements."""
    return judged(
        session.errors,
        session.diagnostics,
        requirements,
        session.evaluation_settings,
        session.rng("assess"),
        checks=all_checks(session),
    )


def validity_periods_of(
    session: Session, requirements: Sequence[Requirement]
) -> tuple[Horizon, ...]:
    """Until when requirements are met by a run, where something depends on time."""
    return validity_of(
        session.errors,
        session.diagnostics,
        requirements,
        session.evaluation_settings,
        session.rng("assess"),
    )


def _files(session: Session) -> tuple[Known, ...]:
    """What the files that are asked for differ by; none where they cannot be made."""
    try:
        return product_terms(session)
    except BayesdistError as error:  # the export says so, and stops
        log.warning("assess: WARNING: the files were not compared with the solution: %s", error)
        return ()


def probability_met(
    session: Session, requirement: Requirement, candidate: Solution, n_draws: int
) -> float:
    """With which a requirement would be met if the session had another solution.

    The same random numbers serve every candidate.
    """
    errors, settings = session.errors, session.evaluation_settings
    errors = replace(errors, solution=replace(errors.solution, solution=candidate))
    rng = session.rng("assess")
    [margin] = judge(
        drawn_errors(errors, session.diagnostics, settings, rng, n=n_draws),
        [requirement],
        grid=settings.grid,
        epoch=settings.epoch,
        pixel_scale=settings.pixel_scale(errors),
    )
    return margin.probability_met


def rehearse_evaluation(session: Session, solution: Solution, n_draws: int) -> None:
    """Budget and margins of a fit, with few draws; nothing is kept.

    Raises
    ------
    InputError
        For terms and requirements that the run could not be judged by.
    """
    settings = replace(session.rehearsal_settings, draws=n_draws)
    errors, rng = session.errors_from(None, solution), session.rng("assess")
    budget_over(errors, settings, rng)
    # without a posterior centroids have no errors yet
    requirements = [_of_any_star(session, r) for r in session.config.requirements()]
    judge(
        errors.drawn(n_draws, session.rng("assess")),
        requirements,
        grid=settings.grid,
        epoch=settings.epoch,
        pixel_scale=settings.pixel_scale(errors),
    )


def _of_any_star(session: Session, requirement: Requirement) -> Requirement:
    """A requirement without its magnitude, if the matches have such."""
    if requirement.magnitude is not None and not session.raw_matches.has_mag:
        raise InputError(
            f"names magnitude {requirement.magnitude:g}, and the matches have no magnitudes",
            where=requirement.where,
            do="name their column in [data.columns], or leave magnitude out",
        )
    return replace(requirement, magnitude=None)
