"""Results of a run in its folder: diagnostics, evaluation and margins, written and read.

Margins are rows of summary.json, margins.ecsv, and text for the terminal.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.screen import number, table_text
from bayesdist.app.store.record import attributes, provenance_notes, write_table
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.store.summary import MarginRow, ValidityRow, WorstPositionRow
from bayesdist.assess import Margin, Requirement
from bayesdist.assess.budget import ErrorBudget
from bayesdist.assess.evaluation import Evaluation
from bayesdist.assess.maps import per_axis
from bayesdist.assess.requirements.margins import ValidityPeriod
from bayesdist.assess.solution import coefficient_table
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.diagnose.residuals.misfit import Misfit
from bayesdist.diagnose.score.result import ScoreTest
from bayesdist.errors import FormatError, InputError, required
from bayesdist.files.hdf5 import read_record, write_record
from bayesdist.infer import LinearFit, Posterior
from bayesdist.products.maps_file import write_maps
from bayesdist.utils.checks import warnings_of
from bayesdist.utils.text import probability_words

DIAGNOSTICS = "diagnostics.h5"

log = logging.getLogger("bayesdist")

# attributes that define the scope of a requirement, in addition to chip and epoch
SCOPE = ("region", "epochs", "relative", "separation", "magnitude")


def fingerprint_of(fit: LinearFit, posterior: Posterior) -> str:
    """Hash of a fit and of the draws of a posterior, which identifies files made from them."""
    digest = hashlib.sha256()
    for values in (fit.mean, fit.cov, posterior.theta):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def write_diagnostics(
    run: RunDirectory, fit: LinearFit, posterior: Posterior, found: Diagnostics
) -> None:
    """Write diagnostics of a fit and a posterior, and their sections of summary.json."""
    correlated = required(found.correlated, "correlated errors are diagnosed of a posterior only")
    write_record(run / DIAGNOSTICS, found, fingerprint_of(fit, posterior))
    facts = correlated.facts
    run.summarise(
        discrepancy=dict(facts),
        score_tests=[_row(test) for test in found.score_tests],
        misfit=_misfit_summary(found),
    )
    for row in facts.get("structure", []):
        log.info(
            "diagnose: structure beyond the model on chip %s, %s: %.2g %s rms, at most %.2g with "
            "95 %% probability",
            *(row["chip"], row["axis"], row["median"], facts["unit"], row["most"]),
        )
    for test in found.score_tests:
        if test.warned:
            log.info("diagnose: %s: %s", test.finding, test.remedy)


def load_diagnostics(run: RunDirectory, fit: LinearFit, posterior: Posterior) -> Diagnostics | None:
    """Diagnostics of a fit and a posterior; None if the run has none made from these."""
    path, advice = run / DIAGNOSTICS, f"run 'bayesdist stage diagnose {run.path}' again"
    if not path.exists():
        return None
    mark = fingerprint_of(fit, posterior)
    try:
        return read_record(path, Diagnostics, "diagnostics", do=advice, fingerprint=mark)
    except FormatError:
        raise
    except InputError:  # made from another fit or posterior
        return None


def _row(test: ScoreTest) -> dict[str, Any]:
    """A test as a row of summary.json."""
    row = asdict(test)
    for key in ("held_by", "group", "doubt"):
        del row[key]
    # JSON has no infinity: the smallest size is null if no effect would be detected
    return row | {"smallest": test.smallest if np.isfinite(test.smallest) else None}


def _misfit_summary(found: Diagnostics) -> dict[str, Any]:
    worst = found.misfit
    out = _misfit_row(worst) | {"unit": worst.unit, "significant": worst.significant}
    if len(found.misfits) > 1:
        out["chips"] = [_misfit_row(m) for m in found.misfits]
    return out


def _misfit_row(m: Misfit) -> dict[str, Any]:
    row = attributes(m, "p_value partition structure power")
    return row if m.chip is None else row | {"chip": m.chip.number}


EVALUATION = "evaluation.h5"
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

    `solution` is the posterior with all errors of the parameters. `gauge` is a sentence that states
    its gauge; empty except for self-calibrations.
    """
    head = provenance_notes(posterior, gauge)
    maps = [*found.formal, *found.maps, *found.relative]
    write_maps(
        run / "maps.fits",
        maps,
        found.areas,
        notes=(gauge,),
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
    write_record(run / EVALUATION, found, fingerprint_of(fit, posterior))


def save_margins(
    run: RunDirectory,
    fit: LinearFit,
    posterior: Posterior,
    gauge: str,
    margins: Sequence[Margin],
    validity: Sequence[ValidityPeriod],
) -> None:
    """Replace the margins and validity periods of a run."""
    _write_margins(run, posterior, provenance_notes(posterior, gauge), margins, validity)
    if (run / EVALUATION).exists():
        evaluation = load_evaluation(run, fit, posterior)
        evaluation = replace(evaluation, margins=tuple(margins), validity=tuple(validity))
        write_record(run / EVALUATION, evaluation, fingerprint_of(fit, posterior))


def load_evaluation(run: RunDirectory, fit: LinearFit, posterior: Posterior) -> Evaluation:
    """Evaluation of a fit and a posterior; raises InputError if there is none made from these."""
    advice = f"run 'bayesdist stage evaluate {run.path}' again"
    mark = fingerprint_of(fit, posterior)
    return read_record(run / EVALUATION, Evaluation, "an evaluation", do=advice, fingerprint=mark)


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
            period,
            period.requirement,
            probability=period.requirement.probability,
            until=period.epoch[-1],
        )
        for period in validity
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
    """Largest errors over all chips, and those of each chip."""
    chips: list[dict[str, Any]] = [
        {
            **attributes(m, "chip sigma_u_max sigma_v_max radius_max position_of_max"),
            "sigma_max": float(np.nanmax(m.per_axis)),
            "ce68_max": float(np.nanmax(m.circular_error(0.68))),
            "ce95_max": float(np.nanmax(m.circular_error(0.95))),
            "radius_max_least_squares": least_squares.radius_max,
        }
        for m, least_squares in zip(found.maps, found.formal, strict=True)
    ]
    for chip, relative in zip(chips, found.relative, strict=bool(found.relative)):
        chip["radius_max_relative"] = relative.radius_max
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


