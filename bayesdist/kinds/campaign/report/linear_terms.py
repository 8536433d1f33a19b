"""Linear terms of the exposures against time and roll: their lines, figures and tables.

Missions supply published lines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
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
from bayesdist.report.texttable import TextTable, listing
from bayesdist.utils.arrays import Bool, Float
from bayesdist.utils.text import (
    MISSING,
    count,
    display_scale,
    interval,
    number,
    rounded,
    size_of,
)

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

Row = tuple[str, ...]

TERMS = ("A_2", "B_3", "B_2", "B_1", "A_3")  # in the order of the tables
_SIGNIFICANT = 3.0  # sigmas
FIXED = 5e-3  # 10^-6, or 10^-3 of a length; a term with a smaller error is held fixed


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


@REPORT.table("campaign-time")
def time_tables(run: ReportedRun) -> Iterator[TextTable]:
    """Tables of the gauge, lines of each term, changes at the breaks, scatter and claims."""
    data = campaign_data(run)
    section, joint = summary_section(run, "time_dependence"), run.summary.get("lines") or []
    names = {chip.number: chip.name for chip in run.model.chips}
    published = published_terms(run.configuration, data.filter, tuple(names.values()))
    if summary_section(run, "gauge"):
        yield _gauge(run)
    terms = dict.fromkeys(row["term"] for row in joint)
    alone = {
        (row["term"], row["segment"]): row
        for row in section.get("lines", ())
        if row["alpha"] is not None
    }
    note = _why_errors_differ(run) if alone else ""
    for term in [t for t in TERMS if t in terms]:
        rows = [row for row in joint if row["term"] == term and _is_free(row, run.model.unit)]
        rows.sort(key=lambda row: (row["segment"], names[row["chip"]]))
        if rows:
            table = _line_table(term, rows, names, alone, published.get(term), run)
            yield replace(table, note=" ".join(text for text in (table.note, note) if text))
            note = ""  # shown once, under the first of them
    if section.get("breaks"):
        yield _changes(section["breaks"], run.model.unit)
    if summary_section(run, "scatter"):
        yield _scatter(run)
    if section.get("verdicts"):
        rows_of = tuple((v["term"], v["claim"], v["text"]) for v in section["verdicts"])
        yield TextTable(
            "Time dependence of each term, selected by held-out exposures",
            ("Term", "Claim", "Why"),
            rows_of,
            words=(0, 1, 2),
            detail=True,
        )


def _gauge(run: ReportedRun) -> TextTable:
    g = summary_section(run, "gauge")
    name = chip_name(run, g["chip"])
    scale = display_scale(run.model.unit, g["sigma_shift"])
    when = "" if g.get("epoch") is None else f" at {g['epoch']:g}"
    shift = ", ".join(
        f"{rounded(s * scale.factor, e * scale.factor)} ± {number(e * scale.factor, 2)}"
        for s, e in zip(g["shift"], g["sigma_shift"], strict=True)
    )
    rotation, sigma = 1e6 * g["rotation"], 1e6 * g["sigma_rotation"]
    fixed = ", ".join(g["fixed"])
    return listing(
        "Gauge of the linear terms against time",
        {
            "Fixed": f"{name} is the reference: {fixed} are zero at its zero point{when}. Other"
            " chips live in its system: gap and rotation between chips are in their coefficients.",
            "Where it holds": "in the tables and figures of this part. The tables of coefficients"
            " further down are in the fit's own gauge, and differ by the shift and rotation below.",
            "Shift by which it was fixed (u, v)": f"{shift} {scale.unit}",
            "Rotation": f"({rounded(rotation, sigma)} ± {number(sigma, 2)})\u202f×\u202f10⁻⁶ rad",
        },
        detail=True,
    )


def _line_table(
    term: str,
    joint: list[Mapping[str, Any]],
    names: Mapping[int, str],
    alone: Mapping[tuple[str, int], Mapping[str, Any]],
    published: Published | None,
    run: ReportedRun,
) -> TextTable:
    """Table of alpha and beta of a term: joint fit, single exposures, and published values."""
    factor, unit = _scale(term, run.model.unit)
    rows_of_term = [
        row for row in (*joint, *alone.values()) if row["term"].rpartition(".")[2] == term
    ]
    # all values of this run have the same digits for comparison; published ones are as printed
    digits = {
        key: min((row[key] for row in rows_of_term if row[key] * factor > FIXED), default=0.0)
        for key in ("sigma_alpha", "sigma_beta")
    }
    lines: tuple[PublishedLine, ...] = ()
    source = cited = ""
    if published is not None:
        lines, source = published.lines, published.source
        cited = f"; published: {source}, {published.where}"
    rows: list[Row] = []
    for row in joint:
        chip = names[row["chip"]]
        head = (chip, f"{row['epoch0']:.1f}")
        rows.append((*head, "joint fit", *_numbers(row, factor, digits)))
        label = f"{chip}.{term}" if len(run.model.chips) > 1 else term
        if (label, row["segment"]) in alone:
            numbers = _numbers(alone[label, row["segment"]], factor, digits)
            rows.append((*head, "exposures, then line", *numbers))
        rows += [
            (*head, source, *_numbers(vars(published_line), factor, vars(published_line)))
            for published_line in lines
            if published_line.chip == chip and abs(published_line.rdate - row["epoch0"]) < 1e-6
        ]
    system = ""
    if summary_section(run, "gauge"):
        system = f", in the system of {chip_name(run, summary_section(run, 'gauge')['chip'])}"
    return TextTable(
        f"{name_of_term(term)}: α + β (TIME − RDATE){system}{cited}",
        ("Chip", "RDATE", "From", "α", f"σ α [{unit}]", f"β [{unit}/yr]", f"σ β [{unit}/yr]"),
        tuple(rows),
        words=(0, 2),
        note=f"{MISSING}: no rate is fitted." if any(MISSING in row for row in rows) else "",
        detail=True,
    )


def _why_errors_differ(run: ReportedRun) -> str:
    """Note on why two fits of the same stars have different errors."""
    data = campaign_data(run)
    n = count(len(data.matching) if data.series is None else len(data.series.exposures))
    return (
        "The two σ of this run may differ, here and in the tables below. An exposure that is fitted"
        " alone frees all of its higher-order terms, and the scatter of a term is that of its"
        f" values in the {n} exposures. The joint fit has one set of higher-order terms for all"
        " exposures, and lets scale and shear scatter independently: X and Y scale then scatter"
        " alike."
    )


def _scale(term: str, unit: str) -> tuple[float, str]:
    """Unit for errors and rates of a term: constant terms are lengths."""
    return (1e3, f"10⁻³ {unit}") if term.endswith("_1") else (1e6, "10⁻⁶")


def _is_free(row: Mapping[str, Any], unit: str) -> bool:
    """True if the data constrain the term; the gauge fixes terms of the reference chip."""
    return bool(row["sigma_alpha"] * _scale(row["term"], unit)[0] > FIXED)


def _numbers(row: Mapping[str, Any], factor: float, digits: Mapping[str, Any]) -> Row:
    beta, sigma = factor * row["beta"], factor * row["sigma_beta"]
    moves = sigma > FIXED
    return (
        rounded(row["alpha"], digits["sigma_alpha"]),
        number(factor * row["sigma_alpha"], 3),
        rounded(beta, factor * digits["sigma_beta"]) if moves else MISSING,
        number(sigma, 3) if moves else MISSING,
    )


def _changes(breaks: list[Mapping[str, Any]], unit: str) -> TextTable:
    rows = tuple(
        (
            f"{row['break']:.2f}",
            str(row["term"]),
            _scale(row["term"], unit)[1],
            *_change(row["term"], row["step"], row["sigma_step"]),
            *_change(row["term"], row["slope_change"], row["sigma_slope_change"]),
        )
        for row in breaks
        if row["step"] is not None
    )
    return TextTable(
        "Changes at the breaks, from the exposures alone",
        ("Break", "Term", "Unit", "Step", "σ", "Step / σ", "Rate, per year", "σ", "Rate / σ"),
        rows,
        words=(1, 2),
        note=f"Beyond {_SIGNIFICANT:g} σ a change is hardly chance.",
        detail=True,
    )


def _change(term: str, value: float, sigma: float) -> Row:
    factor, _ = _scale(term, "")
    v, s = factor * value, factor * sigma
    return rounded(v, s), number(s, 2), number(value / sigma, 2) if sigma > 0 else MISSING


def _scatter(run: ReportedRun) -> TextTable:
    rows: list[Row] = []
    for kind, tau in summary_section(run, "scatter").items():
        factor, unit = (1e3, f"10⁻³ {run.model.unit}") if ".shift_" in f".{kind}" else (1e6, "10⁻⁶")
        low, high = (factor * end for end in tau["interval_68"])
        span = interval(low, high, (high - low) / 2)
        rows.append((name_of_scatter(kind), "joint fit", unit, number(factor * tau["value"]), span))
    n_joint = len(rows)
    for label, value in summary_section(run, "time_dependence").get("scatter", {}).items():
        if value is not None:
            factor, unit = _scale(label, run.model.unit)
            rows.append((label, "exposures alone", unit, number(factor * value), MISSING))
    return TextTable(
        "Scatter of the exposures beyond their formal errors, 1 σ",
        ("Kind", "From", "Unit", "τ", "68 % interval"),
        tuple(rows),
        words=(0, 1, 2),
        leading=n_joint,
    )


@dataclass(frozen=True)
class PublishedLine:
    """A line alpha + beta (TIME - RDATE) with formal errors; beta is 0 for a constant term."""

    chip: str
    rdate: float
    alpha: float
    sigma_alpha: float
    beta: float = 0.0
    sigma_beta: float = 0.0


@dataclass(frozen=True)
class Published:
    """Published lines of one term."""

    source: str  # publication
    where: str  # location in the publication
    lines: tuple[PublishedLine, ...]


Source = Callable[[Mapping[str, Any], str, tuple[str, ...]], Mapping[str, Published]]
_SOURCES: list[Source] = []


def publishes(source: Source) -> Source:
    """Decorator that registers a source of published terms, called like `published_terms`."""
    _SOURCES.append(source)
    return source


def published_terms(
    config: Mapping[str, Any], filter: str, chips: tuple[str, ...]
) -> dict[str, Published]:
    """Published lines for the detector and filter of a run, by term.

    `config`: resolved configuration, which contains instrument and detector. `chips`: names of the
    chips.
    """
    return {k: v for source in _SOURCES for k, v in source(config, filter, chips).items()}
