"""Linear terms of the exposures against time and roll: Figures 14-24 of ACS ISR 2015-06."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayesdist.report.numbers import display_scale
from bayesdist.report.style import CYCLE, INK, WIDTH, figure_style, new_figure

if TYPE_CHECKING:
    from bayesdist.report.campaign.context import LinearSeries

__all__ = ["ABREAST", "TERM_ORDER", "TermCourse", "course_of", "series_figure", "terms_of"]

Float = NDArray[np.float64]

TERM_ORDER = ("A_2", "B_3", "B_2", "A_3", "B_1", "A_1")  # as the report treats them
ABREAST = 2  # chips in a figure
_FEWEST = 3  # dates in a segment that fix a parabola


@dataclass(frozen=True, eq=False)
class TermCourse:
    """One term of one chip: what the exposures show, and the lines through it.

    Parameters
    ----------
    label : str
        With the chip's name, 'WFC1.A_2'.
    value, sigma : ndarray, shape (E,)
        Free of aberration, and its formal error.
    raw : ndarray, shape (E,)
        As measured: times VAFACTOR.
    line : ndarray, shape (E,)
        The line of the exposure's segment at its date.
    drift : ndarray, shape (E,)
        What of it is rate times time since the reference date.
    alpha : ndarray, shape (S,)
    beta, epoch0 : ndarray, shape (S,)
    good : ndarray of bool, shape (E,)
        Exposures that do not lie off.
    """

    label: str
    value: Float
    sigma: Float
    raw: Float
    line: Float
    drift: Float
    alpha: Float
    beta: Float
    epoch0: Float
    good: NDArray[np.bool_]

    @property
    def chip(self) -> str:
        """Name of the chip; empty where there is one only."""
        return self.label.rpartition(".")[0]

    @property
    def reference(self) -> float:
        """A round value near all of them."""
        digits = 3 if self.is_constant else 5
        return round(float(self.alpha[0]), digits)

    @property
    def is_constant(self) -> bool:
        """Whether it is a constant term, in the unit of u and v."""
        return self.label.endswith("_1")

    @property
    def rms_raw(self) -> float:
        """Scatter about the lines before VAFACTOR, its mean taken out."""
        return float(np.std((self.raw - self.line)[self.good]))

    @property
    def rms(self) -> float:
        """Scatter about the lines after VAFACTOR."""
        return float(np.std((self.value - self.line)[self.good]))


def terms_of(series: LinearSeries) -> dict[str, tuple[str, ...]]:
    """Labels by term, in the order of the report; chips as the file has them, by name."""
    found: dict[str, list[str]] = {}
    for label in series.labels:
        found.setdefault(label.rpartition(".")[2], []).append(label)
    order = sorted(found, key=lambda t: TERM_ORDER.index(t) if t in TERM_ORDER else 99)
    return {term: tuple(sorted(found[term])) for term in order}


def course_of(series: LinearSeries, lines: Sequence[Mapping[str, Any]], label: str) -> TermCourse:
    """A term of the exposures with its lines.

    Parameters
    ----------
    series : LinearSeries
    lines : sequence of mapping
        `time_dependence.lines` of summary.json.
    label : str

    Returns
    -------
    TermCourse
    """
    rows = sorted((r for r in lines if r["term"] == label), key=lambda r: int(r["segment"]))
    alpha, beta, epoch0 = (
        np.array([np.nan if r[k] is None else r[k] for r in rows], float)
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


def series_figure(series: LinearSeries, courses: Sequence[TermCourse], *, unit: str) -> Figure:
    """A term of one or two chips: as measured, after VAFACTOR with its lines, and without drift.

    Against time, and against PA_V3 where it is known.

    Parameters
    ----------
    series : LinearSeries
    courses : sequence of TermCourse
        Of the same term.
    unit : str
        Of u and v.

    Returns
    -------
    matplotlib.figure.Figure
    """
    with_roll = bool(np.isfinite(series.pa_v3).any())
    beside = 2 if with_roll else 1
    ratios = ((2.0, 1.0) if with_roll else (2.0,)) * len(courses)
    with figure_style():
        fig = new_figure(WIDTH, 5.7)
        grid = fig.subplots(3, beside * len(courses), squeeze=False, width_ratios=ratios)
        for k, course in enumerate(courses):
            panels = grid[:, beside * k : beside * (k + 1)]
            _draw_course(panels, series, course, unit)
        handles, labels = grid[1, 0].get_legend_handles_labels()
        fig.legend(handles, labels, loc="outside upper left", ncols=len(labels), handlelength=1.6)
    return fig


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
        for ax in row:
            ax.grid(True, lw=0.4, color="#E3E8ED")
            ax.set_axisbelow(True)
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
    """The same range for the panels before and after VAFACTOR: their scatter is to be compared."""
    limits = [row[0].get_ylim() for row in rows]
    low, high = min(a for a, _ in limits), max(b for _, b in limits)
    for row in rows:
        for ax in row:
            ax.set_ylim(low, high)


def _draw_lines(
    ax: Axes, series: LinearSeries, course: TermCourse, ref: float, factor: float
) -> None:
    """Lines of the segments, their 68 % bands, and those of a new exposure."""
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
            sigma = _band(series, column, s, t)
            if sigma is not None:
                half = sigma * factor
                ax.fill_between(
                    t, line - half, line + half, color=color, alpha=alpha, lw=0,
                    label=label if s == 0 else None,
                )  # fmt: skip
        ax.plot(t, line, color=color, lw=1.1, zorder=4)


def _band(series: LinearSeries, column: str, s: int, t: Float) -> Float | None:
    """An error at any date of a segment: of a line, its square is a parabola in time."""
    epoch = np.asarray(series.drift["epoch"], float)
    here = np.searchsorted(np.asarray(series.breaks, float), epoch, side="right") == s
    if here.sum() < _FEWEST:
        return None
    middle = epoch[here].mean()
    variance = np.asarray(series.drift[column], float)[here] ** 2
    if not np.isfinite(variance).all():
        return None
    unit = variance.max()
    square = unit * np.polyval(np.polyfit(epoch[here] - middle, variance / unit, 2), t - middle)
    return np.sqrt(np.maximum(square, 0.0))
