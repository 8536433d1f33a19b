"""Requirements: where each statistic lies against its limit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from numpy.typing import NDArray

from bayesdist.report.numbers import display_scale
from bayesdist.report.style import INK, LEVEL_COLORS, WIDTH, figure_style, new_figure

if TYPE_CHECKING:
    from bayesdist.assess import Margin

__all__ = ["VERDICT_LEVELS", "margins_against_limits"]

Float = NDArray[np.float64]

VERDICT_LEVELS = {"met": "pass", "undecided": "warn", "missed": "fail"}
_SHOWN = (0.001, 0.999)  # quantiles of the draws that a histogram runs between
_MARKERS = {"met": "o", "undecided": "D", "missed": "X"}  # shape as well as colour


def margins_against_limits(margins: Sequence[Margin]) -> Figure:
    """Each requirement's statistic in units of its own limit: its draws and their central 95 %.

    Parameters
    ----------
    margins : sequence of Margin

    Returns
    -------
    matplotlib.figure.Figure
    """
    with figure_style():
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
            ax.plot(
                m.value / limit, k, _MARKERS[m.verdict], ms=8, color=color, mec="white", zorder=4
            )
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
    return fig


def _ridge(ax: Axes, k: int, values: Float, color: str) -> None:
    """Histogram of the draws, standing on row k."""
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
    return (
        f"{m.verdict}: {m.value * scale.factor:.3g} of {limit}\n"
        f"P(≤ limit) = {m.probability_met:.3g}, asked {m.requirement.probability:.3g}"
    )
