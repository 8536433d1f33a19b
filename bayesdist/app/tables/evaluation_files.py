"""The evaluation of a run in its folder: maps, tables, sections of summary.json, and all of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.store.keys import attributes
from bayesdist.app.store.output import provenance_notes, write_table
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.store.summary import ValidityRow
from bayesdist.app.tables.diagnostics_files import fingerprint_of
from bayesdist.app.tables.margins import margin_rows, margin_table
from bayesdist.assess import Margin
from bayesdist.assess.budget.budget import ErrorBudget
from bayesdist.assess.coefficients import coefficient_table
from bayesdist.assess.evaluation import Evaluation
from bayesdist.assess.requirements.validity import ValidityPeriod
from bayesdist.files.records import read_record, write_record
from bayesdist.infer import LinearFit, Posterior
from bayesdist.products.maps_file import write_maps
from bayesdist.utils.checks import warnings_of

FILE = "evaluation.h5"
COLUMNS = ("epoch", "probability", "low", "high", "value")


def write_evaluation(
    run: RunDirectory,
    fit: LinearFit,
    posterior: Posterior,
    solution: Posterior,
    gauge: str,
    found: Evaluation,
) -> None:
    """Write an evaluation: maps.fits, tables, sections of summary.json, and evaluation.h5.

    `solution` is the posterior with all errors of the parameters, `gauge` that in which it stands,
    as a sentence; empty where that is no question.
    """
    head = provenance_notes(posterior, gauge)
    maps = [*found.formal, *found.maps, *found.relative]
    write_maps(
        run / "maps.fits",
        maps,
        found.areas,
        notes=(solution.approximation, gauge),
        converged=solution.convergence.converged,
    )
    coefficients = coefficient_table(fit, solution)
    coefficients.meta |= head
    write_table(coefficients, run / "coefficients.ecsv")
    write_table(_budget_table(found, head), run / "budget.ecsv")
    _write_margins(run, posterior, head, found.margins, found.validity)
    run.summarise(
        map=_map_summary(found),
        budget=found.budget.rows(),
        warnings=list(warnings_of(found.checks)),
    )
    write_record(run / FILE, found, fingerprint_of(fit, posterior))


def save_margins(
    run: RunDirectory,
    fit: LinearFit,
    posterior: Posterior,
    gauge: str,
    margins: Sequence[Margin],
    validity: Sequence[ValidityPeriod],
) -> None:
    """Replace the margins and validity periods of a run by others."""
    _write_margins(run, posterior, provenance_notes(posterior, gauge), margins, validity)
    if (run / FILE).exists():
        found = load_evaluation(run, fit, posterior)
        found = replace(found, margins=tuple(margins), validity=tuple(validity))
        write_record(run / FILE, found, fingerprint_of(fit, posterior))


def load_evaluation(run: RunDirectory, fit: LinearFit, posterior: Posterior) -> Evaluation:
    """The evaluation of a fit and a posterior; InputError where there is none of just these."""
    again = f"run 'bayesdist stage evaluate {run.path}' again"
    mark = fingerprint_of(fit, posterior)
    return read_record(run / FILE, Evaluation, "an evaluation", do=again, fingerprint=mark)


def _budget_table(found: Evaluation, head: Mapping[str, Any]) -> Table:
    budget: ErrorBudget = found.budget
    several = len(budget.chips) > 1
    rows = budget.rows_by_chip() if several else budget.rows()
    table = Table([{k: np.nan if v is None else v for k, v in row.items()} for row in rows])
    for name in ("u", "v", "radial", "radial_error"):
        table[name].unit = budget.unit
    settings = found.settings
    table.meta = {"epoch": settings.epoch, "grid": list(settings.grid)}
    table.meta |= {"statistic": "rms over the grid", **head}
    return table


def _write_margins(
    run: RunDirectory,
    posterior: Posterior,
    head: Mapping[str, Any],
    margins: Sequence[Margin],
    validity: Sequence[ValidityPeriod],
) -> None:
    table = margin_table(margins, several=len(posterior.model.chips) > 1)
    table.meta = dict(head)
    write_table(table, run / "margins.ecsv")
    _write_validity(run / "validity_periods.ecsv", validity)
    dates = [
        ValidityRow.row(
            one, one.requirement, probability=one.requirement.probability, until=one.epoch[-1]
        )
        for one in validity
    ]
    run.summarise(margins=margin_rows(margins), validity_periods=dates)


def _write_validity(path: Path, validity: Sequence[ValidityPeriod]) -> None:
    if not validity:
        path.unlink(missing_ok=True)
        return
    table = Table(
        {
            "requirement": np.concatenate(
                [np.repeat(h.requirement.name, h.epoch.size) for h in validity]
            ),
            **{name: np.concatenate([getattr(h, name) for h in validity]) for name in COLUMNS},
        }
    )
    table["epoch"].unit = "yr"
    table.meta = {
        "date": {h.requirement.name: h.date for h in validity},
        "units_of_value": {h.requirement.name: h.requirement.unit for h in validity},
        "band": "95 % Clopper-Pearson, of the number of draws",
        "holds": "while the drift goes on as the model has it",
    }
    write_table(table, path)


def _map_summary(found: Evaluation) -> dict[str, Any]:
    """The worst of all chips, and each chip."""
    chips: list[dict[str, Any]] = [
        {
            **attributes(m, "chip sigma_u_max sigma_v_max radius_max position_of_max"),
            "sigma_max": float(m.per_axis.max()),
            "ce68_max": float(m.circular_error(0.68).max()),
            "ce95_max": float(m.circular_error(0.95).max()),
            "radius_max_least_squares": least_squares.radius_max,
        }
        for m, least_squares in zip(found.maps, found.formal, strict=True)
    ]
    for chip, one in zip(chips, found.relative, strict=bool(found.relative)):
        chip["radius_max_relative"] = one.radius_max
    worst = max(chips, key=lambda c: c["radius_max"])
    largest = (
        *("sigma_u_max", "sigma_v_max", "ce68_max", "ce95_max"),
        *("radius_max_least_squares", "radius_max_relative"),
    )
    return {
        "unit": found.maps[0].unit,
        "epoch": found.maps[0].epoch,
        **worst,
        **{key: max(c[key] for c in chips) for key in largest if key in worst},
        "chips": chips,
    }
