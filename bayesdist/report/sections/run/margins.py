"""Requirements: verdicts, statistics relative to limits, and validity periods."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bayesdist.report.contents import REPORT, Plot
from bayesdist.report.figures.style import WIDTH, new_figure
from bayesdist.report.plots.errors import plot_margins, plot_validity
from bayesdist.report.run import ReportedRun, has_several_chips, marked
from bayesdist.report.texttable import TextTable, tabulated
from bayesdist.utils.text import (
    count,
    counted,
    interval,
    number,
    percent,
    rounded,
)

if TYPE_CHECKING:
    from bayesdist.assess import Margin


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
