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
from bayesdist.assess.budget.budget import ErrorBudget, detector_budget
from bayesdist.assess.drawn import PositionErrors, position_errors
from bayesdist.assess.requirements.validity import Horizon
from bayesdist.assess.solution import Solution
from bayesdist.assess.terms.product_terms import ProductTerm
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
    what: dict[str, Any] = {"solution": solution}
    if solution is None:
        solution = session.systematics.solution
        what = {
            "solution": solution,
            "fields": session.field_terms,
            "aligned": session.systematics.aligned,
        }
    else:
        what["fields"] = config.linear_terms(solution)
    return what | {
        "terms": config.user_terms(),
        "local": session.local_terms,
        "grid": config.assess.grid,
        "epoch": session.epoch,
        "n_draws": n_draws or config.assess.draws,
        "rng": session.rng("assess"),
        "pixel_scale": pixel_scale_of(solution, scale_mas=config.detector.scale_mas),
    }


def budget_of(
    session: Session, solution: Solution | None = None, n_draws: int | None = None
) -> ErrorBudget:
    """The budget of the session's solution with all that is known of its errors.

    Another solution is assessed by itself.
    """
    products = products_of(session) if solution is None else ()
    return detector_budget(**_assessment(session, solution, n_draws), products=products)


def products_of(session: Session) -> tuple[ProductTerm, ...]:
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


def errors_of(session: Session) -> PositionErrors:
    """Draws of all errors of a position, as budget and margins have them."""
    what = _assessment(session, None, None)
    del what["epoch"]
    return position_errors(centroid=session.centroid, **what)


def assessed_horizons(session: Session, requirements: Sequence[Requirement]) -> tuple[Horizon, ...]:
    """Until when requirements are met, on fewer draws than their margins."""
    if session.posterior.model.time is None or not requirements:
        return ()
    what = _assessment(session, None, min(HORIZON_DRAWS, session.config.assess.draws))
    del what["epoch"]
    centroid = session.centroid if any(r.magnitude is not None for r in requirements) else None
    found = horizons_of(session, position_errors(centroid=centroid, **what), requirements)
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
    [margin] = check_requirements(requirements=[requirement], centroid=session.centroid, **what)
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
    margins = check_requirements(
        requirements=requirements,
        caveats=caveats,
        centroid=centroid,
        **_assessment(session, solution, n_draws),
    )
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
