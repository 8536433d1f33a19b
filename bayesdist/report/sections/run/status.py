"""Status on top of the report: each criterion with its number and limit, and a verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.checks import Check
from bayesdist.numbers import number, rounded, with_mas
from bayesdist.report.contents import REPORT
from bayesdist.report.context import ReportInput
from bayesdist.report.sections.run.margins import VERDICT_LEVELS
from bayesdist.report.texttable import TextTable, check_cells

__all__ = [
    "Verdict",
    "status_checks",
    "status_table",
    "verdict",
]

GROUPS = ("Held-out truth", "Campaign", "Sampling", "Fit")


@dataclass(frozen=True)
class Verdict:
    """Verdict on the run in words; `level` is 'pass', 'warn' or 'fail'."""

    level: str
    headline: str
    sentences: tuple[str, ...]


def status_checks(r: ReportInput) -> dict[str, tuple[Check, ...]]:
    """Criteria by subject; empty groups are left out.

    Groups are 'Held-out truth', 'Campaign', 'Sampling', 'Fit', 'Requirements', 'Products'.
    """
    groups = {
        **{name: tuple(c for c in r.checks if c.group == name and c.name) for name in GROUPS},
        "Requirements": _margin_checks(r),
        "Products": tuple(
            replace(c, name=f"{p.path}: {c.name}")
            for p in r.products
            for c in p.checks
            if c.level != "note"
        ),
    }
    return {name: checks for name, checks in groups.items() if checks}


@REPORT.table("status")
def status_table(r: ReportInput) -> TextTable:
    """Table of all criteria with value, limit and outcome."""
    rows = tuple(
        (group, check.name, *check_cells(check))
        for group, checks in status_checks(r).items()
        for check in checks
    )
    heads = ("Group", "Criterion", "Found", "Limit", "Status")
    return TextTable("Status", heads, rows, words=tuple(range(5)), stacked=(2, 3), grouped=True)


def _margin_checks(r: ReportInput) -> tuple[Check, ...]:
    return tuple(
        Check(
            "Requirements",
            f"{m.requirement.name}: {m.requirement.statistic}, {m.verdict}",
            f"{rounded(m.value, (m.interval[1] - m.interval[0]) / 4)}\u202f{m.unit}, probability"
            f" {number(m.probability_met)}",
            f"at most {m.requirement.limit:g}\u202f{m.unit}, with probability"
            f" {m.requirement.probability:g}",
            VERDICT_LEVELS[m.verdict],
        )
        for m in r.margins
    )


def verdict(r: ReportInput) -> Verdict:
    """Verdict on the run.

    'fail' when the posterior is not converged, a requirement is missed or a product fails its
    check; 'warn' when something is undecided or nothing was sampled.
    """
    sentences = [_margin_sentence(r), _accuracy_sentence(r)]
    failed = [f"{p.path} ({c.name})" for p in r.products for c in p.checks if c.level == "fail"]
    if failed:
        sentences.append(f"Products that fail their own check: {', '.join(failed)}.")
    verdicts = {m.verdict for m in r.margins}
    if r.provisional:
        reasons = r.posterior.convergence.reasons  # type: ignore[union-attr]
        sentences.insert(0, f"Why: {'; '.join(reasons) or 'no reason was recorded'}.")
        return Verdict("fail", "NOT CONVERGED: do not rely on these numbers", tuple(sentences))
    if r.posterior is None:
        headline, level = "Least squares only: no posterior was sampled", "warn"
    else:
        headline, level = "The posterior is converged", "pass"
    if r.warnings:
        sentences[:0] = [f"{text}." for text in r.warnings]
        headline, level = f"{headline}, but read the warnings", _worse(level, "warn")
    if "missed" in verdicts:
        headline, level = f"{headline}; not every requirement is met", "fail"
    elif "undecided" in verdicts:
        headline, level = f"{headline}; not every requirement is decided", _worse(level, "warn")
    elif verdicts:
        headline = f"{headline}; every requirement is met"
    if failed:
        headline, level = f"{headline}; a product fails its check", "fail"
    return Verdict(level, headline, tuple(sentences))


def _worse(a: str, b: str) -> str:
    order = ("pass", "warn", "fail")
    return max(a, b, key=order.index)


def _margin_sentence(r: ReportInput) -> str:
    if not r.margins:
        return "No requirement was stated."
    by_verdict: dict[str, list[str]] = {}
    for m in r.margins:
        by_verdict.setdefault(m.verdict, []).append(m.requirement.name)
    parts = [
        f"{len(by_verdict[v])} {v} ({', '.join(by_verdict[v])})"
        for v in ("met", "missed", "undecided")
        if v in by_verdict
    ]
    return f"Requirements: {'; '.join(parts)}."


def _accuracy_sentence(r: ReportInput) -> str:
    whose = "posterior" if r.posterior is not None else "formal"
    if r.provisional:
        whose = f"provisional {whose}"
    worst = max(r.chips, key=lambda c: c.best_map.radius_max)
    best = worst.best_map
    median = float(np.median(np.concatenate([c.best_map.radius.ravel() for c in r.chips])))
    text = (
        f"The {whose} uncertainty of the distortion (radial, 1 σ) is"
        f" {with_mas(median, r.unit, r.scale_mas)} at the median"
        f" position and at most {with_mas(best.radius_max, r.unit, r.scale_mas)},"
        f" at pixel {r.position(best.position_of_max, worst.chip.number)}"
        f"{_with_shift(r)}"
    )
    if r.budget is None:
        return f"{text}."
    total = r.budget.rows()[-1]["radial"]
    with_budget = with_mas(total, r.budget.unit, r.scale_mas)
    whom = (
        ""
        if r.campaign is None
        else " for a new exposure whose shift and rotation are fitted by whoever uses it"
    )
    return f"{text}; with all terms of the budget the rms over the detector is {with_budget}{whom}."


def _with_shift(r: ReportInput) -> str:
    """Words on the part of a common shift and rotation in the errors of positions."""
    if r.selfcal is not None:
        return ", in the gauge of the solution"
    return ", shift and rotation included" if r.fit.model.n_frame else ""
