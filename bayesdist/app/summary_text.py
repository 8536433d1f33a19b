"""What a run found, as text for the screen."""

from __future__ import annotations

from bayesdist.app.margins import requirement_of
from bayesdist.app.rundir import RunDirectory
from bayesdist.app.screen import number, table_text

__all__ = ["margins_text", "results_text"]


def results_text(run: RunDirectory) -> str:
    """Budget, margins, verdict of the sampler, and where the report is."""
    summary = run.summary
    c = summary["sampler"]
    state = (
        "converged"
        if c["converged"]
        else f"NOT CONVERGED: everything here is provisional ({'; '.join(c['reasons'])})"
    )
    parts = [
        f"Error budget (rms over the detector, {summary['fit']['unit']})",
        table_text([{k: v for k, v in r.items() if k != "source"} for r in summary["budget"]], 3),
        "",
        "Margins",
        margins_text(summary["margins"]),
        "",
        f"Sampler: {state}; R-hat {number(c['rhat_max'], 5)}, ESS bulk {number(c['ess_bulk_min'])} "
        f"and tail {number(c['ess_tail_min'])}, {c['passes']} passes, {number(c['wall_s'], 3)} s",
        *(f"WARNING: {text}" for text in summary.get("warnings", [])),
        f"Report:  {run / 'report.html'}",
    ]
    return "\n".join(parts)


def margins_text(rows: list[dict]) -> str:
    """Margins as a table for the screen; what the statistic is of, where that is said of one."""
    scopes = [requirement_of(r).scope for r in rows]
    shown = [
        {
            "requirement": r["name"],
            "statistic": r["statistic"],
            **({"scope": scope or "-"} if any(scopes) else {}),
            "value": r["value"],
            "limit": r["limit"],
            "unit": r["unit"],
            "P(met)": f"{r['probability_met']:.3f} +- {r['mc_error']:.3f}",
            "asked": r["probability"],
            "verdict": r["verdict"],
        }
        for r, scope in zip(rows, scopes, strict=True)
    ]
    return table_text(shown, 3)
