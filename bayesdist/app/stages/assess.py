"""Stage 3: maps, coefficients, budget, margins."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.holdout import held_out_of, holdout_summary, holdout_table
from bayesdist.app.horizon import horizons_of, write_horizons
from bayesdist.app.periods import periods_of, periods_summary, periods_table
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
from bayesdist.assess.horizon import Horizon
from bayesdist.assess.position_errors import PositionErrors, position_errors
from bayesdist.assess.solution import Solution
from bayesdist.errors import InputError
from bayesdist.products.maps_file import write_maps

__all__ = [
    "assessed_horizons",
    "budget_of",
    "errors_of",
    "judged_requirements",
    "margin_rows",
    "margins_of",
    "probability_met",
    "run_assess",
    "write_margins",
]

log = logging.getLogger("bayesdist")

LEAST_CHI2, MOST_CHI2 = 0.67, 1.5

HORIZON_DRAWS = 1000  # for each of its epochs

# of what a requirement is, beside chip and epoch
SCOPE = ("region", "epochs", "relative", "separation", "magnitude")


def run_assess(session: Session) -> None:
    config, run = session.config, session.run
    session.measure()
    periods_of(session, anew=True)  # the fit may be another one since
    _assess_holdout(session)
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
    rows = budget.rows_by_chip() if several else budget.rows()
    table = Table([{k: np.nan if v is None else v for k, v in row.items()} for row in rows])
    for name in ("u", "v", "radial", "radial_error"):
        table[name].unit = solution.unit
    table.meta = {"epoch": epoch, "grid": list(grid), "statistic": "rms over the grid"}
    table.meta |= state | labelled(session)
    write_table(table, run / "budget.ecsv")
    margins = margins_of(session, config.requirements())
    write_margins(session, margins)
    write_horizons(session, assessed_horizons(session, config.requirements()))
    _assess_periods(session)
    run.summarise(
        map=_map_summary(maps, formal),
        budget=budget.rows(),
        misfit=_misfit_summary(session),
        warnings=warnings,
    )
    worst = max(maps, key=lambda m: m.radius_max)
    log.info("assess: largest formal radius %.4g %s", worst.radius_max, worst.unit)


def _assess_holdout(session: Session) -> None:
    found = held_out_of(session, anew=True)
    if found is None:
        return
    write_table(holdout_table(found), session.run / "holdout.ecsv")
    session.run.summarise(holdout=holdout_summary(found))
    log.info("assess: %s", found.verdict)


def _assess_periods(session: Session) -> None:
    found = periods_of(session)
    if found is None:
        return
    write_table(periods_table(found), session.run / "periods.ecsv")
    session.run.summarise(periods=periods_summary(found))
    for text in (found.verdict, found.pattern_sentence, *found.cautions):
        log.info("assess: %s", text)


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
        solution = session.solution
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
) -> DetectorBudget:
    """The budget of the session's solution with all that is known of its errors.

    Another solution is assessed by itself.
    """
    return detector_budget(**_assessment(session, solution, n_draws))


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
    doubt = ""
    if n_draws is None:
        doubt = session.majority or _unaccounted(session)
        held = held_out_of(session)
        if not doubt and held is not None and held.doubtful:
            doubt = held.verdict
    centroid = None
    if any(r.magnitude is not None for r in requirements):
        if n_draws is None:
            centroid = session.centroid
        else:  # without a posterior centroids have no errors yet
            requirements = tuple(_of_any_star(session, r) for r in requirements)
    margins = check_requirements(
        requirements=requirements,
        doubt=doubt,
        centroid=centroid,
        **_assessment(session, solution, n_draws),
    )
    if doubt or n_draws is not None:
        return margins
    return tuple(_where_stars_are(session, margin) for margin in margins)


def _unaccounted(session: Session) -> str:
    """Structure in the residuals that no error stands for; empty where there is none."""
    shared = session.shared_errors
    if not session.misfit.significant or (shared is not None and shared.trusted):
        return ""
    return session.misfit.sentence


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
    """A margin without verdict where it is judged on pixels that no stars cover."""
    for one in session.coverages:
        if margin.verdict != "undecided" and one.misses(
            margin.requirement, session.config.assess.grid
        ):
            return replace(margin, verdict="undecided", reason=one.sentence)
    return margin


def warnings_of(session: Session) -> list[str]:
    """What a reader of the numbers has to know, each as a sentence."""
    fit, out = session.fit, [*session.doubts]
    out += [one.sentence for one in session.coverages if one.significant]
    if session.majority:
        out.append(session.majority)
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
    label, periods, held = (
        session.posterior.approximation,
        periods_of(session),
        held_out_of(session),
    )
    out = [label[0].upper() + label[1:]] if label else []
    if held is not None and held.level != "pass":
        out.append(held.verdict[0].upper() + held.verdict[1:])
    out += warnings_of(session)
    return [*out, periods.verdict.rstrip(".")] if periods and periods.matters else out


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
            "margin_percent": m.percent,
            "unit": m.unit,
            "epoch": m.epoch,
            "chip": m.requirement.chip,
            **{key: getattr(m.requirement, key) for key in SCOPE},
            "probability": m.requirement.probability,
            "probability_met": m.probability_met,
            "mc_error": m.mc_error,
            "verdict": m.verdict,
            "reason": m.reason,
            "worst": {"chip": m.worst.chip, "x": m.worst.x, "y": m.worst.y, "rms": m.worst.rms},
            "remedy": None if m.remedy is None else m.remedy.sentence,
        }
        for m in margins
    ]


def write_margins(session: Session, margins: tuple[Margin, ...]) -> None:
    """Replace the margins of a run: margins.ecsv and summary.json."""
    rows = margin_rows(margins)
    several = len(session.posterior.model.chips) > 1
    columns: dict[str, list[Any]] = {}
    for m, row in zip(margins, rows, strict=True):
        flat = {k: v for k, v in row.items() if k not in ("interval", "worst", *SCOPE)}
        flat["epoch"] = np.nan if flat["epoch"] is None else flat["epoch"]
        flat["chip"] = "all" if flat["chip"] is None else str(flat["chip"])
        flat["remedy"] = flat["remedy"] or ""
        flat |= {"scope": m.requirement.scope, "lo95": m.interval[0], "hi95": m.interval[1]}
        flat |= {f"worst_{key}": value for key, value in row["worst"].items()}
        if not several:
            del flat["chip"], flat["worst_chip"]
        for name, value in flat.items():
            columns.setdefault(name, []).append(value)
    table = Table(columns)
    table.meta = trust(session) | labelled(session)
    write_table(table, session.run / "margins.ecsv")
    session.run.summarise(margins=rows)


def judged_requirements(run: RunDirectory) -> tuple[Requirement, ...]:
    """The requirements behind the margins in summary.json."""
    keys = ("name", "statistic", "limit", "unit", "probability", "epoch", "chip", *SCOPE)
    out = []
    for row in run.summary.get("margins", []):
        # runs of earlier versions had one chip and named none, and no part of it
        known = {k: row[k] for k in keys if row.get(k) is not None}
        if "epochs" in known:
            del known["epoch"]  # the worst one of them
        out.append(Requirement(**known))
    return tuple(out)
