"""Plots of the error budget, of margins relative to requirements, and of validity periods."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from bayesdist.assess.maps import per_axis
from bayesdist.assess.requirements.verdict import VERDICT_LEVELS
from bayesdist.assess.terms.forms import PRODUCT
from bayesdist.errors import InputError
from bayesdist.report.figures.style import (
    CYCLE,
    INK,
    LEVEL_COLORS,
    OUTLINE,
    PALETTE,
    Tones,
    small_font,
)
from bayesdist.report.plots.axes import axes_of, scale_of, set_title
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import Scale, counted, display_scale, number

if TYPE_CHECKING:
    from bayesdist.assess import ErrorBudget, Margin
    from bayesdist.assess.requirements.margins import ValidityPeriod

SHOWN_QUANTILES = (0.001, 0.999)  # quantiles of the draws that limit a histogram
# shapes in addition to colours
MARKERS = {"met": "o", "not shown": "s", "undecided": "D", "missed": "X"}
KIND_COLORS = {
    "random": PALETTE["sky"],
    "systematic": PALETTE["blue"],
    "local": PALETTE["green"],
    PRODUCT: OUTLINE,
}
# style of the markers of u and v: yellow with a dark edge is visible on bars of all colours
MARKER_STYLE: dict[str, Any] = {
    "ms": 5.5,
    "color": PALETTE["yellow"],
    "mec": INK,
    "mew": 0.7,
    "zorder": 4,
}
AXIS_MARKERS = {"u": ("o", -0.15), "v": ("s", 0.15)}  # with a shift, as u and v are often equal
LETTERS_PER_LINE = 26  # of the name of a term

Row = Mapping[str, Any]  # row of `ErrorBudget.rows`

# -- budget ---------------------------------------------------------------------------------------


def plot_budget(
    budget: ErrorBudget,
    ax: Axes | None = None,
    *,
    chip: int | None = None,
    scale_mas: float | None = None,
    largest: float | None = None,
    over: str | None = None,
    names: bool = True,
    legend: bool = True,
) -> Axes:
    """Plot the terms of an error budget as bars, the total last.

    Bars are the rms per axis over all positions of the budget; markers show u and v separately.

    Parameters
    ----------
    budget : ErrorBudget
    ax : matplotlib.axes.Axes, optional
        By default the axes of a new figure.
    chip : int, optional
        Number of the chip to show; all chips together by default.
    scale_mas : float, optional
        Size of a pixel in mas; if given, errors in pixels are shown in mas.
    largest : float, optional
        Largest error on the axis in the unit of the budget, to give several plots the same scale;
        that of the largest term by default.
    over : str, optional
        Area over which the rms is computed, for the label of the axis.
    names : bool
        True to show the names of the terms next to the axes.
    legend : bool
        True to show a legend above the axes.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    InputError
        If the budget does not have the chip, or `ax` is not a single Axes.

    Examples
    --------
    >>> chip = bd.Chip(1, "camera", (2048, 2048), (1024.5, 1024.5))
    >>> model, rng = bd.DistortionModel(1, (chip,), "pix"), np.random.default_rng(1)
    >>> truth = [0, 1000, 0, 0, 0, 1000]
    >>> stars, _ = bd.simulate_matches(model, truth, 500, sigma=0.01, rng=rng)
    >>> fit = bd.fit_linear(stars, model)
    >>> budget = bd.error_budget(fit, grid=(5, 3), n_draws=100, rng=rng)
    >>> ax = plot_budget(budget, Figure().subplots())
    >>> [label.get_text() for label in ax.get_yticklabels()][-1]
    'total'
    """
    rows = (budget if chip is None else _on_chip(budget, chip)).rows()
    ax = axes_of(ax, height=1.6 + 0.42 * len(rows))
    end = largest_error([rows]) if largest is None else largest
    scale = scale_of(budget.unit, end, scale_mas)
    _bars(ax, rows, scale)
    # room for the number next to the longest bar
    ax.set_xlim(0, 1.2 * end * scale.factor or 1.0)
    area = over or ("the detector" if chip is None else f"chip {chip}")
    ax.set_xlabel(f"rms over {area} [{scale.unit}]")
    labels = [fill(str(row["name"]), LETTERS_PER_LINE) for row in rows] if names else None
    ax.set_yticks(np.arange(len(rows)), labels)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    if legend:
        handles = budget_handles(ax, rows)
        place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0)}
        ax.legend(handles=handles, ncols=2, frameon=False, **place)
    return ax


def is_total(row: Row) -> bool:
    """True if a row of `ErrorBudget.rows` is the total."""
    return bool(row["kind"] == "total")


def row_per_axis(row: Row) -> float:
    """Error per axis of a row of `ErrorBudget.rows`."""
    return float(per_axis(row["u"], row["v"]))


def largest_error(parts: Sequence[Sequence[Row]]) -> float:
    """Largest error along u or v in the rows of some budgets."""
    return max(max(float(row["u"]), float(row["v"])) for rows in parts for row in rows)


def budget_handles(ax: Axes, rows: Sequence[Row]) -> list[Artist]:
    """Entries of the legend: kinds of terms, the total, and the markers of u and v."""
    present = {row["kind"] for row in rows if not is_total(row)}
    handles: list[Artist] = [
        Patch(color=color, label=f"{kind}, per axis")
        for kind, color in KIND_COLORS.items()
        if kind in present
    ]
    handles.append(Patch(color=Tones.of(ax).ink, label="total, per axis"))
    for axis, (marker, _) in AXIS_MARKERS.items():
        look: dict[str, Any] = {"marker": marker, "ls": "none", "label": f"{axis} alone"}
        handles.append(Line2D([], [], **look, **MARKER_STYLE))
    return handles


def _on_chip(budget: ErrorBudget, chip: int) -> ErrorBudget:
    numbers = list(budget.domain.chips)
    if chip not in numbers:
        raise InputError(
            f"the budget has no chip {chip}",
            where="chip",
            do=f"give one of {', '.join(map(str, numbers))}",
        )
    return budget.chips[numbers.index(chip)]


def _bars(ax: Axes, rows: Sequence[Row], scale: Scale) -> None:
    place = np.arange(len(rows))
    sizes = np.array([row_per_axis(row) for row in rows]) * scale.factor
    total = Tones.of(ax).ink
    colors = [total if is_total(r) else KIND_COLORS.get(str(r["kind"]), OUTLINE) for r in rows]
    ax.barh(place, sizes, height=0.62, color=colors, zorder=2)
    for axis, (marker, shift) in AXIS_MARKERS.items():
        values = np.array([row[axis] for row in rows], float) * scale.factor
        ax.plot(values, place + shift, marker, **MARKER_STYLE)
    # numbers are placed beyond the bar and its markers
    ends = np.array([max(float(row["u"]), float(row["v"])) for row in rows]) * scale.factor
    for k, (value, end) in enumerate(zip(sizes, ends, strict=True)):
        text = ax.annotate(number(value), (end, k), (6, 0), textcoords="offset points")
        text.set(va="center", color=total)
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(axis="y", length=0)


# -- requirements ---------------------------------------------------------------------------------


def plot_margins(margins: Sequence[Margin], ax: Axes | None = None) -> Axes:
    """Plot requirements: each statistic in units of its limit, which is the line at 1.

    Each row has a histogram of the draws, a bar of their central 95 %, a marker at the median, and
    the verdict in words. Shape and colour of the marker also show the verdict.

    Parameters
    ----------
    margins : sequence of Margin
        Result of `check_requirements`.
    ax : matplotlib.axes.Axes, optional
        By default the axes of a new figure.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    InputError
        If there is no margin, or `ax` is not a single Axes.

    Examples
    --------
    >>> chip = bd.Chip(1, "camera", (2048, 2048), (1024.5, 1024.5))
    >>> model, rng = bd.DistortionModel(1, (chip,), "pix"), np.random.default_rng(1)
    >>> truth = [0, 1000, 0, 0, 0, 1000]
    >>> stars, _ = bd.simulate_matches(model, truth, 500, sigma=0.01, rng=rng)
    >>> fit = bd.fit_linear(stars, model)
    >>> needs = [bd.Requirement("field-wide", "p95", 1.0), bd.Requirement("corner", "max", 2.0)]
    >>> margins = bd.check_requirements(fit, needs, grid=(5, 3), n_draws=400, rng=rng)
    >>> ax = plot_margins(margins, Figure().subplots())
    >>> len(ax.get_yticks())
    2
    """
    if not margins:
        raise InputError("there is no margin", where="margins", do="state a requirement")
    ax = axes_of(ax)
    tones, ends = Tones.of(ax), [1.0]
    for k, m in enumerate(margins):
        limit = m.requirement.limit
        values = m.draws / limit
        color = LEVEL_COLORS[VERDICT_LEVELS[m.verdict]]
        _ridge(ax, k, values, color)
        low, high = (end / limit for end in m.interval)
        ends += [low, high, *np.quantile(values, SHOWN_QUANTILES)]
        ax.plot([low, high], [k, k], color=color, lw=2.5, solid_capstyle="butt", zorder=3)
        look: dict[str, Any] = {"ms": 8, "color": color, "mec": tones.paper, "zorder": 4}
        ax.plot(m.value / limit, k, MARKERS[m.verdict], **look)
        ax.annotate(
            _statement(m),
            (1.02, k),
            xycoords=ax.get_yaxis_transform(),
            va="center",
            fontsize=small_font(),
            color=tones.ink,
            annotation_clip=False,
        )
    ax.axvline(1.0, color=tones.ink, lw=1.2, zorder=2)
    low, high = min(ends), max(ends)
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
    return ax


def _ridge(ax: Axes, k: int, values: Float, color: str) -> None:
    """Draw a histogram of the draws above row k."""
    low, high = np.quantile(values, SHOWN_QUANTILES)
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


def plot_validity(
    period: ValidityPeriod, ax: Axes | None = None, *, title: str | None = None
) -> Axes:
    """Plot the probability of meeting a requirement against time.

    The band is the 95 % interval of a probability counted in draws. A red line with a band for its
    interval is the date at which the probability falls below the required one.

    Parameters
    ----------
    period : ValidityPeriod
    ax : matplotlib.axes.Axes, optional
        By default the axes of a new figure.
    title : str, optional
        By default the date in a sentence; an empty string for no title.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    InputError
        If `ax` is not a single Axes.
    """
    ax = axes_of(ax)
    ink, asked = Tones.of(ax).ink, period.requirement.probability
    ax.fill_between(period.epoch, period.low, period.high, color=CYCLE[0], alpha=0.25, lw=0)
    ax.plot(period.epoch, period.probability, color=CYCLE[0])
    ax.axhline(asked, color=ink, lw=0.8, ls="--")
    ax.annotate(
        f"asked: {asked:g}",
        (1.0, asked),
        xycoords=ax.get_yaxis_transform(),
        xytext=(3, 0),
        textcoords="offset points",
        va="center",
        fontsize=small_font(),
        color=ink,
    )
    if period.date is not None:
        early, late = period.interval
        ax.axvspan(
            period.epoch[0] if early is None else early,
            period.epoch[-1] if late is None else late,
            color=PALETTE["vermilion"],
            alpha=0.2,
            lw=0,
        )
        ax.axvline(period.date, color=PALETTE["vermilion"])
    ax.set_ylim(-0.03, 1.03)
    ax.set_xlim(period.epoch[0], period.epoch[-1])
    ax.set_ylabel("P(met) [no unit]")
    ax.set_xlabel("epoch [yr]")
    ax.ticklabel_format(axis="x", useOffset=False)
    set_title(ax, title, period.sentence)
    return ax
