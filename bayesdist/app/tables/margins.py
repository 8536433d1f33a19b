"""Margins of a run: rows of summary.json, margins.ecsv, and text for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.screen import number, table_text
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.store.summary import MarginRow, WorstPositionRow
from bayesdist.assess import Margin, Requirement
from bayesdist.assess.maps import per_axis
from bayesdist.utils.text import probability_words

# attributes that define the scope of a requirement, in addition to chip and epoch
SCOPE = ("region", "epochs", "relative", "separation", "magnitude")


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
