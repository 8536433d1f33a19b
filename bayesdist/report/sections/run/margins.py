"""Requirements: verdicts, each statistic against its limit, and validity periods."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from bayesdist.report.contents import REPORT, Plot
from bayesdist.report.context import ReportInput
from bayesdist.report.figures.style import (
    CYCLE,
    INK,
    LEVEL_COLORS,
    PALETTE,
    WIDTH,
    new_figure,
)
from bayesdist.report.sections.gauge import gauge_of_new_exposure
from bayesdist.report.texttable import TextTable, tabulated
from bayesdist.utils.arrays import Float
from bayesdist.utils.numbers import (
    count,
    counted,
    display_scale,
    interval,
    number,
    percent,
    rounded,
)

if TYPE_CHECKING:
    from bayesdist.assess import Margin

VERDICT_LEVELS = {"met": "pass", "undecided": "warn", "missed": "fail"}
_SHOWN = (0.001, 0.999)  # quantiles of the draws that a histogram runs between
_MARKERS = {"met": "o", "undecided": "D", "missed": "X"}  # shape as well as colour


@REPORT.table("margins", needs=("margins",))
def margin_table(r: ReportInput) -> TextTable:
    """Table of requirements and their verdicts."""
    out = []
    for m in r.margins:
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
        chip = next((c.chip.name for c in r.chips if c.chip.number == asked.chip), "")
        on = f" on {chip}" if chip and r.several else ""
        scope = f" {asked.scope}" if asked.scope else ""
        statistic = f"{asked.statistic}{scope}{on}{epoch} at most {asked.limit:g} {asked.unit}"
        out.append(
            {
                "Name": asked.name,
                "Requirement": f"{statistic}, with probability {asked.probability:g}",
                **{key: r.marked(text) for key, text in cells.items()},
                "Unit": m.unit,
                "Verdict": _judgement(m, r.several),
            }
        )
    return tabulated(
        "Margins",
        out,
        words=(0, 1, 6, 7),
        stacked=(7,),
        note="Margin: the limit minus the value that the statistic stays under with the probability"
        f" asked for. {gauge_of_new_exposure(r)}".rstrip(),
    )


def _judgement(m: Margin, several: bool) -> str:
    """Words on verdict, reason, position of the largest error, and remedy."""
    on = f" of chip {m.worst.chip}" if several else ""
    out = [
        f"{m.verdict}: {m.reason}" if m.reason else m.verdict,
        f"largest at ({m.worst.x:.0f}, {m.worst.y:.0f}){on}:"
        f" {number(m.worst.rms, 2)} {m.unit} radial rms",
    ]
    return "; ".join(out + ([] if m.remedy is None else [m.remedy.sentence]))


@REPORT.table("margins", needs=("margins",))
def rests_on_table(r: ReportInput) -> TextTable | None:
    """Table of the assumptions and measurements behind the verdicts."""
    clauses: dict[str, list[str]] = {}
    for m in r.margins:
        for clause in m.rests_on:
            clauses.setdefault(clause, []).append(m.requirement.name)
    if not clauses:
        return None
    every = len(r.margins)
    rows = tuple(
        (clause, "all" if len(of) == every else ", ".join(of)) for clause, of in clauses.items()
    )
    return TextTable("Basis of the verdicts", ("Basis", "Requirements"), rows, words=(0, 1))


@REPORT.figure("margins", needs=("margins",), printed=True)
def margins(r: ReportInput) -> Plot:
    """Each requirement's statistic in units of its own limit: its draws and their central 95 %."""
    margins = r.margins
    fig = new_figure(WIDTH, 0.9 + 0.62 * len(margins))
    ax = fig.subplots()
    ends = []
    for k, m in enumerate(margins):
        limit = m.requirement.limit
        values = m.draws / limit
        color = LEVEL_COLORS[VERDICT_LEVELS[m.verdict]]
        _ridge(ax, k, values, color)
        low, high = (end / limit for end in m.interval)
        ends += [low, high, *np.quantile(values, _SHOWN)]
        ax.plot([low, high], [k, k], color=color, lw=2.5, solid_capstyle="butt", zorder=3)
        ax.plot(m.value / limit, k, _MARKERS[m.verdict], ms=8, color=color, mec="white", zorder=4)
        ax.annotate(
            _statement(m),
            (1.02, k),
            xycoords=ax.get_yaxis_transform(),
            va="center",
            fontsize=7.5,
            annotation_clip=False,
        )
    ax.axvline(1.0, color=INK, lw=1.2, zorder=2)
    low, high = min([*ends, 1.0]), max([*ends, 1.0])
    if low > 0 and high / low > 10:
        ax.set_xscale("log")
        ax.set_xlim(low / 1.4, high * 1.4)
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        ax.xaxis.set_minor_locator(NullLocator())
    else:
        ax.set_xlim(0, high * 1.08)
    ax.set_ylim(len(margins) - 0.5, -0.75)
    ax.set_yticks(range(len(margins)), [_label(m) for m in margins])
    ax.set_xlabel("statistic / limit [no unit]; the limit is the line at 1")
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(axis="y", length=0)
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