def margin_rows(margins: Sequence[Margin]) -> list[dict[str, Any]]:
    """Margins as plain rows, for files and for the terminal."""
    return [
        MarginRow.row(
            m,
            m.requirement,
            margin_percent=m.percent,
            worst=WorstPositionRow.row(m.worst),
            remedy=None if m.remedy is None else m.remedy.sentence,
        )
        for m in margins
    ]


def margin_table(margins: Sequence[Margin], *, several: bool) -> Table:
    """Table of margins.ecsv; `several` is True if there are several chips."""
    columns: dict[str, list[Any]] = {}
    for m, row in zip(margins, margin_rows(margins), strict=True):
        flat = {k: v for k, v in row.items() if k not in ("interval", "worst", "rests_on", *SCOPE)}
        flat["epoch"] = np.nan if flat["epoch"] is None else flat["epoch"]
        flat["chip"] = "all" if flat["chip"] is None else str(flat["chip"])
        flat["remedy"] = flat["remedy"] or ""
        flat["rests_on"] = "; ".join(row["rests_on"])
        flat |= {"scope": m.requirement.scope, "lo95": m.interval[0], "hi95": m.interval[1]}
        flat |= {f"worst_{key}": value for key, value in row["worst"].items()}
        if not several:
            del flat["chip"], flat["worst_chip"]
        for name, value in flat.items():
            columns.setdefault(name, []).append(value)
    return Table(columns)


def judged_requirements(run: RunDirectory) -> tuple[Requirement, ...]:
    """Requirements of the margins in summary.json."""
    return tuple(requirement_of(row) for row in run.summary.get("margins", []))


def requirement_of(row: Mapping[str, Any]) -> Requirement:
    """Requirement of one row of the margins in summary.json."""
    keys = ("name", "statistic", "limit", "unit", "probability", "epoch", "chip", *SCOPE)
    # runs of earlier versions had a single unnamed chip and no regions
    arguments = {k: row[k] for k in keys if row.get(k) is not None}
    if "epochs" in arguments:
        del arguments["epoch"]  # the worst epoch of the range
    return Requirement(**arguments)


def results_text(run: RunDirectory) -> str:
    """Text with geometry, budget, margins, convergence, and the location of the report."""
    summary = run.summary
    c = summary["sampler"]
    state = (
        "converged"
        if c["converged"]
        else f"NOT CONVERGED: everything here is provisional ({'; '.join(c['reasons'])})"
    )
    parts = [
        "Geometry of the least-squares fit",
        *(f"chip {row['chip']}: {row['sentence']}" for row in summary["fit"]["geometry"]),
        "",
        f"Error budget (rms over the detector, 1 sigma, {summary['fit']['unit']})",
        table_text([_budget_row(row) for row in summary["budget"]], 3),
        "",
        "Margins",
        margins_text(summary["margins"]),
        *reasons_of(summary["margins"]),
        "",
        f"Sampler: {state}; R-hat {number(c['rhat_max'], 5)}, ESS bulk {number(c['ess_bulk_min'])} "
        f"and tail {number(c['ess_tail_min'])}, {c['passes']} passes, {number(c['wall_s'], 3)} s",
        *(f"WARNING: {text}" for text in summary.get("warnings", [])),
        f"Report:  {run / 'report.html'}",
    ]
    return "\n".join(parts)


def _budget_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """Row of the budget for the terminal: u, v and per axis, with the error of the latter."""
    error = row["radial_error"]
    return {key: row[key] for key in ("name", "kind", "u", "v")} | {
        "per axis": float(per_axis(row["u"], row["v"])),
        "+-": None if error is None else error / 2**0.5,
    }


def _probability(row: Mapping[str, Any]) -> str:
    """Probability of meeting a limit with its Monte-Carlo error, or '> 0.9993'."""
    words = probability_words(row["probability_met"], row["mc_error"], row["n_effective"])
    return words.removeprefix("P ").removeprefix("= ")


def reasons_of(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Sentences on the requirements that are not met: the reason, and a remedy."""
    out = []
    for r in rows:
        if r["verdict"] != "met":
            out.append(f"{r['name']}: {r['verdict']}: {r['reason']}")
        if r["remedy"]:
            out.append(f"{r['name']}: {r['remedy']}")
    return out


def margins_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Table of margins for the terminal, with a column 'scope' if any requirement has one."""
    scopes = [requirement_of(r).scope for r in rows]
    shown = [
        {
            "requirement": r["name"],
            "statistic": r["statistic"],
            **({"scope": scope or "-"} if any(scopes) else {}),
            "value": r["value"],
            "limit": r["limit"],
            "unit": r["unit"],
            "P(met)": _probability(r),
            "asked": r["probability"],
            "verdict": r["verdict"],
        }
        for r, scope in zip(rows, scopes, strict=True)
    ]
    return table_text(shown, 3)
