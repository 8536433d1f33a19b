"""Error budget and requirements: terms and their maps, verdicts, margins, validity periods."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.patches import Patch

from bayesdist.assess.maps import circular_error
from bayesdist.assess.terms.forms import PRODUCT
from bayesdist.report.contents import REPORT, Plot, needed
from bayesdist.report.figures.fields import Grid, scalar_map
from bayesdist.report.figures.panels import ChipPanels
from bayesdist.report.figures.style import CYCLE, WIDTH, new_figure
from bayesdist.report.plots.errors import (
    budget_handles,
    largest_error,
    plot_budget,
    plot_margins,
    plot_validity,
    row_per_axis,
)
from bayesdist.report.run import (
    ReportedRun,
    has_several_chips,
    length_text,
    marked,
    mosaic_of,
    on_focal_plane,
    scale_mas,
)
from bayesdist.report.texttable import TextTable, tabulated
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import (
    MISSING,
    Scale,
    count,
    counted,
    interval,
    length_scale,
    number,
    percent,
    rounded,
    with_mas,
)

if TYPE_CHECKING:
    from bayesdist.assess import Margin
    from bayesdist.assess.budget import BudgetTerm, ErrorBudget

AS_ABOVE = "as above"  # in rows of single chips
_LETTERS = 31  # of a label next to another one, above a narrow figure
_MOST_PANELS = 3  # chips with a panel in addition to that of the detector


@REPORT.table("budget")
def budget_table(run: ReportedRun) -> tuple[TextTable, ...]:
    """Table of the error budget, the total last; correlated parts of the model are folded."""
    budget = run.evaluation.budget
    if budget.model is None:
        return (_table(run, budget, budget),)
    parts = {term.name for term in budget.terms if term.of_parameters}
    jointly = replace(budget, terms=_jointly(budget))
    alone = replace(budget, terms=tuple(t for t in budget.terms if t.name in parts), products=())
    folded = _table(run, budget, alone, names=parts)
    return (
        *_by_chip(run, _table(run, budget, jointly)),
        replace(
            folded,
            caption="Parts of the model: their errors are correlated and enter the total jointly",
            note="",
            folded=True,
            detail=True,
        ),
    )


def _by_chip(run: ReportedRun, table: TextTable) -> tuple[TextTable, ...]:
    """The table, with the rows of single chips folded if they are many."""
    if len(run.model.chips) <= _MOST_PANELS:
        return (table,)
    single = replace(table, rows=table.rows[table.leading :], folded=True, detail=True, note="")
    return (
        replace(table, rows=table.rows[: table.leading]),
        replace(single, caption="Error budget of single chips", leading=0),
    )


def _jointly(budget: ErrorBudget) -> tuple[BudgetTerm, ...]:
    """Terms of a budget, with those of the model's parameters combined into the first one."""
    return (needed(budget.model), *(t for t in budget.terms if not t.of_parameters))


def _table(
    run: ReportedRun, budget: ErrorBudget, shown: ErrorBudget, names: Collection[str] = ()
) -> TextTable:
    """Table of terms of a budget; `names`: terms to show, or empty for all."""
    unit, mas = budget.unit, scale_mas(run)
    chips = {str(chip.number): chip.name for chip in run.model.chips} | {"all": "all"}
    together = [row for row in shown.rows() if not names or row["name"] in names]
    rows: Sequence[Mapping[str, Any]] = together
    if has_several_chips(run):
        rows = [row for row in shown.rows_by_chip() if not names or row["name"] in names]
    typical = row_per_axis(budget.rows()[-1])
    scale = length_scale(unit, typical)
    out = [
        (
            str(row["name"]),
            *((chips[str(row["chip"])],) if has_several_chips(run) else ()),
            str(row["kind"]),
            AS_ABOVE if str(row.get("chip", "all")) != "all" else str(row["source"]) or MISSING,
            *(marked(run, text) for text in _sizes(row, scale, mas, typical)),
            _relative_uncertainty(row),
        )
        for row in rows
    ]
    of_chip = ("Chip",) if has_several_chips(run) else ()
    lengths = [f"{name} [{scale.unit}]" for name in ("u", "v", "Per axis", "CE68", "CE95")]
    heads = ("Term", *of_chip, "Kind", "Source", *lengths, "Relative uncertainty")
    epoch = budget.epoch
    when = "" if epoch is None else f" at epoch {epoch:.2f}"
    return TextTable(
        f"Error budget{when}: rms over the detector, 1 σ",
        heads,
        tuple(out),
        words=tuple(range(len(heads) - 6)),
        leading=len(together),  # rows of all chips together
        stacked=(heads.index(lengths[2]),),
        note="Per axis: rms of u and v; CE68, CE95: circles that hold 68 and 95 % of errors of that"
        " size, if Gaussian. The parts of the model are correlated and enter the total jointly, by"
        " draws; independent terms add in quadrature. The total therefore need not be the root"
        f" of the sum of squares.{_of_products(rows)} {run.kind.words.new_exposure}".rstrip()
        + _focal_plane(run),
    )


