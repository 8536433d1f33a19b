"""Report of a run as an HTML page, and the overview page of many runs.

The overview is a sortable table with status, worst margin and validity period.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from markupsafe import Markup

from bayesdist.files.atomic import atomic_path
from bayesdist.report.drawing import Drawing, draw_all
from bayesdist.report.page import PagePart, Picture, numbered, parts_of, template
from bayesdist.report.run import ReportedRun, is_provisional, is_simulated, to_be_drawn
from bayesdist.report.sections import REPORT
from bayesdist.report.sections.status import facts_line, verdict
from bayesdist.report.texttable import Level, moment
from bayesdist.utils.checks import LEVELS
from bayesdist.utils.text import MISSING, count, number

_PROVISIONAL = (
    "The sampler did not reach its targets. Every number below is provisional; those marked † rest"
    " on its draws and may be wrong by more than their stated errors. Sample longer, or look at the"
    " reasons, before anything is used."
)
MOST_NAMED = 4  # largest number of chips that are listed by name
STRIP = ("margins", "uncertainty_radius", "distortion")  # figures at the top of the page
_FOOTER = (
    "u and v are the reference axes; x runs to the right and y up, in FITS"
    " pixels (centre of the first pixel = 1)."
)
_BUDGET_WORDS = (
    "The budget of the table at any position, between two positions of one image, and at any epoch"
    " and magnitude. The bar stacks the variances of the terms; the hatched piece is what the"
    " correlation of the model's parts adds. Where it is negative, the stack is longer than the"
    " total (dark line), and the table gives the root of its size with a minus sign."
)
_PRINT_WORDS = (
    "All tables and figures, and the budget at any position and epoch, are in report.html."
)


def draw_report(run: ReportedRun, *, pdf: bool = False, processes: int = 1) -> dict[str, Drawing]:
    """Draw the figures of the report of a run, by name in its order; `pdf`: also as PDF."""
    drawn = to_be_drawn(run) if processes > 1 else run
    return draw_all(REPORT, drawn, pdf=pdf, processes=processes)


def render_report(run: ReportedRun, drawings: Mapping[str, Drawing]) -> str:
    """Report as a complete, self-contained HTML document.

    Its script computes from numbers embedded in the page; without scripts all tables and figures
    are shown.
    """
    data = {item.name: _embedded(item.made(run)) for item in REPORT.items(run, "data")}
    return template("report.html.jinja").render(
        **_with_strip(_contents(run, drawings)),
        trace=f"{run.title} · {_maker(run)}",
        budget_words=_BUDGET_WORDS,
        print_words=f"{_PRINT_WORDS} {_FOOTER}",
        data=data,
    )


def _embedded(data: Any) -> Markup:
    """Data as JSON that can be embedded in a page: it cannot end the surrounding element."""
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c"))


def write_report(
    path: str | os.PathLike[str], run: ReportedRun, drawings: Mapping[str, Drawing]
) -> None:
    """Write the report as HTML; raises InputError if the file cannot be written."""
    text = render_report(run, drawings)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _with_strip(contents: dict[str, Any]) -> dict[str, Any]:
    """Move the figures of `STRIP` from their sections to the top, and number all figures."""
    top: dict[str, Picture] = {}

    def without(part: PagePart) -> PagePart:
        on_top = tuple(p for p in part.pictures if p.name in STRIP)
        top.update({p.name: p for p in on_top})
        remaining_pictures = tuple(p for p in part.pictures if p.name not in STRIP)
        return replace(part, pictures=remaining_pictures, on_top=on_top)

    parts = [contents["status"], *(without(part) for part in contents["parts"])]
    strip, (status, *remaining_pictures) = numbered(
        [top[name] for name in STRIP if name in top], parts
    )
    return contents | {"strip": strip, "status": status, "parts": remaining_pictures}


def _contents(run: ReportedRun, drawings: Mapping[str, Drawing]) -> dict[str, Any]:
    """Content of the page."""
    parts = parts_of(REPORT, run, drawings)
    status = next(part for part in parts if part.name == "status")
    other_parts: list[PagePart] = [part for part in parts if part is not status]
    return {
        "title": run.title,
        "order": run.model.order,
        "unit": run.model.unit,
        "run": {"provisional": is_provisional(run), "simulated": is_simulated(run)},
        "status": status,
        "parts": other_parts,
        "provisional": _PROVISIONAL,
        "footer": f"Made by {_maker(run)}. {_FOOTER}",
        "chips": _chips(run),
        "verdict": verdict(run),
        "facts": facts_line(run),
    }


def _maker(run: ReportedRun) -> str:
    """Version and time that identify the run of a printed copy, as far as they are known."""
    versions = run.provenance.get("versions", {})
    began = moment(run.provenance.get("created", ""))
    return " ".join(
        part
        for part in (
            "bayesdist",
            str(versions.get("bayesdist", "")),
            f"in a run of {began}" if began else "",
        )
        if part
    )


def _chips(run: ReportedRun) -> str:
    """Names and sizes of the chips, grouped by size."""
    names: dict[str, list[str]] = {}
    for chip in run.model.chips:
        size = "{:g} × {:g}".format(*chip.size)
        names.setdefault(size, []).append(chip.name or f"chip {chip.number}")

    def listed(several: list[str]) -> str:
        if len(several) > MOST_NAMED:
            return f"{len(several)} chips ({several[0]} to {several[-1]})"
        return f"{', '.join(several[:-1])}{' and ' if len(several) > 1 else ''}{several[-1]}"

    return "; ".join(f"{listed(several)}, {size}" for size, several in names.items())


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
