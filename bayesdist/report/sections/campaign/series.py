"""Linear terms of the exposures against time and roll."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from bayesdist.report.campaign import CampaignResults
from bayesdist.report.contents import REPORT
from bayesdist.report.context import ReportInput, needed
from bayesdist.report.figures.style import CYCLE, INK, WIDTH, guide_lines, legend_above, new_figure
from bayesdist.report.registry import Plot
from bayesdist.report.sections.campaign.terms import (
    TermCourse,
    course_of,
    line_error,
    name_of_term,
    terms_of,
)
from bayesdist.utils.arrays import Float
from bayesdist.utils.numbers import count, display_scale, number, size_of

if TYPE_CHECKING:
    from bayesdist.report.campaign import LinearSeries

ABREAST = 2  # chips in a figure
FALLS = 1.2  # scatter before VAFACTOR over that after it, above which the aberration is seen


def _figures(r: ReportInput) -> Mapping[str, tuple[str, int]]:
    """Names of figures, each with its term and chips."""
    series = needed(needed(r.campaign).series)
    return {
        f"series_{term}" + (f"_{n + 1}" if n else ""): (term, n)
        for term, labels in terms_of(series).items()
        for n in range(-(-len(labels) // ABREAST))
    }


@REPORT.figure("campaign-time", needs=("campaign.series",), each=_figures)
def series(r: ReportInput, which: tuple[str, int]) -> Plot:
    """A term of some chips: as measured, after VAFACTOR with its lines, and without drift.

    Against time, and against PA_V3 where it is known: Figures 14 to 24 of ACS ISR 2015-06.
    """
    campaign, (term, n) = needed(r.campaign), which
    series, unit = needed(campaign.series), campaign.unit
    found = campaign.section("time_dependence")
    labels = terms_of(series)[term][ABREAST * n : ABREAST * (n + 1)]
    courses = [course_of(series, found.get("lines", []), label) for label in labels]
    first = which == next(iter(_figures(r).values()))
    with_roll = bool(np.isfinite(series.pa_v3).any())
    columns = 2 if with_roll else 1
    ratios = ((2.0, 1.0) if with_roll else (2.0,)) * len(courses)
    fig = new_figure(WIDTH, 5.7)
    grid = fig.subplots(3, columns * len(courses), squeeze=False, width_ratios=ratios)
    for k, course in enumerate(courses):
        panels = grid[:, columns * k : columns * (k + 1)]
        _draw_course(panels, series, course, unit)
    legend_above(fig, grid[1, 0], handlelength=1.6)
    length_unit = unit if courses[0].is_constant else ""

    def size(value: float | None) -> str:
        if value is None or not np.isfinite(value):
            return "unknown"
        return size_of(value, length_unit) if length_unit else number(value, 2)

    def each(texts: Sequence[str]) -> str:
        pairs = zip(courses, texts, strict=True)
        return "; ".join(f"{one.chip} {text}" if one.chip else text for one, text in pairs)

    rms = each([f"from {size(one.rms_raw)} to {size(one.rms)}" for one in courses])
    own = each([size(found.get("scatter", {}).get(one.label)) for one in courses])
    verdicts = {row["term"]: row["claim"] for row in found.get("verdicts", ())}
    falls = all(one.rms_raw > FALLS * one.rms for one in courses)
    text = _how_to_read(campaign, with_roll) if first else "As the figure before."
    text += (
        f" With VAFACTOR the scatter about the lines {'falls' if falls else 'hardly changes'}:"
        f" {rms}. Beyond the formal errors the exposures scatter by {own}."
    )
    if all(one.label in verdicts for one in courses):
        text += (
            f" What held-out exposures support: {each([verdicts[one.label] for one in courses])}."
        )
    off = int(series.outlying.sum())
    text += f" Crosses mark {count(off)} outlying exposures." if off else " No exposure lies off."
    if not found.get("converged", True):
        text += " The sampler of the lines did not reach its targets: bands are provisional."
    return Plot(
        fig,
        f"{name_of_term(term)} against time",
        text,
        f"{name_of_term(term)} against time and roll angle; scatter about the lines {rms}.",
    )


def _how_to_read(c: CampaignResults, with_roll: bool) -> str:
    places = ", left against time and right against PA_V3" if with_roll else ""
    g = c.section("gauge")
    gauge = ""
    if g:
        fixed = ", ".join(g["fixed"])
        gauge = f", shifted and turned so that {fixed} of {c.chip_name(g['chip'])} are zero in it"
    return (
        f"Each exposure fitted by itself{gauge}, with formal errors{places}. Top: as measured."
        " Middle:"
        " VAFACTOR applied, with the line of each segment, its 68 % band and the wider one of a"
        " new exposure. Bottom: rate times time since the reference date taken out; steps between"
        " segments stay."
    )


def _draw_course(panels: Any, series: LinearSeries, course: TermCourse, unit: str) -> None:
    factor, name = _scale(course, unit)
    ref = course.reference
    term = course.label.rpartition(".")[2]
    sign = "−" if ref >= 0 else "+"
    ylabel = f"${term}$ {sign} {abs(ref):.10g} [{name}]"
    who = f"{course.chip}, " if course.chip else ""
    states = (
        (course.raw, f"{who}as measured: rms {course.rms_raw * factor:.3g}"),
        (course.value, f"{who}VAFACTOR applied: rms {course.rms * factor:.3g}"),
        (course.value - course.drift, f"{who}drift taken out"),
    )
    for row, (values, title) in zip(panels, states, strict=True):
        y = (values - ref) * factor
        _points(row[0], series, series.epoch, y, course.sigma * factor)
        row[0].set_title(title)
        row[0].set_ylabel(ylabel)
        if len(row) > 1:
            _points(row[1], series, series.pa_v3, y, course.sigma * factor)
            row[1].set_xlim(-8, 368)
            row[1].set_xticks((0, 180, 360))
            row[1].set_ylim(row[0].get_ylim())
            row[1].tick_params(labelleft=False)
        row[0].xaxis.set_major_locator(MaxNLocator(3))
        for ax in row:
            guide_lines(ax)
    _share_limits(panels[0], panels[1])
    _draw_lines(panels[1][0], series, course, ref, factor)
    for ax in panels[2]:
        for s, alpha in enumerate(course.alpha):
            ax.axhline((alpha - ref) * factor, color=CYCLE[s % len(CYCLE)], lw=0.9)
    panels[2][0].set_xlabel("epoch [yr]")
    if len(panels[2]) > 1:
        panels[2][1].set_xlabel("PA_V3 [°]")


def _scale(course: TermCourse, unit: str) -> tuple[float, str]:
    if not course.is_constant:
        return 1e6, "10⁻⁶"
    scale = display_scale(unit, float(np.ptp(course.raw)) or 1.0)
    return scale.factor, scale.unit


def _points(ax: Axes, series: LinearSeries, x: Float, y: Float, sigma: Float) -> None:
    off = series.outlying
    for s in range(len(series.breaks) + 1):
        rows = (series.segment == s) & ~off & np.isfinite(x)
        if not rows.any():
            continue
        color = CYCLE[s % len(CYCLE)]
        ax.errorbar(
            x[rows],
            y[rows],
            sigma[rows],
            fmt="o",
            ms=2.4,
            color=color,
            mec="none",
            elinewidth=0.6,
            alpha=0.8,
            label=_segment_name(series.breaks, s),
        )
    if off.any():
        ax.plot(x[off], y[off], "x", ms=5, color=INK, mew=1.0, label="outlying exposure")


def _segment_name(breaks: tuple[float, ...], s: int) -> str:
    if not breaks:
        return "exposures"
    if s == 0:
        return f"before {breaks[0]:g}"
    if s == len(breaks):
        return f"after {breaks[-1]:g}"
    return f"{breaks[s - 1]:g} to {breaks[s]:g}"


def _share_limits(*rows: Sequence[Axes]) -> None:
    """Give the panels before and after VAFACTOR one range: their scatter is to be compared."""
    limits = [row[0].get_ylim() for row in rows]
    low, high = min(a for a, _ in limits), max(b for _, b in limits)
    for row in rows:
        for ax in row:
            ax.set_ylim(low, high)


def _draw_lines(
    ax: Axes, series: LinearSeries, course: TermCourse, ref: float, factor: float
) -> None:
    """Draw lines of the segments, their 68 % bands, and those of a new exposure."""
    first, last = float(series.epoch.min()), float(series.epoch.max())
    edges = [first, *series.breaks, last]
    for s, (a, b) in enumerate(pairwise(edges)):
        t = np.linspace(a, b, 40)
        line = (course.alpha[s] + course.beta[s] * (t - course.epoch0[s]) - ref) * factor
        color = CYCLE[s % len(CYCLE)]
        for column, alpha, label in (
            (f"sigma_new_{course.label}", 0.13, "68 %, a new exposure"),
            (f"sigma_{course.label}", 0.40, "68 %, the line"),
        ):
            sigma = line_error(series, column, s, t)
            if sigma is not None:
                half = sigma * factor
                ax.fill_between(
                    t, line - half, line + half, color=color, alpha=alpha, lw=0,
                    label=label if s == 0 else None,
                )  # fmt: skip
        ax.plot(t, line, color=color, lw=1.1, zorder=4)
