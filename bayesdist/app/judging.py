"""What a session's solution is judged by: budget, margins, horizons."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from bayesdist.app.caveats import caveats_of, rests_on
from bayesdist.app.horizon import horizons_of
from bayesdist.app.product_terms import product_terms
from bayesdist.app.session import Session
from bayesdist.assess import Margin, Requirement, check_requirements, pixel_scale_of
from bayesdist.assess.budget.budget import ErrorBudget
from bayesdist.assess.budget.detector import detector_budget
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.error_model import error_model
from bayesdist.assess.requirements.validity import Horizon
from bayesdist.assess.solution import Solution
from bayesdist.assess.terms.forms import ErrorTerm, Known
from bayesdist.assess.terms.given import Centroids
from bayesdist.errors import BayesdistError, InputError

__all__ = [
    "assessed_horizons",
    "budget_of",
    "errors_of",
    "margins_of",
    "probability_met",
    "products_of",
]

log = logging.getLogger("bayesdist")

HORIZON_DRAWS = 1000  # for each of its epochs


def _assessment(session: Session, solution: Solution | None, n_draws: int | None) -> dict[str, Any]:
    """What a budget and margins have in common."""
    config = session.config
    if solution is None:
        solution, aligned = session.systematics.solution, session.systematics.aligned
        terms = session.error_terms
    else:
        terms, aligned = session.terms_beside(solution), False
    return {
        "solution": solution,
        "terms": terms,
        "aligned": aligned,
        "pixel_scale": pixel_scale_of(solution, scale_mas=config.detector.scale_mas),
        "grid": config.assess.grid,
        "epoch": session.epoch,
        "n_draws": n_draws or config.assess.draws,
        "rng": session.rng("assess"),
    }


def budget_of(
    session: Session, solution: Solution | None = None, n_draws: int | None = None
) -> ErrorBudget:
    """The budget of the session's solution with all that is known of its errors.

    Another solution is assessed by itself.
    """
    what = _assessment(session, solution, n_draws)
    if solution is None:
        what["terms"] += products_of(session)
    return detector_budget(**what)


def products_of(session: Session) -> tuple[Known, ...]:
    """What the files that are asked for differ by; none where they cannot be made."""
    solution, kept = session.solution, session.__dict__.get("_products")
    if kept is None or kept[0] is not solution:
        try:
            kept = solution, product_terms(session)
        except BayesdistError as error:  # the export says so, and stops
            log.warning("assess: WARNING: the files were not compared with the solution: %s", error)
            kept = solution, ()
        session.__dict__["_products"] = kept
    return kept[1]


def errors_of(session: Session) -> DrawnErrors:
    """Draws of all errors of a position, as budget and margins have them, and of files."""
    more = (Centroids(session.centroid), *products_of(session))
    return _drawn(_assessment(session, None, None), more)


def _drawn(what: dict[str, Any], more: Sequence[ErrorTerm]) -> DrawnErrors:
    model = error_model(
        what["solution"],
        (*what["terms"], *more),
        aligned=what["aligned"],
        pixel_scale=what["pixel_scale"],
    )
    return model.drawn(what["n_draws"], what["rng"])


def assessed_horizons(session: Session, requirements: Sequence[Requirement]) -> tuple[Horizon, ...]:
    """Until when requirements are met, on fewer draws than their margins."""
    if session.posterior.model.time is None or not requirements:
        return ()
    what = _assessment(session, None, min(HORIZON_DRAWS, session.config.assess.draws))
    centroid = session.centroid if any(r.magnitude is not None for r in requirements) else None
    found = horizons_of(session, _drawn(what, (Centroids(centroid),)), requirements)
    for one in found:
        log.info("assess: %s", one.sentence)
    return found


def probability_met(
    session: Session, requirement: Requirement, candidate: Solution, n_draws: int
) -> float:
    """With which a requirement would be met if the session had another solution.

    The same random numbers serve every candidate.
    """
    what = _assessment(session, None, n_draws) | {"solution": candidate}
    what["terms"] += (Centroids(session.centroid),)
    [margin] = check_requirements(requirements=[requirement], **what)
    return margin.probability_met


def margins_of(
    session: Session,
    requirements: tuple[Requirement, ...],
    solution: Solution | None = None,
    n_draws: int | None = None,
) -> tuple[Margin, ...]:
    """Margins of a solution, as in `budget_of`; as many draws as configured by default."""
    caveats = caveats_of(session) if n_draws is None else ()
    centroid = None
    if any(r.magnitude is not None for r in requirements):
        if n_draws is None:
            centroid = session.centroid
        else:  # without a posterior centroids have no errors yet
            requirements = tuple(_of_any_star(session, r) for r in requirements)
    what = _assessment(session, solution, n_draws)
    what["terms"] += (Centroids(centroid),)
    margins = check_requirements(requirements=requirements, caveats=caveats, **what)
    if n_draws is not None:
        return margins
    return tuple(
        replace(_where_stars_are(session, margin), rests_on=rests_on(session, margin.epoch))
        for margin in margins
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


def _where_stars_are(session: Session, margin: Margin) -> Margin:
    """A margin that is not met where it is judged on pixels that no stars cover."""
    for one in session.coverages:
        if margin.verdict == "met" and one.misses(margin.requirement, session.config.assess.grid):
            return replace(margin, verdict="undecided", reason=one.sentence)
    return margin
