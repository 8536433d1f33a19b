"""Short summary of a run, as HTML for notebooks and as plain text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from textwrap import fill
from typing import TYPE_CHECKING

from bayesdist.assess.maps import per_axis
from bayesdist.assess.requirements.verdict import VERDICT_LEVELS
from bayesdist.utils.text import (
    MISSING,
    counted,
    interval,
    length_scale,
    number,
    percent,
    rounded,
    with_mas,
)

if TYPE_CHECKING:
    from bayesdist.assess import ErrorBudget, Margin

Row = Mapping[str, str]  # cells by heading

MAX_ROWS = 12  # of a table; the report contains all rows
MAX_WARNINGS = 8
WIDTH = 88  # characters of a line of text
MARKS = {"pass": "✓", "warn": "!", "fail": "✗", "note": "·"}
# visible on white and on black, and distinguishable with any colour blindness
COLORS = {"pass": "#009E73", "warn": "#E69F00", "fail": "#D55E00", "note": "#888888"}

# transparent, because the notebook may be light or dark: no background or text colour is set
_PLAIN = "background:none;color:inherit"
_RULE = "1px solid rgba(128,128,128,0.4)"


@dataclass(frozen=True)
class RunSummary:
    """Content of the representation of a run.

    Parameters
    ----------
    title : str
        Name of the calibration.
    verdict_level : str
        'pass', 'warn', 'fail' or 'note'.
    headline : str
        The verdict in words.
    warnings : sequence of str
        Sentences that a reader of the numbers must know.
    facts : sequence of (str, str)
        Labels and values, such as the numbers of stars and exposures, and convergence.
    margins_rows, budget_rows : sequence of dict of str to str
        Rows of the tables as cells by heading, with the same headings in each row; see
        `margin_rows` and `budget_rows`.
    """

    title: str
    verdict_level: str
    headline: str
    warnings: Sequence[str] = ()
    facts: Sequence[tuple[str, str]] = ()
    margins_rows: Sequence[Row] = ()
    budget_rows: Sequence[Row] = ()

    @property
    def tables(self) -> tuple[tuple[str, Sequence[Row]], ...]:
        """Captions and rows of the tables that are not empty."""
        tables = (("Margins", self.margins_rows), ("Error budget", self.budget_rows))
        return tuple((caption, rows) for caption, rows in tables if rows)


# -- rows of the tables ---------------------------------------------------------------------------


def margin_rows(margins: Sequence[Margin]) -> list[dict[str, str]]:
    """Rows of the table of margins: requirement, value with its interval, P(met) and verdict.

    Parameters
    ----------
    margins : sequence of Margin
    """
    rows = []
    for m in margins:
        asked, spread = m.requirement, (m.interval[1] - m.interval[0]) / 4
        scope = f" {asked.scope}" if asked.scope else ""
        chip = "" if asked.chip is None else f", chip {asked.chip}"
        epoch = "" if m.epoch is None else f", {m.epoch:.2f}"
        rows.append(
            {
                "Requirement": asked.name,
                "Limit": f"{asked.statistic}{scope}{chip}{epoch} ≤ {asked.limit:g} {asked.unit}",
                "Value": rounded(m.value, spread),
                "95 %": interval(m.interval[0], m.interval[1], spread),
                "P(met)": counted(m.probability_met, m.mc_error, m.n_effective),
                "Verdict": m.verdict,
            }
        )
    return rows


def budget_rows(budget: ErrorBudget, *, scale_mas: float | None = None) -> list[dict[str, str]]:
    """Rows of the budget table: rms per axis of each term over the detector, the total last.

    Parameters
    ----------
    budget : ErrorBudget
    scale_mas : float, optional
        Size of a pixel in mas; if given, a column in mas is added to a budget in pixels.
    """
    terms = budget.rows()
    sizes = [float(per_axis(row["u"], row["v"])) for row in terms]
    scale = length_scale(budget.unit, sizes[-1])
    rows = []
    for term, size in zip(terms, sizes, strict=True):
        error, radial = term["radial_error"], float(term["radial"])
        row = {
            "Term": str(term["name"]),
            "Kind": str(term["kind"]),
            f"Per axis [{scale.unit}]": number(size * scale.factor),
        }
        if scale_mas is not None and budget.unit == "pix":
            row["As an angle"] = with_mas(size * scale_mas, "mas", None, like=sizes[-1] * scale_mas)
        row["Relative uncertainty"] = (
            MISSING if error is None or not radial > 0 else percent(error / radial, 2)
        )
        rows.append(row)
    return rows


# -- HTML -----------------------------------------------------------------------------------------


def summary_html(summary: RunSummary) -> str:
    """HTML block of a run for a notebook: verdict, warnings, facts, margins, budget.

    It has no script and no style sheet, inherits the colours of the page, light or dark, and
    escapes all text. Long tables are cut, with a line that states the number of omitted rows.

    Parameters
    ----------
    summary : RunSummary

    Returns
    -------
    str

    Examples
    --------
    >>> html = summary_html(RunSummary("camera", "fail", "Missed: p95 < 0.02 pix"))
    >>> "p95 &lt; 0.02 pix" in html
    True
    """
    level = summary.verdict_level if summary.verdict_level in COLORS else "note"
    parts = [
        f'<div style="border-left:4px solid {COLORS[level]};padding:2px 12px;margin:4px 0">',
        f'<div style="font-size:1.1em"><b>{_text(summary.title)}</b></div>',
        f'<div><b style="color:{COLORS[level]}">{MARKS[level]}</b> '
        f"<b>{_text(summary.headline)}</b></div>",
    ]
    warnings, hidden = _cut(summary.warnings, MAX_WARNINGS)
    if warnings:
        items = [f"<li>{_text(warning)}</li>" for warning in warnings]
        if hidden:
            items.append(f"<li>{_text(_more(hidden, 'warning'))}</li>")
        parts.append(f'<ul style="margin:4px 0;padding-left:18px">{"".join(items)}</ul>')
    if summary.facts:
        facts = " · ".join(f"{_text(name)}: <b>{_text(value)}</b>" for name, value in summary.facts)
        parts.append(f'<div style="margin:4px 0">{facts}</div>')
    parts += [_table(caption, rows) for caption, rows in summary.tables]
    return "\n".join([*parts, "</div>"])


def _table(caption: str, rows: Sequence[Row]) -> str:
    shown, hidden = _shown(rows)
    words = _columns_of_words(shown)
    head = "".join(_cell(name, name in words, head=True) for name in shown[0])
    body = ["".join(_cell(cell, name in words) for name, cell in row.items()) for row in shown]
    lines = [f'<tr style="{_PLAIN}">{cells}</tr>' for cells in body]
    if hidden:
        note = f'<td colspan="{len(shown[0])}" style="text-align:left">'
        lines.insert(-1, f'<tr style="{_PLAIN}">{note}{_text(_more(hidden, "row"))}</td></tr>')
    return (
        f'<table style="{_PLAIN};border-collapse:collapse;margin:6px 0">'
        f'<caption style="caption-side:top;text-align:left;color:inherit"><b>{_text(caption)}</b>'
        f'</caption><thead><tr style="{_PLAIN}">{head}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table>"
    )


def _cell(text: str, is_words: bool, *, head: bool = False) -> str:
    align = "left" if is_words else "right"
    style = f"text-align:{align};padding:1px 10px 1px 0;border:none;border-bottom:{_RULE}"
    if head:
        return f'<th scope="col" style="{style}">{_text(text)}</th>'
    level = VERDICT_LEVELS.get(text)
    if level is None:
        return f'<td style="{style}">{_text(text)}</td>'
    mark = f'<b style="color:{COLORS[level]}">{MARKS[level]}</b> '
    return f'<td style="{style}">{mark}{_text(text)}</td>'


def _text(text: str) -> str:
    return escape(str(text), quote=True)


# -- plain text -----------------------------------------------------------------------------------


def summary_text(summary: RunSummary) -> str:
    """Plain text of a run with the same content as `summary_html`.

    Parameters
    ----------
    summary : RunSummary

    Returns
    -------
    str

    Examples
    --------
    >>> print(summary_text(RunSummary("camera", "warn", "Undecided", facts=[("stars", "500")])))
    camera
    ! Undecided
    stars: 500
    """
    mark = MARKS.get(summary.verdict_level, MARKS["note"])
    lines = [summary.title, _wrapped(summary.headline, f"{mark} ")]
    warnings, hidden = _cut(summary.warnings, MAX_WARNINGS)
    lines += [_wrapped(warning, "  - ") for warning in warnings]
    if hidden:
        lines.append(f"  - {_more(hidden, 'warning')}")
    if summary.facts:
        lines.append(_wrapped("; ".join(f"{name}: {value}" for name, value in summary.facts), ""))
    for caption, rows in summary.tables:
        lines += ["", caption, *_text_table(rows)]
    return "\n".join(lines)


def _text_table(rows: Sequence[Row]) -> list[str]:
    shown, hidden = _shown(rows)
    words = _columns_of_words(shown)
    names = list(shown[0])
    widths = {name: max(len(name), *(len(row[name]) for row in shown)) for name in names}

    def line(cells: Mapping[str, str]) -> str:
        padded = [
            cells[name].ljust(widths[name]) if name in words else cells[name].rjust(widths[name])
            for name in names
        ]
        return ("  " + "  ".join(padded)).rstrip()

    lines = [line({name: name for name in names}), *(line(row) for row in shown)]
    if hidden:
        lines.insert(-1, f"  {_more(hidden, 'row')}")
    return lines


def _wrapped(text: str, first: str) -> str:
    return fill(text, WIDTH, initial_indent=first, subsequent_indent=" " * len(first))


# -- HTML and plain text --------------------------------------------------------------------------


def _cut(items: Sequence[str], most: int) -> tuple[Sequence[str], int]:
    """First items, and the number of omitted ones."""
    return (items, 0) if len(items) <= most else (items[: most - 1], len(items) - most + 1)


def _shown(rows: Sequence[Row]) -> tuple[list[Row], int]:
    """First rows and the last one, which may be a total, and the number of omitted rows."""
    if len(rows) <= MAX_ROWS:
        return list(rows), 0
    return [*rows[: MAX_ROWS - 2], rows[-1]], len(rows) - MAX_ROWS + 1


def _columns_of_words(rows: Sequence[Row]) -> set[str]:
    """Headings of the columns with at least one cell that is neither a number nor missing."""

    def numeric(cell: str) -> bool:
        return cell == MISSING or cell.lstrip("−-+<>≤≥~ \u202f")[:1].isdigit()

    return {name for name in rows[0] if not all(numeric(row[name]) for row in rows)}


def _more(n: int, noun: str) -> str:
    return f"… {n} more {noun}{'s' if n > 1 else ''} in the report"
