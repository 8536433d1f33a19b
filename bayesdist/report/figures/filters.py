"""Linear terms of several filters with the common drift taken out: Figures 25 and 26."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from bayesdist.report.figures.style import (
    CYCLE,
    INK,
    WIDTH,
    figure_style,
    guide_lines,
    legend_above,
    new_figure,
)
from bayesdist.utils.arrays import Float

MARKERS = "os^Dvp"


@dataclass(frozen=True, eq=False)
class FilterTerm:
    """Linear term of one filter on one chip, without its drift."""

    filter: str
    chip: str
    epoch: Float  # (E,), of the exposures
    value: Float  # (E,), per pixel
    sigma: Float
    alpha: Float  # (S,), released value of each segment at its reference date
    sigma_alpha: Float


@figure_style()
def filters_figure(term: str, courses: Sequence[FilterTerm], breaks: Sequence[float]) -> Figure:
    """Figure with a panel for each chip: points are exposures, lines the released values.

    `courses` are of all chips and filters, the reference filter first, for a term as 'A_2';
    `breaks` are the dates between which the released values hold.
    """
    by_chip: Mapping[str, list[FilterTerm]] = {
        chip: [c for c in courses if c.chip == chip]
        for chip in dict.fromkeys(c.chip for c in courses)
    }
    filters = list(dict.fromkeys(c.filter for c in courses))
    fig = new_figure(WIDTH, 0.7 + 2.2 * len(by_chip))
    panels = fig.subplots(len(by_chip), 1, sharex=True, squeeze=False)[:, 0]
    for ax, (chip, mine) in zip(panels, by_chip.items(), strict=True):
        reference = round(float(mine[0].alpha[0]), 5)
        for one in mine:
            k = filters.index(one.filter)
            color = CYCLE[k % len(CYCLE)]
            ax.errorbar(
                one.epoch, 1e6 * (one.value - reference), 1e6 * one.sigma,
                fmt=MARKERS[k % len(MARKERS)], ms=3, mec="none", elinewidth=0.6,
                color=color, alpha=0.8, label=one.filter,
            )  # fmt: skip
            edges = (one.epoch.min() - 0.3, *breaks, one.epoch.max() + 0.3)
            for s, (level, error) in enumerate(zip(one.alpha, one.sigma_alpha, strict=True)):
                low, high = sorted((edges[s], edges[s + 1]))
                y = 1e6 * (level - reference)
                ax.plot((low, high), (y, y), color=color, lw=1.0)
                ax.fill_between(
                    (low, high), y - 1e6 * error, y + 1e6 * error,
                    color=color, alpha=0.2, lw=0,
                )  # fmt: skip
        for date in breaks:
            ax.axvline(date, color=INK, lw=0.6, ls=":")
        sign = "−" if reference >= 0 else "+"
        ax.set_ylabel(f"${term}$ {sign} {abs(reference):.10g} [10⁻⁶]")
        ax.set_title(f"{chip}, drift taken out" if chip else "drift taken out")
        guide_lines(ax)
    panels[-1].set_xlabel("epoch [yr]")
    legend_above(fig, panels[0])
    return fig