def _focal_plane(run: ReportedRun) -> str:
    """Sentence on the size of a milliarcsecond on the focal plane, if the plate scale is known."""
    size = on_focal_plane(run, 1.0, "mas").strip(" ()")
    return f" On the focal plane 1\u202fmas is {size}." if size else ""


def _sizes(
    row: Mapping[str, Any], scale: Scale, mas: float | None, typical: float
) -> tuple[str, ...]:
    """Errors of u, of v, per axis (also in mas), CE68 and CE95, rms over the detector."""
    u, v = float(row["u"]), float(row["v"])
    circles = (float(circular_error(u, v, 0.0, p)) for p in (0.68, 0.95))
    sizes = [number(scale.factor * size) for size in (u, v, row_per_axis(row), *circles)]
    if mas is not None and scale.unit == "pix":
        angle = with_mas(row_per_axis(row) * mas, "mas", None, like=typical * mas)
        sizes[2] += f" ({angle})"
    return tuple(sizes)


def _relative_uncertainty(row: Mapping[str, Any]) -> str:
    """Relative uncertainty of the size of a term, as text."""
    error, size = row["radial_error"], float(row["radial"])
    if error is None or not size > 0:
        return MISSING
    return "exact" if error == 0 else percent(error / size, 2)


def _of_products(rows: Sequence[Mapping[str, Any]]) -> str:
    if all(row["kind"] != PRODUCT for row in rows):
        return ""
    return (
        " Rows of kind product say what a file differs by from the solution, the same in every"
        " draw: they come on top, in quadrature, for the users of that file, and are in no total."
    )


@REPORT.figure("budget")
def budget_terms(run: ReportedRun) -> Plot:
    """Bars of each term's rms per axis over the detector, with its two axes marked.

    Each of up to three chips has a panel next to that of the whole detector.
    """
    budget = run.evaluation.budget
    rows = budget.rows()
    parts = {"all chips": rows}
    if 1 < len(budget.chips) <= _MOST_PANELS:
        parts |= {n: b.rows() for n, b in zip(mosaic_of(run).names, budget.chips, strict=True)}
    largest = largest_error(list(parts.values()))
    fig = new_figure(WIDTH, (1.1 if len(parts) == 1 else 1.3) + 0.34 * len(rows))
    axes = fig.subplots(1, len(parts), sharey=True, squeeze=False)[0]
    shown = [budget, *budget.chips][: len(parts)]
    for ax, (name, part) in zip(axes, zip(parts, shown, strict=True), strict=True):
        over = "the detector" if len(parts) == 1 else name
        plot_budget(part, ax, largest=largest, over=over, names=ax is axes[0], legend=False)
        if len(parts) > 1:  # the number next to a bar needs more of a narrow panel
            ax.set_xlim(0, ax.get_xlim()[1] * (1.12 + 0.12 * len(parts)) / 1.2)
    handles = budget_handles(axes[0], rows)
    fig.legend(handles=handles, loc="outside upper left", ncols=len(handles))
    *terms, total = (row for row in rows if row["kind"] != PRODUCT)
    top = max(terms, key=row_per_axis)
    return Plot(
        fig,
        "Error budget by term",
        f"The largest term is {top['name']}, {length_text(run, row_per_axis(top))}, of a total of"
        f" {length_text(run, row_per_axis(total))} (rms over the detector, per axis).",
        f"Bars of the budget's terms; the largest is {top['name']}.",
    )


@REPORT.figure("budget", when=lambda run: int(np.count_nonzero(run.evaluation.budget.share)) > 1)
def budget_dominating(run: ReportedRun) -> Plot:
    """Map of the term that contributes most at each position, if it is not the same everywhere."""
    budget = run.evaluation.budget
    share = budget.share
    present = np.flatnonzero(share)
    colors = [CYCLE[k % len(CYCLE)] for k in range(len(present))]
    panels = ChipPanels(mosaic_of(run))
    panels.frame()

    def numbered(dominant: Float) -> Float:
        """Numbers among the terms that are present; NaN off the field of the detector."""
        return np.where(np.isfinite(dominant), np.searchsorted(present, dominant), np.nan)

    scalar_map(
        panels,
        [Grid(*b.axes, numbered(b.on_grid(b.dominant))) for b in budget.chips],
        mosaic_of(run).names,
        norm=BoundaryNorm(np.arange(len(present) + 1) - 0.5, len(present)),
        cmap=ListedColormap(colors),
    )
    handles = [
        Patch(color=c, label=f"{name if len(name) <= 40 else name[:39] + '…'} ({part:.0f} %)")
        for c, name, part in zip(
            colors, (budget.names[k] for k in present), 100 * share[present], strict=True
        )
    ]
    longest = max(len(str(handle.get_label())) for handle in handles)
    narrow = panels.figure.get_figwidth() < WIDTH
    columns = 1 if narrow and longest > _LETTERS else 2
    panels.figure.legend(handles=handles, loc="outside upper left", ncols=columns)
    top = int(share.argmax())
    return Plot(
        panels.figure,
        "Dominant term",
        f"Term that is largest at each position: {budget.names[top]} on"
        f" {percent(share[top], 2)} of the grid. A better calibration helps only where a term of"
        " the model leads.",
        f"Map of the dominant term, mostly {budget.names[top]}.",
    )


