"""Linear terms of the exposures against time and roll: their lines, names and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from bayesdist.kinds.campaign.report.data import (
    LinearSeries,
    campaign_data,
    chip_name,
    summary_section,
)
from bayesdist.report.contents import REPORT, Plot, needed
from bayesdist.report.figures.style import CYCLE, INK, WIDTH, guide_lines, legend_above, new_figure
from bayesdist.report.run import ReportedRun
from bayesdist.utils.arrays import Bool, Float
from bayesdist.utils.numbers import count, display_scale, number, size_of

TERM_ORDER = ("A_2", "B_3", "B_2", "A_3", "B_1", "A_1")  # as in the published report
_FEWEST = 3  # number of dates in a segment that determine a parabola

_TERMS = {
    "A_1": "A_1 (constant of u)",
    "A_2": "A_2 (X scale)",
    "A_3": "A_3 (angle of the Y axis)",
    "B_1": "B_1 (constant of v)",
    "B_2": "B_2 (residual rotation)",
    "B_3": "B_3 (Y scale)",
}
_SCATTER = {
    "scale": "scale",
    "shear_plus": "shear along the axes (X scale against Y scale)",
    "shear_cross": "shear across the axes (skew)",
    "shift_u": "shift in u",
    "shift_v": "shift in v",
}


def name_of_term(term: str) -> str:
    """Name of a linear term with its meaning, as in Kozhurina-Platais et al. (2015)."""
    return _TERMS.get(term, term)


def name_of_scatter(kind: str) -> str:
    """Name of a term that varies between exposures, with the name of a single chip first."""
    chip, _, bare = kind.rpartition(".")
    text = _SCATTER.get(bare, bare.replace("_", " "))
    return f"{chip} against the others: {text}" if chip else f"all chips together: {text}"


@dataclass(frozen=True, eq=False)
class TermCourse:
    """A term of one chip: its values in the exposures, and the lines fitted to them."""

    label: str  # with the name of the chip, 'WFC1.A_2'
    value: Float  # (E,), corrected for velocity aberration
    sigma: Float  # (E,), formal
    raw: Float  # (E,), as measured, that is multiplied by the factor of aberration
    line: Float  # (E,), line of the exposure's segment at its date
    drift: Float  # (E,), rate times time since the reference date
    alpha: Float  # (S,)
    beta: Float  # (S,)
    epoch0: Float  # (S,)
    good: Bool  # (E,), True for exposures that are not outliers

    @property
    def chip(self) -> str:
        """Name of the chip; empty if there is only one."""
        return self.label.rpartition(".")[0]

    @property
    def reference(self) -> float:
        """Round value close to all values."""
        digits = 3 if self.is_constant else 5
        return round(float(self.alpha[0]), digits)

    @property
    def is_constant(self) -> bool:
        """True for a constant term, in the unit of u and v."""
        return self.label.endswith("_1")

    @property
    def rms_raw(self) -> float:
        """Scatter about the lines before correction for aberration, without its mean."""
        return float(np.std((self.raw - self.line)[self.good]))

    @property
    def rms(self) -> float:
        """Scatter about the lines after correction for aberration."""
        return float(np.std((self.value - self.line)[self.good]))


def terms_of(series: LinearSeries) -> dict[str, tuple[str, ...]]:
    """Labels by term, in the order of the report; chips are ordered as in the file."""
    labels_by_term: dict[str, list[str]] = {}
    for label in series.labels:
        labels_by_term.setdefault(label.rpartition(".")[2], []).append(label)
    order = sorted(labels_by_term, key=lambda t: TERM_ORDER.index(t) if t in TERM_ORDER else 99)
    return {term: tuple(sorted(labels_by_term[term])) for term in order}


def course_of(series: LinearSeries, lines: Sequence[Mapping[str, Any]], label: str) -> TermCourse:
    """Term of the exposures with its lines; `lines`: `time_dependence.lines` of summary.json."""
    rows = sorted(
        (row for row in lines if row["term"] == label), key=lambda row: int(row["segment"])
    )
    alpha, beta, epoch0 = (
        np.array([np.nan if row[k] is None else row[k] for row in rows], float)
        for k in ("alpha", "beta", "epoch0")
    )
    s = np.minimum(series.segment, len(rows) - 1)
    value = np.asarray(series.exposures[label], float)
    drift = beta[s] * (series.epoch - epoch0[s])
    return TermCourse(
        label=label,
        value=value,
        sigma=np.asarray(series.exposures[f"sigma_{label}"], float),
        raw=value * series.vafactor,
        line=alpha[s] + drift,
        drift=drift,
        alpha=alpha,
        beta=beta,
        epoch0=epoch0,
        good=~series.outlying,
    )


def line_error(series: LinearSeries, column: str, s: int, t: Float) -> Float | None:
    """Error of a line, or of a new exposure about it, at dates of segment `s`.

    The square of the error is a parabola through the values of a column of drift.ecsv, which are
    tabulated for some dates; None if too few of these are in the segment.
    """
    epoch = np.asarray(series.drift["epoch"], float)
    in_segment = np.searchsorted(np.asarray(series.breaks, float), epoch, side="right") == s
    if in_segment.sum() < _FEWEST:
        return None
    middle = epoch[in_segment].mean()
    variance = np.asarray(series.drift[column], float)[in_segment] ** 2
    if not np.isfinite(variance).all():
        return None
    unit = variance.max()
    square = unit * np.polyval(
        np.polyfit(epoch[in_segment] - middle, variance / unit, 2), t - middle
    )
    return np.sqrt(np.maximum(square, 0.0))


ABREAST = 2  # number of chips in a figure
FALLS = 1.2  # ratio of the scatter before and after correction, above which aberration is visible


def _figures(run: ReportedRun) -> Mapping[str, tuple[str, int]]:
    """Names of figures, each with its term and the number of its group of chips."""
    series = needed(campaign_data(run).series)
    return {
        f"series_{term}" + (f"_{n + 1}" if n else ""): (term, n)
        for term, labels in terms_of(series).items()
        for n in range(-(-len(labels) // ABREAST))
    }


@REPORT.figure("campaign-time", needs=("report_data.series",), each=_figures)
def series(run: ReportedRun, which: tuple[str, int]) -> Plot:
    """A term of some chips: as measured, without aberration with its lines, and without drift.

    Against time, and against PA_V3 where it is known: Figures 14 to 24 of Kozhurina-Platais et al.
    (2015).
    """
    term, n = which
    series, unit = needed(campaign_data(run).series), run.model.unit
    section = summary_section(run, "time_dependence")
    labels = terms_of(series)[term][ABREAST * n : ABREAST * (n + 1)]
    courses = [course_of(series, section.get("lines", []), label) for label in labels]
    first = which == next(iter(_figures(run).values()))
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
        return "; ".join(f"{course.chip} {text}" if course.chip else text for course, text in pairs)

    rms = each([f"from {size(course.rms_raw)} to {size(course.rms)}" for course in courses])
    exposure_scatter = each(
        [size(section.get("scatter", {}).get(course.label)) for course in courses]
    )
    verdicts = {row["term"]: row["claim"] for row in section.get("verdicts", ())}
    falls = all(course.rms_raw > FALLS * course.rms for course in courses)
    text = _how_to_read(run, with_roll) if first else "As the figure before."
    text += (
        " Without velocity aberration the scatter about the lines"
        f" {'falls' if falls else 'hardly changes'}:"
        f" {rms}. Beyond the formal errors the exposures scatter by {exposure_scatter}."
    )
    if all(c.label in verdicts for c in courses):
        text += f" What held-out exposures support: {each([verdicts[c.label] for c in courses])}."
    off = int(series.outlying.sum())
    text += f" Crosses mark {count(off)} outlying exposures." if off else " No exposure lies off."
    if not section.get("converged", True):
        text += " The sampler of the lines did not reach its targets: bands are provisional."
    return Plot(
        fig,
        f"{name_of_term(term)} against time",
        text,
        f"{name_of_term(term)} against time and roll angle; scatter about the lines {rms}.",
    )


def _how_to_read(run: ReportedRun, with_roll: bool) -> str:
    places = ", left against time and right against PA_V3" if with_roll else ""
    g = summary_section(run, "gauge")
    gauge = ""
    if g:
        fixed = ", ".join(g["fixed"])
        gauge = (
            f", shifted and turned so that {fixed} of {chip_name(run, g['chip'])} are zero in it"
        )
    return (
        f"Each exposure fitted by itself{gauge}, with formal errors{places}. Top: as measured."
        " Middle: velocity aberration taken out, with the line of each segment, its 68 % band and"
        " the wider one of a new exposure. Bottom: rate times time since the reference date"
        " taken out; steps between segments stay."
    )


def _draw_course(panels: Any, series: LinearSeries, course: TermCourse, unit: str) -> None:
    factor, name = _axis_scale(course, unit)
    ref = course.reference
    term = course.label.rpartition(".")[2]
    sign = "−" if ref >= 0 else "+"
    ylabel = f"${term}$ {sign} {abs(ref):.10g} [{name}]"
    who = f"{course.chip}, " if course.chip else ""
    states = (
        (course.raw, f"{who}as measured: rms {course.rms_raw * factor:.3g}"),
        (course.value, f"{who}aberration taken out: rms {course.rms * factor:.3g}"),
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


def _axis_scale(course: TermCourse, unit: str) -> tuple[float, str]:
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
    """Use one range in the panels before and after the correction, to compare their scatter."""
    limits = [row[0].get_ylim() for row in rows]
    low, high = min(a for a, _ in limits), max(b for _, b in limits)
    for row in rows:
        for ax in row:
            ax.set_ylim(low, high)


def _draw_lines(
    ax: Axes, series: LinearSeries, course: TermCourse, ref: float, factor: float
) -> None:
    """Draw the lines of the segments, with 68 % bands for the lines and for a new exposure."""
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
