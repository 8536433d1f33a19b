"""Status at the top of the report: criteria with values and limits, and a verdict."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from bayesdist.assess.maps import per_axis
from bayesdist.assess.requirements.margins import ValidityPeriod
from bayesdist.assess.requirements.verdict import VERDICT_LEVELS
from bayesdist.report.contents import REPORT
from bayesdist.report.run import (
    ReportedRun,
    is_provisional,
    length_text,
    on_focal_plane,
    position_text,
    scale_mas,
    setting,
)
from bayesdist.report.sections.provenance import checks_of_file, written_files
from bayesdist.report.texttable import TextTable, check_cells
from bayesdist.utils.checks import GROUPS, LEVELS, Check, doubts_of, warnings_of, worst
from bayesdist.utils.text import count, counted, rounded, with_mas

if TYPE_CHECKING:
    from bayesdist.assess import Margin


def validity_checks(run: ReportedRun) -> tuple[Check, ...]:
    """Check of each validity period: it must not end before the start of the run."""
    began = _began(run)
    return tuple(_validity_check(period, began) for period in run.evaluation.validity)


def _validity_check(one: ValidityPeriod, began: float | None) -> Check:
    name = f"{one.requirement.name}: the limit is met with probability"
    last, start = float(one.epoch[-1]), float(one.epoch[0])
    if one.date is None:
        outcome = f"at least until {last:.1f}"
    elif one.date == start:
        outcome = f"not at {start:.1f}, the end of the data"
    else:
        early, late = one.interval
        first = start if early is None else early
        end = f"after {last:.1f}" if late is None else f"{late:.1f}"
        outcome = f"until {one.date:.1f} ({first:.1f} to {end})"
    over = one.date is not None and one.date <= (start if began is None else max(start, began))
    limit = "beyond the data" if began is None else f"beyond {began:.1f}, when this run began"
    asked = f"{one.requirement.probability:g}"
    return Check("Validity", f"{name} {asked}", outcome, limit, "warn" if over else "pass")


def validity_clause(run: ReportedRun) -> str:
    """Clause on the validity period of the requirement that is the first to fail."""
    if run.model.time is None:
        return "no validity period, as the model does not depend on time"
    if not run.evaluation.validity:
        return "no validity period was computed"
    first = min(run.evaluation.validity, key=lambda one: math.inf if one.date is None else one.date)
    if first.date is None:
        return f"the validity period lasts at least until {float(first.epoch[-1]):.1f}"
    if first.date == float(first.epoch[0]):
        return f"the validity period has ended with the data ({first.requirement.name})"
    began = _began(run)
    verb = "ended in" if began is not None and first.date <= began else "ends in"
    return f"the validity period {verb} {first.date:.1f} ({first.requirement.name})"


def epoch_clause(run: ReportedRun) -> str:
    """' at epoch 2010.30', the date of the verdicts or, without verdicts, of the maps."""
    judged = {m.epoch for m in run.evaluation.margins if m.epoch is not None}
    if len(judged) > 1:
        return f" at the epochs {min(judged):.2f} to {max(judged):.2f}"
    epoch = judged.pop() if judged else run.evaluation.maps[0].epoch
    if epoch is None or run.model.time is None:
        return ""
    return f" at epoch {epoch:.2f}"


def _began(run: ReportedRun) -> float | None:
    """Decimal year in which the run began; None if unknown."""
    created = run.provenance.get("created")
    if not created:
        return None
    date = datetime.fromisoformat(str(created)).astimezone(UTC)
    start = datetime(date.year, 1, 1, tzinfo=UTC)
    end = datetime(date.year + 1, 1, 1, tzinfo=UTC)
    return date.year + (date - start) / (end - start)


_OWN_CLAUSE = ("Requirements", "Validity")  # groups with a clause of the headline
_NAMED = 2  # rows of the status table that the headline names
# groups of the status table by importance for a reader; the others follow as in GROUPS
_FIRST = ("Requirements", "Validity", "Assumptions", "Errors", "Held-out truth", "Fit")
_ORDER = (*_FIRST, *sorted(set(GROUPS) - set(_FIRST), key=("Score tests", *GROUPS).index))


@dataclass(frozen=True)
class RequirementLine:
    """Verdict on one requirement, as a line at the top of the report."""

    level: str  # 'pass', 'warn' or 'fail'
    verdict: str  # in capitals: 'MET'
    text: str  # 'p95 0.0131 pix (36.0 mas), limit 0.03 pix, P > 0.9992'


@dataclass(frozen=True)
class Verdict:
    """Verdict on the run in words; `level` is 'pass', 'warn' or 'fail'."""

    level: str
    headline: str
    sentences: tuple[str, ...]
    requirements: tuple[RequirementLine, ...] = ()


def status_checks(run: ReportedRun) -> dict[str, tuple[Check, ...]]:
    """Criteria by group; empty groups are left out.

    The order is requirements, validity and assumptions, errors, held-out data, fit, and the other
    groups.
    """
    names = dict.fromkeys((*GROUPS, *(check.group for check in run.evaluation.checks)))
    groups = {
        **{name: tuple(c for c in run.evaluation.checks if c.group == name) for name in names},
        "Requirements": _margin_checks(run),
        "Validity": validity_checks(run),
        "Products": tuple(
            replace(check, name=f"{written['path']}: {check.name}")
            for written in written_files(run)
            for check in checks_of_file(written)
            if check.level != "note"
        ),
    }
    return {name: groups[name] for name in dict.fromkeys((*_ORDER, *groups)) if groups[name]}


@REPORT.table("status")
def status_table(run: ReportedRun) -> TextTable:
    """Table of all criteria with value, limit and outcome."""
    rows = tuple(
        (group, check.name, *check_cells(check))
        for group, checks in status_checks(run).items()
        for check in checks
    )
    heads = ("Group", "Criterion", "Found", "Limit", "Status")
    return TextTable("Status", heads, rows, words=tuple(range(5)), stacked=(2, 3), grouped=True)


def _margin_checks(run: ReportedRun) -> tuple[Check, ...]:
    """Checks of requirements; undecided ones name the rows that cause the doubt."""
    doubts = "; ".join(f"“{doubt.name}”" for doubt in doubts_of(run.evaluation.checks))

    def why(m: Margin) -> str:
        if m.verdict not in ("undecided", "not shown"):
            return ""
        see = f"see {doubts}" if doubts and m.verdict == "undecided" else m.reason
        return f"; {m.verdict}: {see}"

    return tuple(
        Check(
            "Requirements",
            f"{m.requirement.name}: {m.requirement.statistic}, {m.verdict}",
            f"{rounded(m.value, (m.interval[1] - m.interval[0]) / 4)}\u202f{m.unit}, probability"
            f" {counted(m.probability_met, m.mc_error, m.n_effective)}{why(m)}",
            f"at most {m.requirement.limit:g}\u202f{m.unit}, with probability"
            f" {m.requirement.probability:g}",
            VERDICT_LEVELS[m.verdict],
        )
        for m in run.evaluation.margins
    )


def verdict(run: ReportedRun) -> Verdict:
    """Verdict on the run: the worst of all rows of the status table and of all warnings.

    The headline begins with what is worst, and states its epoch and the end of its validity.
    """
    groups = status_checks(run)
    lines = requirement_lines(run)
    numbers: tuple[str, ...] = (_accuracy_sentence(run),)
    if is_provisional(run):
        if not lines:
            numbers = ("No requirement was stated.", *numbers)
        reasons = run.posterior.convergence.reasons
        why = f"Why: {'; '.join(reasons) or 'no reason was recorded'}."
        checks = (check for check in run.evaluation.checks if check.name != "Converged")
        remarks = warnings_of(checks)  # without the reason, which is stated above
        sentences = (why, *(f"{text}." for text in remarks), *numbers)
        headline = "NOT CONVERGED: do not rely on these numbers"
        return Verdict("fail", headline, sentences, lines)
    sentences = (*(f"{text}." for text in warnings_of(run.evaluation.checks)), *numbers)
    clauses = [(worst(groups.get("Requirements", ())), _requirements_clause(run))]
    other_checks = [c for name, rows in groups.items() if name not in _OWN_CLAUSE for c in rows]
    for level, verb in (("fail", "fails"), ("warn", "warns")):
        names = [c.name for c in other_checks if c.level == level]
        if names:
            clauses.append((level, _rows_clause(names, verb)))
    clauses.append((worst(groups.get("Validity", ())), validity_clause(run)))
    clauses.sort(key=lambda clause: LEVELS.index(clause[0]), reverse=True)
    level = max((level for level, _ in clauses), key=LEVELS.index)
    headline = "; ".join(text for _, text in clauses)
    return Verdict(level, headline[:1].upper() + headline[1:], sentences, lines)


def _requirements_clause(run: ReportedRun) -> str:
    """Clause on the requirements that are met, and the epoch of this statement."""
    at, n = epoch_clause(run), len(run.evaluation.margins)
    if not n:
        return (
            f"no requirement was stated; errors are those{at}"
            if at
            else ("no requirement was stated")
        )
    counts = {v: sum(m.verdict == v for m in run.evaluation.margins) for v in VERDICT_LEVELS}
    if counts["met"] == n:
        return f"every requirement is met{at}"
    del counts["met"]
    (first, k), *other_counts = [(v, counts[v]) for v in reversed(VERDICT_LEVELS) if counts.get(v)]
    of = f"{k} of {n} requirements {'is' if k == 1 else 'are'}" if n > 1 else "the requirement is"
    return " and ".join([f"{of} {first}", *(f"{number} {v}" for v, number in other_counts)]) + at


def _rows_clause(names: Sequence[str], verb: str) -> str:
    """Clause on the rows of the status table that fail or warn."""
    if len(names) == 1:
        return f"one criterion {verb} ({names[0]})"
    different = tuple(  # a file may have several findings
        name if n == 1 else f"{name}, {n} findings" for name, n in Counter(names).items()
    )
    shown, n_more = different[:_NAMED], len(different) - _NAMED
    named = "; ".join((*shown, f"and {n_more} more") if n_more > 0 else shown)
    return f"{len(names)} criteria {verb[:-1]} ({named})"


def requirement_lines(run: ReportedRun) -> tuple[RequirementLine, ...]:
    """Value, limit and probability of each requirement, in the unit of its limit."""
    lines, mas = [], scale_mas(run)
    for m in run.evaluation.margins:
        value = f"{rounded(m.value, (m.interval[1] - m.interval[0]) / 4)}\u202f{m.unit}"
        if m.unit == "pix" and mas is not None:
            value += f" ({with_mas(m.value * mas, 'mas', None)})"
        value += on_focal_plane(run, m.value, m.unit)
        met = counted(m.probability_met, m.mc_error, m.n_effective)
        probability = f"P {met}" if met[:1] in "<>" else f"P = {met}"
        text = (
            f"{m.requirement.name}: {m.requirement.statistic} {value},"
            f" limit {m.requirement.limit:g}\u202f{m.unit}, {probability}"
        )
        lines.append(RequirementLine(VERDICT_LEVELS[m.verdict], m.verdict.upper(), text))
    return tuple(lines)


def facts_line(run: ReportedRun) -> str:
    """Stars, exposures, dates, instrument, filter and version, as far as they are known."""
    stars, rows = run.diagnostics.sample, run.kind.words.rows
    table, n = stars.table, int(np.count_nonzero(run.diagnostics.sums.exposures.n))
    facts = [
        f"{count(run.fit.n_used)} of {count(stars.n_total)} {rows} used",
        f"{count(n)} exposure{'' if n == 1 else 's'}",
    ]
    if table.epoch is not None and table.epoch.size:
        first, last = f"{np.min(table.epoch):.2f}", f"{np.max(table.epoch):.2f}"
        facts.append(first if first == last else f"{first} to {last}")
    parts = (str(setting(run, "detector", key, "")) for key in ("mission", "instrument", "name"))
    facts.append(" ".join(dict.fromkeys(part for part in parts if part)))
    filters = [name for name in table.filter_names if name] or [
        str(setting(run, "detector", "filter", "") or "")
    ]
    facts.append(", ".join(filters))
    version = str(run.provenance.get("versions", {}).get("bayesdist", ""))
    facts.append(f"bayesdist {version}" if version else "")
    return " · ".join(fact for fact in facts if fact)


def _accuracy_sentence(run: ReportedRun) -> str:
    whose = "provisional posterior" if is_provisional(run) else "posterior"
    maps = run.evaluation.maps
    worst = max(maps, key=lambda m: m.radius_max)  # where per-axis errors are largest
    # NaN off the field of the detector
    median = float(np.nanmedian(np.concatenate([m.per_axis.ravel() for m in maps])))
    like = float(np.nanmax(worst.per_axis))

    def length(value: float) -> str:
        return length_text(run, value, like=like)

    circles = " and ".join(
        f"CE{p} {length(max(float(np.nanmax(m.circular_error(p / 100))) for m in maps))}"
        for p in (68, 95)
    )
    text = (
        f"The {whose} uncertainty of the distortion (per axis, 1 σ) is"
        f" {length(median)} at the median position and at most {length(like)},"
        f" at pixel {position_text(run, worst.position_of_max, worst.chip)}{_with_shift(run)}"
        f" ({circles} at most)"
    )
    total = run.evaluation.budget.rows()[-1]
    with_budget = length(float(per_axis(total["u"], total["v"])))
    return (
        f"{text}; with all terms of the budget the rms over the detector is {with_budget} per"
        f" axis{run.kind.words.whom}."
    )


def _with_shift(run: ReportedRun) -> str:
    """Clause on whether errors of positions include a common shift and rotation."""
    return run.kind.words.with_shift if run.model.n_frame else ""