@REPORT.table("margins", needs=("evaluation.margins",))
def margin_table(run: ReportedRun) -> TextTable:
    """Table of requirements and their verdicts."""
    out = []
    for m in run.evaluation.margins:
        asked = m.requirement
        spread = (m.interval[1] - m.interval[0]) / 4
        cells = {
            "Value": rounded(m.value, spread),
            "95 % interval": interval(m.interval[0], m.interval[1], spread),
            "Margin": f"{rounded(m.margin, spread)} ({percent(m.percent / 100, 2)})",
            "P(met)": counted(m.probability_met, m.mc_error, m.n_effective),
        }
        epoch = "" if m.epoch is None else f" at {m.epoch:.2f}"
        if asked.epochs is not None:
            epoch = f" from {asked.epochs[0]:.2f} to {asked.epochs[1]:.2f}, worst{epoch}"
        chip = next((c.name for c in run.model.chips if c.number == asked.chip), "")
        on = f" on {chip}" if chip and has_several_chips(run) else ""
        scope = f" {asked.scope}" if asked.scope else ""
        statistic = f"{asked.statistic}{scope}{on}{epoch} at most {asked.limit:g} {asked.unit}"
        out.append(
            {
                "Name": asked.name,
                "Requirement": f"{statistic}, with probability {asked.probability:g}",
                **{key: marked(run, text) for key, text in cells.items()},
                "Unit": m.unit,
                "Verdict": _judgement(m, has_several_chips(run)),
            }
        )
    return tabulated(
        "Margins",
        out,
        words=(0, 1, 6, 7),
        stacked=(7,),
        note="Margin: the limit minus the value that the statistic stays under with the probability"
        f" asked for. {run.kind.words.new_exposure}".rstrip(),
    )


def _judgement(m: Margin, several: bool) -> str:
    """Sentence on verdict, reason, position of the largest error, and remedy."""
    on = f" of chip {m.worst.chip}" if several else ""
    out = [
        f"{m.verdict}: {m.reason}" if m.reason else m.verdict,
        f"largest at ({m.worst.x:.0f}, {m.worst.y:.0f}){on}:"
        f" {number(m.worst.rms, 2)} {m.unit} radial rms",
    ]
    return "; ".join(out + ([] if m.remedy is None else [m.remedy.sentence]))


@REPORT.table("margins", needs=("evaluation.margins",))
def rests_on_table(run: ReportedRun) -> TextTable | None:
    """Table of the assumptions and measurements on which the verdicts are based."""
    clauses: dict[str, list[str]] = {}
    for m in run.evaluation.margins:
        for clause in m.rests_on:
            clauses.setdefault(clause, []).append(m.requirement.name)
    if not clauses:
        return None
    n_margins = len(run.evaluation.margins)
    rows = tuple(
        (clause, "all" if len(of) == n_margins else ", ".join(of)) for clause, of in clauses.items()
    )
    return TextTable("Basis of the verdicts", ("Basis", "Requirements"), rows, words=(0, 1))


@REPORT.figure("margins", needs=("evaluation.margins",), printed=True)
def margins(run: ReportedRun) -> Plot:
    """Each requirement's statistic in units of its own limit: its draws and their central 95 %."""
    margins = run.evaluation.margins
    fig = new_figure(WIDTH, 0.9 + 0.62 * len(margins))
    plot_margins(margins, fig.subplots())
    met = sum(m.verdict == "met" for m in margins)
    verb = "is" if 1 in (met, len(margins)) else "are"
    return Plot(
        fig,
        "Margins",
        "Each statistic as a fraction of its limit: histogram of the draws, bar of their central"
        f" 95 %, marker at the median; left of the line is within the limit. {count(met)} of"
        f" {count(len(margins))} {verb} met with the probability asked for.",
        f"Requirements against their limits; {met} of {len(margins)} {verb} met.",
    )


@REPORT.figure("margins", needs=("evaluation.validity",), printed=True)
def validity_period(run: ReportedRun) -> Plot:
    """Probability of meeting each requirement against time, and when it becomes too low."""
    periods = run.evaluation.validity
    fig = new_figure(WIDTH, 0.7 + 1.5 * len(periods))
    panels = fig.subplots(len(periods), 1, sharex=True, squeeze=False)[:, 0]
    for ax, period in zip(panels, periods, strict=True):
        plot_validity(period, ax)
        ax.label_outer()
    return Plot(
        fig,
        "How long the requirements are met",
        "Probability of meeting each limit as the drift is extrapolated from the last data; the"
        " band is the 95 % interval of counting draws, red the date (with its interval) at which"
        " the probability falls below what is asked. This assumes that the drift continues as"
        " modelled; a change of its rate is not included.",
        " ".join(f"{period.sentence}." for period in periods),
    )
