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
from bayesdist.report.context import ReportInput, needed
from bayesdist.report.texttable import TextTable, check_cells
from bayesdist.utils.checks import GROUPS, LEVELS, Check, doubts_of, warnings_of, worst
from bayesdist.utils.numbers import count, counted, rounded, with_mas

if TYPE_CHECKING:
    from bayesdist.assess import Margin


def validity_checks(r: ReportInput) -> tuple[Check, ...]:
    """Check of each validity period: it must not end before the start of the run."""
    began = _began(r)
    return tuple(_validity_check(period, began) for period in r.validity)


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


def validity_clause(r: ReportInput) -> str:
    """Clause on the validity period of the requirement that is the first to fail."""
    if r.fit.model.time is None:
        return "no validity period, as the model does not depend on time"
    if not r.validity:
        return "no validity period was computed"
    first = min(r.validity, key=lambda one: math.inf if one.date is None else one.date)
    if first.date is None:
        return f"the validity period lasts at least until {float(first.epoch[-1]):.1f}"
    if first.date == float(first.epoch[0]):
        return f"the validity period has ended with the data ({first.requirement.name})"
    began = _began(r)
    verb = "ended in" if began is not None and first.date <= began else "ends in"
    return f"the validity period {verb} {first.date:.1f} ({first.requirement.name})"


def epoch_clause(r: ReportInput) -> str:
    """' at epoch 2010.30', the date of the verdicts or, without verdicts, of the maps."""
    judged = {m.epoch for m in r.margins if m.epoch is not None}
    if len(judged) > 1:
        return f" at the epochs {min(judged):.2f} to {max(judged):.2f}"
    epoch = judged.pop() if judged else r.chips[0].best_map.epoch
    if epoch is None or r.fit.model.time is None:
        return ""
    return f" at epoch {epoch:.2f}"


def _began(r: ReportInput) -> float | None:
    """Decimal year in which the run began; None if unknown."""
    created = r.provenance.get("created")
    if not created:
        return None
    date = datetime.fromisoformat(str(created)).astimezone(UTC)
    start = datetime(date.year, 1, 1, tzinfo=UTC)
    end = datetime(date.year + 1, 1, 1, tzinfo=UTC)
    return date.year + (date - start) / (end - start)


_OWN_CLAUSE = ("Requirements", "Validity")  # groups with a clause of the headline
_UNSAMPLED = "least squares only, no posterior was sampled"
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


def status_checks(r: ReportInput) -> dict[str, tuple[Check, ...]]:
    """Criteria by group; empty groups are left out.

    The order is requirements, validity and assumptions, errors, held-out data, fit, and the other
    groups.
    """
    names = dict.fromkeys((*GROUPS, *(check.group for check in r.checks)))
    groups = {
        **{name: tuple(c for c in r.checks if c.group == name) for name in names},
        "Requirements": _margin_checks(r),
        "Validity": validity_checks(r),
        "Products": tuple(
            replace(c, name=f"{p.path}: {c.name}")
            for p in r.products
            for c in p.checks
            if c.level != "note"
        ),
    }
    return {name: groups[name] for name in dict.fromkeys((*_ORDER, *groups)) if groups[name]}


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
    """Checks of requirements; undecided ones name the rows that cause the doubt."""
    doubts = "; ".join(f"“{doubt.name}”" for doubt in doubts_of(r.checks))

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
        for m in r.margins
    )


def verdict(r: ReportInput) -> Verdict:
    """Verdict on the run: the worst of all rows of the status table and of all warnings.

    The headline begins with what is worst, and states its epoch and the end of its validity.
    """
    groups = status_checks(r)
    lines = requirement_lines(r)
    numbers: tuple[str, ...] = (_accuracy_sentence(r),)
    if r.provisional:
        if not lines:
            numbers = ("No requirement was stated.", *numbers)
        reasons = needed(r.posterior).convergence.reasons
        why = f"Why: {'; '.join(reasons) or 'no reason was recorded'}."
        remarks = warnings_of(c for c in r.checks if c.name != "Converged")  # repeats the reason
        sentences = (why, *(f"{text}." for text in remarks), *numbers)
        headline = "NOT CONVERGED: do not rely on these numbers"
        return Verdict("fail", headline, sentences, lines)
    sentences = (*(f"{text}." for text in r.warnings), *numbers)
    clauses = [(worst(groups.get("Requirements", ())), _requirements_clause(r))]
    own_clauses: tuple[str, ...] = _OWN_CLAUSE
    if r.posterior is None:
        clauses.append(("warn", _UNSAMPLED))
        own_clauses = (*own_clauses, "Sampling")
    other_checks = [c for name, rows in groups.items() if name not in own_clauses for c in rows]
    for level, verb in (("fail", "fails"), ("warn", "warns")):
        names = [c.name for c in other_checks if c.level == level]
        if names:
            clauses.append((level, _rows_clause(names, verb)))
    clauses.append((worst(groups.get("Validity", ())), validity_clause(r)))
    # the kind of solution comes first, followed by what is worst
    clauses.sort(key=lambda one: (one[1] == _UNSAMPLED, LEVELS.index(one[0])), reverse=True)
    level = max((level for level, _ in clauses), key=LEVELS.index)
    headline = "; ".join(text for _, text in clauses)
    return Verdict(level, headline[:1].upper() + headline[1:], sentences, lines)


