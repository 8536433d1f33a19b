"""Overview page of many runs: a sortable table with status, worst margin and validity period."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bayesdist.files.atomic import atomic_path
from bayesdist.report.page import template
from bayesdist.report.texttable import Level
from bayesdist.utils.checks import LEVELS
from bayesdist.utils.text import MISSING, count, number


@dataclass(frozen=True)
class OverviewRow:
    """Row of the page for one run; None for results that the run does not have yet."""

    name: str  # folder of the run, as given
    link: str  # to its report, relative to the page; empty if there is none
    detector: str
    simulated: bool
    level: str  # 'pass', 'warn', 'fail', or 'note' if there is no verdict
    headline: str
    worst_margin: float | None  # percent of the limit
    worst_requirement: str
    valid_until: float | None  # decimal year
    open_ended: bool  # True if the validity period lasts at least until then
    epoch: float | None
    uncertainty: str  # largest uncertainty per axis, with its unit
    n_used: int | None
    chi2_per_dof: float | None
    began: str

    @property
    def key(self) -> int:
        """Sort key of the level; the worst one comes first."""
        return -LEVELS.index(self.level)

    @property
    def status(self) -> Level:
        """Level as a table cell."""
        return Level(self.level)

    @property
    def cells(self) -> tuple[tuple[str, bool], ...]:
        """Texts of the cells after the headline, each with True if it is a number."""
        margin = MISSING if self.worst_margin is None else f"{self.worst_margin:.0f}"
        until = MISSING if self.valid_until is None else f"{self.valid_until:.1f}"
        return (
            (margin.replace("-", "−"), True),
            (self.worst_requirement or MISSING, False),
            (f"{until} or later" if self.open_ended else until, True),
            (MISSING if self.epoch is None else f"{self.epoch:.2f}", True),
            (self.uncertainty or MISSING, True),
            (MISSING if self.n_used is None else count(self.n_used), True),
            (number(self.chi2_per_dof), True),
            (self.began[:10] or MISSING, False),
        )


HEADS = (
    ("Worst margin [% of the limit]", True),
    ("Requirement", False),
    ("Valid until [yr]", True),
    ("Judged at [yr]", True),
    ("Largest uncertainty, per axis", True),
    ("Stars used", True),
    ("χ² / dof", True),
    ("Began", False),
)


def write_overview(path: str | os.PathLike[str], rows: Sequence[OverviewRow]) -> list[OverviewRow]:
    """Write the overview page; returns the rows in its order, with the worst runs first."""
    never = math.inf  # sort runs without a margin last
    ordered = sorted(
        rows, key=lambda row: (row.key, never if row.worst_margin is None else row.worst_margin)
    )
    text = template("overview.html.jinja").render(rows=ordered, heads=HEADS)
    with atomic_path(Path(path)) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return ordered
