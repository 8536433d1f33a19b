"""Stage 3: maps, coefficients, budget, margins."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.rundir import RunDirectory
from bayesdist.app.session import Session, write_table
from bayesdist.assess import (
    Margin,
    Misfit,
    Requirement,
    UncertaintyMap,
    area_map,
    check_requirements,
    pixel_scale_of,
    uncertainty_map,
)
from bayesdist.assess.coefficients import coefficient_table
from bayesdist.assess.detector_budget import DetectorBudget, detector_budget
from bayesdist.assess.solution import Solution
from bayesdist.products.maps_file import write_maps

__all__ = [
    "budget_of",
    "judged_requirements",
    "margin_rows",
    "margins_of",
    "run_assess",
    "write_margins",
]

log = logging.getLogger("bayesdist")

LEAST_CHI2, MOST_CHI2 = 0.67, 1.5


def run_assess(session: Session) -> None:
    config, run = session.config, session.run
    solution, grid, epoch = session.solution, config.assess.grid, session.epoch
    places = [{"grid": grid, "epoch": epoch, "chip": c.number} for c in solution.model.chips]
    formal = [uncertainty_map(session.fit, **place) for place in places]
    maps = [uncertainty_map(solution, **place) for place in places]
    areas = [area_map(solution, **place) for place in places]
    state = trust(session)
    write_maps(run / "maps.fits", [*formal, *maps], areas, note=solution.approximation, **state)
    coefficients = coefficient_table(session.fit, solution)
    coefficients.meta |= state | labelled(session)
    write_table(coefficients, run / "coefficients.ecsv")
    warnings = posterior_warnings(session)
    for text in warnings:
        log.warning("assess: WARNING: %s", text)
    budget = budget_of(session)
    several = len(budget.chips) > 1
    table = Table(rows=budget.rows_by_chip() if several else budget.rows())
    for name in ("u", "v", "radial"):
        table[name].unit = solution.unit
    table.meta = {"epoch": epoch, "grid": list(grid), "statistic": "rms over the grid"}
    table.meta |= state | labelled(session)
    write_table(table, run / "budget.ecsv")
    margins = margins_of(session, config.requirements())
    write_margins(session, margins)
    run.summarise(
        map=_map_summary(maps, formal),
        budget=budget.rows(),
        misfit=_misfit_summary(session),
        warnings=warnings,
    )
    worst = max(maps, key=lambda m: m.radius_max)
    log.info("assess: largest formal radius %.4g %s", worst.radius_max, worst.unit)


def _map_summary(
    maps: Sequence[UncertaintyMap], formal: Sequence[UncertaintyMap]
) -> dict[str, Any]:
    """The worst of all chips, and each chip."""
    chips = [
        {
            "chip": m.chip,
            "sigma_u_max": m.sigma_u_max,
            "sigma_v_max": m.sigma_v_max,
            "radius_max": m.radius_max,
            "position_of_max": list(m.position_of_max),
            "radius_max_least_squares": least_squares.radius_max,
        }
        for m, least_squares in zip(maps, formal, strict=True)
    ]
    worst = max(chips, key=lambda c: c["radius_max"])
    largest = ("sigma_u_max", "sigma_v_max", "radius_max_least_squares")
    return {
        "unit": maps[0].unit,
        "epoch": maps[0].epoch,
        **worst,
        **{key: max(c[key] for c in chips) for key in largest},
        "chips": chips,
    }


def _misfit_summary(session: Session) -> dict[str, Any]:
    worst = session.misfit
    out = _misfit_row(worst) | {"unit": worst.unit, "significant": worst.significant}
    if len(session.misfits) > 1:
        out["chips"] = [_misfit_row(m) for m in session.misfits]
    return out


def _misfit_row(m: Misfit) -> dict[str, Any]:
    row = {"p_value": m.p_value, "partition": m.partition, "structure": m.structure}
    return row if m.chip is None else row | {"chip": m.chip.number}


def _assessment(session: Session, solution: Solution | None, n_draws: int | None) -> dict[str, Any]:
    """What a budget and margins have in common."""
    config = session.config
    what: dict[str, Any] = {"solution": solution}
    if solution is None:
        known = session.systematics
        solution = known.solution
        what = {"solution": solution, "fields": known.fields, "aligned": known.aligned}
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
) -> DetectorBudget:
    """The budget of the session's solution with all that is known of its errors.

    Another solution is assessed by itself.
    """
    return detector_budget(**_assessment(session, solution, n_draws))


def margins_of(
    session: Session,
    requirements: tuple[Requirement, ...],
    solution: Solution | None = None,
    n_draws: int | None = None,
) -> tuple[Margin, ...]:
    """Margins of a solution, as in `budget_of`; as many draws as configured by default."""
    doubt = ""
    if n_draws is None and session.misfit.significant:
        doubt = session.misfit.sentence
    return check_requirements(
        requirements=requirements, doubt=doubt, **_assessment(session, solution, n_draws)
    )


def warnings_of(session: Session) -> list[str]:
    """What a reader of the numbers has to know, each as a sentence."""
    fit, out = session.fit, [*session.doubts]
    if session.misfit.significant:
        out.append(session.misfit.sentence)
    ratio = fit.chi2 / max(fit.dof, 1)
    if ratio < LEAST_CHI2:
        out.append(
            f"chi-square per degree of freedom is {ratio:.2g}: the quoted errors are too large, "
            "and with them all uncertainties"
        )
    if ratio > MOST_CHI2:
        out.append(
            f"chi-square per degree of freedom is {ratio:.3g} with the quoted errors: they are too "
            "small, which the jitter takes up, or the model does not fit"
        )
    return [text[0].upper() + text[1:] for text in out]


def trust(session: Session) -> dict[str, bool]:
    """Whether the posterior may be relied on, for the head of a file."""
    return {"converged": session.posterior.convergence.converged}


def labelled(session: Session) -> dict[str, str]:
    """What must be said of draws that are not exact, for the head of a file."""
    label = session.posterior.approximation
    return {"posterior": label} if label else {}


def posterior_warnings(session: Session) -> list[str]:
    """Those of the fit, and before them what must be said of the draws."""
    label = session.posterior.approximation
    return [label[0].upper() + label[1:], *warnings_of(session)] if label else warnings_of(session)


def margin_rows(margins: tuple[Margin, ...]) -> list[dict[str, Any]]:
    """Margins as plain rows, for files and for the screen."""
    return [
        {
            "name": m.requirement.name,
            "statistic": m.requirement.statistic,
            "limit": m.requirement.limit,
            "value": m.value,
            "interval": list(m.interval),
            "margin": m.margin,
            "unit": m.unit,
            "epoch": m.epoch,
            "chip": m.requirement.chip,
            "probability": m.requirement.probability,
            "probability_met": m.probability_met,
            "mc_error": m.mc_error,
            "verdict": m.verdict,
            "reason": m.reason,
        }
        for m in margins
    ]


def write_margins(session: Session, margins: tuple[Margin, ...]) -> None:
    """Replace the margins of a run: margins.ecsv and summary.json."""
    rows = margin_rows(margins)
    several = len(session.posterior.model.chips) > 1
    columns: dict[str, list[Any]] = {}
    for row in rows:
        low, high = row["interval"]
        flat = {**row, "lo95": low, "hi95": high}
        del flat["interval"]
        flat["epoch"] = np.nan if flat["epoch"] is None else flat["epoch"]
        flat["chip"] = "all" if flat["chip"] is None else str(flat["chip"])
        if not several:
            del flat["chip"]
        for name, value in flat.items():
            columns.setdefault(name, []).append(value)
    table = Table(columns)
    table.meta = trust(session) | labelled(session)
    write_table(table, session.run / "margins.ecsv")
    session.run.summarise(margins=rows)


def judged_requirements(run: RunDirectory) -> tuple[Requirement, ...]:
    """The requirements behind the margins in summary.json."""
    keys = ("name", "statistic", "limit", "unit", "probability", "epoch", "chip")
    # runs of earlier versions had one chip and named none
    return tuple(
        Requirement(**{k: row.get(k) for k in keys}) for row in run.summary.get("margins", [])
    )
