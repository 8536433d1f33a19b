"""Validity period of a calibration: until when requirements are met, and the epoch of a verdict."""

from __future__ import annotations

import math
from datetime import UTC, datetime

from bayesdist.assess.requirements.validity import ValidityPeriod
from bayesdist.report.context import ReportInput
from bayesdist.utils.checks import Check


def validity_checks(r: ReportInput) -> tuple[Check, ...]:
    """Check of each validity period: that it has not ended before the run began."""
    began = _began(r)
    return tuple(_validity_check(one, began) for one in r.validity)


def _validity_check(one: ValidityPeriod, began: float | None) -> Check:
    name = f"{one.requirement.name}: the limit is met with probability"
    last, start = float(one.epoch[-1]), float(one.epoch[0])
    if one.date is None:
        found = f"at least until {last:.1f}"
    elif one.date == start:
        found = f"not at {start:.1f}, the end of the data"
    else:
        early, late = one.interval
        first = start if early is None else early
        end = f"after {last:.1f}" if late is None else f"{late:.1f}"
        found = f"until {one.date:.1f} ({first:.1f} to {end})"
    over = one.date is not None and one.date <= (start if began is None else max(start, began))
    limit = "beyond the data" if began is None else f"beyond {began:.1f}, when this run began"
    asked = f"{one.requirement.probability:g}"
    return Check("Validity", f"{name} {asked}", found, limit, "warn" if over else "pass")


def validity_clause(r: ReportInput) -> str:
    """Clause on the validity period: that of the requirement that is the first to fail."""
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
    """' at epoch 2010.30', the date that verdicts or, without them, the maps are of."""
    judged = {m.epoch for m in r.margins if m.epoch is not None}
    if len(judged) > 1:
        return f" at the epochs {min(judged):.2f} to {max(judged):.2f}"
    epoch = judged.pop() if judged else r.chips[0].best_map.epoch
    if epoch is None or r.fit.model.time is None:
        return ""
    return f" at epoch {epoch:.2f}"


def _began(r: ReportInput) -> float | None:
    """Decimal year in which the run began; None where that is not known."""
    created = r.provenance.get("created")
    if not created:
        return None
    date = datetime.fromisoformat(str(created)).astimezone(UTC)
    start = datetime(date.year, 1, 1, tzinfo=UTC)
    end = datetime(date.year + 1, 1, 1, tzinfo=UTC)
    return date.year + (date - start) / (end - start)