def _ridge(ax: Axes, k: int, values: Float, color: str) -> None:
    """Draw a histogram of the draws, standing on row k."""
    low, high = np.quantile(values, _SHOWN)
    counts, edges = np.histogram(values, bins=40, range=(low, high if high > low else low + 1e-9))
    top = k - 0.6 * counts / max(counts.max(), 1)
    ax.stairs(top, edges, baseline=k, fill=True, color=color, alpha=0.3, zorder=1)


def _label(m: Margin) -> str:
    r = m.requirement
    epoch = "" if m.epoch is None else f", {m.epoch:.6g}"
    chip = "" if r.chip is None else f", chip {r.chip}"
    return f"{r.name}\n{r.statistic}{epoch}{chip}"


def _statement(m: Margin) -> str:
    scale = display_scale(m.unit, m.requirement.limit)
    limit = scale.text(m.requirement.limit)
    met = counted(m.probability_met, m.mc_error, m.n_effective)
    return (
        f"{m.verdict}: {number(m.value * scale.factor)} of {limit}\n"
        f"P(≤ limit): {met}, asked {m.requirement.probability:.3g}"
    )


@REPORT.figure("margins", needs=("validity",), printed=True)
def validity_period(r: ReportInput) -> Plot:
    """Probability of meeting each requirement against time, and when it becomes too low."""
    periods = r.validity
    fig = new_figure(WIDTH, 0.7 + 1.5 * len(periods))
    panels = fig.subplots(len(periods), 1, sharex=True, squeeze=False)[:, 0]
    for ax, one in zip(panels, periods, strict=True):
        asked = one.requirement.probability
        ax.fill_between(one.epoch, one.low, one.high, color=CYCLE[0], alpha=0.25, lw=0)
        ax.plot(one.epoch, one.probability, color=CYCLE[0])
        ax.axhline(asked, color=INK, lw=0.8, ls="--")
        ax.annotate(
            f"asked: {asked:g}",
            (1.0, asked),
            xycoords=ax.get_yaxis_transform(),
            xytext=(3, 0),
            textcoords="offset points",
            va="center",
            fontsize=7.5,
        )
        if one.date is not None:
            early, late = one.interval
            ax.axvspan(
                one.epoch[0] if early is None else early,
                one.epoch[-1] if late is None else late,
                color=PALETTE["vermilion"],
                alpha=0.2,
                lw=0,
            )
            ax.axvline(one.date, color=PALETTE["vermilion"])
        ax.set_ylim(-0.03, 1.03)
        ax.set_xlim(one.epoch[0], one.epoch[-1])
        ax.set_ylabel("P(met) [no unit]")
        ax.set_title(one.sentence)
    panels[-1].set_xlabel("epoch [yr]")
    return Plot(
        fig,
        "How long the requirements are met",
        "Probability of meeting each limit as the drift is extrapolated from the last data; the"
        " band is the 95 % interval of counting draws, red the date (with its interval) at which"
        " the probability falls below what is asked. This assumes that the drift continues as"
        " modelled; a change of its rate is not included.",
        " ".join(f"{one.sentence}." for one in periods),
    )
