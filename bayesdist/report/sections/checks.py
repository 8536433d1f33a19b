"""Checks as rows of a table."""

from __future__ import annotations

from bayesdist.checks import Check
from bayesdist.numbers import MISSING, number
from bayesdist.report.texttable import Level

__all__ = ["check_cells"]


def check_cells(check: Check) -> tuple[str, str, Level]:
    """Value, limit and outcome, as cells of a table."""
    found = check.value if isinstance(check.value, str) else number(check.value)
    return found, check.limit or MISSING, Level(check.level)