def _requirements_clause(r: ReportInput) -> str:
    """Clause on the requirements that are met, and the epoch of this statement."""
    at, n = epoch_clause(r), len(r.margins)
    if not n:
        return (
            f"no requirement was stated; errors are those{at}"
            if at
            else ("no requirement was stated")
        )
    counts = {v: sum(m.verdict == v for m in r.margins) for v in VERDICT_LEVELS}
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


def requirement_lines(r: ReportInput) -> tuple[RequirementLine, ...]:
    """Value, limit and probability of each requirement, in the unit of its limit."""
    lines = []
    for m in r.margins:
        value = f"{rounded(m.value, (m.interval[1] - m.interval[0]) / 4)}\u202f{m.unit}"
        if m.unit == "pix" and r.scale_mas is not None:
            value += f" ({with_mas(m.value * r.scale_mas, 'mas', None)})"
        value += r.on_focal_plane(m.value, m.unit)
        met = counted(m.probability_met, m.mc_error, m.n_effective)
        probability = f"P {met}" if met[:1] in "<>" else f"P = {met}"
        text = (
            f"{m.requirement.name}: {m.requirement.statistic} {value},"
            f" limit {m.requirement.limit:g}\u202f{m.unit}, {probability}"
        )
        lines.append(RequirementLine(VERDICT_LEVELS[m.verdict], m.verdict.upper(), text))
    return tuple(lines)


def facts_line(r: ReportInput) -> str:
    """Stars, exposures, dates, instrument, filter and version, as far as they are known."""
    table, n = r.stars.table, int(np.count_nonzero(r.exposures.n))
    facts = [
        f"{count(r.fit.n_used)} of {count(r.stars.n_total)} {r.words.rows} used",
        f"{count(n)} exposure{'' if n == 1 else 's'}",
    ]
    if table.epoch is not None and table.epoch.size:
        first, last = f"{np.min(table.epoch):.2f}", f"{np.max(table.epoch):.2f}"
        facts.append(first if first == last else f"{first} to {last}")
    parts = (str(r.setting("detector", key, "")) for key in ("mission", "instrument", "name"))
    facts.append(" ".join(dict.fromkeys(part for part in parts if part)))
    filters = [name for name in table.filter_names if name] or [
        str(r.setting("detector", "filter", "") or "")
    ]
    facts.append(", ".join(filters))
    version = str(r.provenance.get("versions", {}).get("bayesdist", ""))
    facts.append(f"bayesdist {version}" if version else "")
    return " · ".join(fact for fact in facts if fact)


def _accuracy_sentence(r: ReportInput) -> str:
    whose = "posterior" if r.posterior is not None else "formal (least-squares)"
    if r.provisional:
        whose = f"provisional {whose}"
    worst = max(r.chips, key=lambda c: c.best_map.radius_max)  # where per-axis errors are largest
    best = worst.best_map
    maps = [c.best_map for c in r.chips]
    # NaN off the field of the detector
    median = float(np.nanmedian(np.concatenate([m.per_axis.ravel() for m in maps])))
    like = float(np.nanmax(best.per_axis))

    def length(value: float) -> str:
        return r.length(value, like=like)

    circles = " and ".join(
        f"CE{p} {length(max(float(np.nanmax(m.circular_error(p / 100))) for m in maps))}"
        for p in (68, 95)
    )
    text = (
        f"The {whose} uncertainty of the distortion (per axis, 1 σ) is"
        f" {length(median)} at the median position and at most {length(like)},"
        f" at pixel {r.position(best.position_of_max, worst.chip.number)}{_with_shift(r)}"
        f" ({circles} at most)"
    )
    if r.budget is None:
        return f"{text}."
    total = r.budget.rows()[-1]
    with_budget = length(float(per_axis(total["u"], total["v"])))
    return (
        f"{text}; with all terms of the budget the rms over the detector is {with_budget} per"
        f" axis{r.words.whom}."
    )


def _with_shift(r: ReportInput) -> str:
    """Clause on whether errors of positions include a common shift and rotation."""
    return r.words.with_shift if r.fit.model.n_frame else ""
