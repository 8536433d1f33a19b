"""Stage 3: maps, coefficients, budget, margins."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.dates import idle_dates
from bayesdist.app.holdout import held_out_of, holdout_summary, holdout_table
from bayesdist.app.horizon import write_horizons
from bayesdist.app.judging import assessed_horizons, budget_of, margins_of
from bayesdist.app.margins import write_margins
from bayesdist.app.periods import periods_of, periods_summary, periods_table
from bayesdist.app.session import Session, write_table
from bayesdist.app.trust import labelled, posterior_warnings, trust
from bayesdist.assess import (
    Misfit,
    UncertaintyMap,
    area_map,
    uncertainty_map,
)
from bayesdist.assess.coefficients import coefficient_table
from bayesdist.assess.maps import RELATIVE
from bayesdist.products.maps_file import write_maps

__all__ = ["relative_maps", "run_assess"]

log = logging.getLogger("bayesdist")


def run_assess(session: Session) -> None:
    config, run = session.config, session.run
    session.measure()
    periods_of(session, anew=True)  # the fit may be another one since
    _assess_holdout(session)
    solution, grid, epoch = session.solution, config.assess.grid, session.epoch
    places = [{"grid": grid, "epoch": epoch, "chip": c.number} for c in solution.model.chips]
    formal = [uncertainty_map(session.fit, **place) for place in places]
    maps = [session.position_map(**place) for place in places]
    areas = [area_map(solution, **place) for place in places]
    relative = relative_maps(session, places)
    state = trust(session)
    notes = (solution.approximation, session.gauge_words)
    write_maps(run / "maps.fits", [*formal, *maps, *relative], areas, notes=notes, **state)
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
    requirements = config.requirements()
    if idle := idle_dates(config, requirements):
        log.warning("assess: WARNING: %s", idle)
    margins = margins_of(session, requirements)
    write_margins(session, margins)
    write_horizons(session, assessed_horizons(session, requirements))
    _assess_periods(session)
    run.summarise(
        map=_map_summary(maps, formal, relative),
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
    log.info("assess: %s", found.coverage_words)


def _assess_periods(session: Session) -> None:
    found = periods_of(session)
    if found is None:
        return
    write_table(periods_table(found), session.run / "periods.ecsv")
    session.run.summarise(periods=periods_summary(found))
    for text in (found.verdict, found.pattern_sentence, *found.cautions):
        log.info("assess: %s", text)


def relative_maps(session: Session, places: Sequence[dict[str, Any]]) -> list[UncertaintyMap]:
    """Maps of relative positions, where the gauge is a question; else none."""
    found = [session.relative_map(**place) for place in places]
    return [replace(one, kind=RELATIVE) for one in found if one is not None]


def _map_summary(
    maps: Sequence[UncertaintyMap],
    formal: Sequence[UncertaintyMap],
    relative: Sequence[UncertaintyMap] = (),
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
    for chip, one in zip(chips, relative, strict=bool(relative)):
        chip["radius_max_relative"] = one.radius_max
    worst = max(chips, key=lambda c: c["radius_max"])
    largest = ("sigma_u_max", "sigma_v_max", "radius_max_least_squares", "radius_max_relative")
    return {
        "unit": maps[0].unit,
        "epoch": maps[0].epoch,
        **worst,
        **{key: max(c[key] for c in chips) for key in largest if key in worst},
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
    row["power"] = m.told
    return row if m.chip is None else row | {"chip": m.chip.number}
