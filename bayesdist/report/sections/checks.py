"""Checks as rows of a table, and the check for structure in residuals."""

from __future__ import annotations

from collections.abc import Sequence

from bayesdist.diagnose.residuals.misfit import SIGNIFICANT, Misfit, worst_misfit
from bayesdist.report.context import Check
from bayesdist.report.numbers import MISSING, number, percent, probability, size_of
from bayesdist.report.texttable import Level

__all__ = [
    "check_cells",
    "structure_check",
]


def check_cells(check: Check) -> tuple[str, str, Level]:
    """Value, limit and outcome, as cells of a table."""
    found = check.value if isinstance(check.value, str) else number(check.value)
    return found, check.limit or MISSING, Level(check.level)


def structure_check(misfits: Sequence[Misfit], *, fit: str) -> Check:
    """Check for structure that a fit leaves in the residuals of chips, as the banner warns of."""
    worst = worst_misfit(misfits)
    chip = "" if worst.chip is None else f" of {worst.chip.name}"
    size = size_of(worst.structure, worst.unit, 2)
    found = f"{size} rms in {worst.partition}{chip}" if worst.structure > 0 else "none"
    if worst.told < 1:
        found += f" ({percent(worst.told, 2)} of all patterns can be told from places of stars)"
    return Check(
        f"Structure in the residuals of {fit}, beyond noise",
        f"{found}, {probability(worst.p_value)}",
        f"p at least {number(SIGNIFICANT, 1)}",
        "warn" if worst.significant or worst.hidden else "pass",
    )
