"""Figures of commands: orders, differences between calibrations and filters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bayesdist.report.figures.arrows import Arrows, vector_map
from bayesdist.report.figures.panels import ChipPanels
from bayesdist.report.figures.style import (
    COLORBAR,
    CYCLE,
    INK,
    PALETTE,
    WIDTH,
    figure_style,
    guide_lines,
    legend_above,
    new_figure,
    nice_below,
)
from bayesdist.report.run import Mosaic
from bayesdist.utils.arrays import Float
from bayesdist.utils.distributions import chi2_ppf, chi2_sf, norm_isf
from bayesdist.utils.text import display_scale, size_of

if TYPE_CHECKING:
    from bayesdist.assess.comparison.compare import Comparison
    from bayesdist.infer.compare.order import OrderSelection


LEVELS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
# from white to a blue on which black arrows are visible
_SHADES = LinearSegmentedColormap.from_list("significance", ["#FFFFFF", PALETTE["sky"]])


def gaussian_sigmas(chi2: Float) -> Float:
    """Two-sided Gaussian significance (sigma) of a chi-square with two degrees of freedom.

    NaN remains NaN; values are limited to 37, where probabilities underflow.
    """
    p = np.clip(chi2_sf(chi2, 2), 1e-300, 1.0)
    return np.asarray(norm_isf(p / 2))


@figure_style()
def difference_vectors(
    found: Sequence[Comparison], *, names: tuple[str, str] = ("A", "B")
) -> Figure:
    """Draw arrows of A minus B, over shades of the significance at each position.

    Chips are drawn one above the other at the same scale; without shades if no covariance is known.
    """
    mosaic = Mosaic(
        tuple((float(c.x.max()), float(c.y.max())) for c in found),
        tuple(f"chip {c.a.chip}" for c in found),
        tuple((k, 0) for k in range(len(found))),
    )
    chips = [Arrows.of_grid(c.x, c.y, c.du, c.dv) for c in found]
    shaded = all(c.chi2 is not None for c in found)
    largest = max(c.largest for c in found)
    M = 1.0
    if largest > 1e-12:
        M = nice_below(1.5 * min(arrows.step for arrows in chips) / largest)
    panels = ChipPanels(mosaic, colorbar=shaded)
    panels.frame(M * largest + 0.02 * mosaic.longest_side)
    titles = [
        panels.title(
            k, f"{names[0]} minus {names[1]}: rms {size_of(c.rms)}, largest {size_of(c.largest)}"
        )
        for k, c in enumerate(found)
    ]
    key = nice_below(largest / 1.5)
    vector_map(panels, chips, titles, magnification=M, key=key, pad=20)
    for c, (ax,) in zip(found, panels.axes, strict=True):
        if not shaded or c.chi2 is None:
            continue
        sigmas = gaussian_sigmas(c.chi2)
        shades = ax.contourf(c.x, c.y, sigmas, LEVELS, cmap=_SHADES, extend="max", zorder=1)
    if shaded:
        panels.figure.colorbar(
            shades,
            ax=panels.all_axes,
            label="significance of each position [σ]",
            **COLORBAR,
        )
    return panels.figure


@figure_style()
def change_over_time(first: Float, gain: Float, dof: int, p_value: float | None) -> Figure:
    """Draw the chi-square gain of a change at each possible first date (P,), in decimal years.

    `dof`: degrees of freedom of a change. `p_value`: probability of the largest gain by chance,
    accounting for the search over dates.
    """
    first, gain = np.asarray(first, float), np.asarray(gain, float)
    low, high = chi2_ppf([0.025, 0.975], dof)
    fig = new_figure(WIDTH, 2.8)
    ax = fig.subplots()
    ax.axhspan(low, high, color=PALETTE["sky"], alpha=0.3, lw=0, zorder=0)
    ax.plot(first, gain, "o-", ms=4, color=PALETTE["blue"])
    best = int(gain.argmax())
    ax.plot(first[best], gain[best], "o", ms=9, mfc="none", mec=PALETTE["vermilion"], mew=1.3)
    ax.set_ylim(0, 1.1 * max(float(gain.max()), float(high)))
    ax.set_xlabel("a change from this date on [yr]")
    ax.set_ylabel(f"chi-square it takes up ({dof} d.o.f.)")
    note = ""
    if p_value is not None:
        p = "p < 1e-12" if p_value < 1e-12 else f"p = {p_value:.2g}"
        note = f"; {p} for the largest of {len(gain)}"
    ax.set_title(f"band: where 95 % of single dates lie by chance{note}")
    return fig


MARKERS = "os^Dvp"


@dataclass(frozen=True, eq=False)
class FilterTerm:
    """Linear term of one filter on one chip, without its drift."""

    filter: str
    chip: str
    epoch: Float  # (E,), epochs of the exposures
    value: Float  # (E,), per pixel
    sigma: Float
    alpha: Float  # (S,), released value of each segment at its reference date
    sigma_alpha: Float


@figure_style()
def filters_figure(term: str, courses: Sequence[FilterTerm], breaks: Sequence[float]) -> Figure:
    """Draw a panel for each chip: points are exposures, lines the released values.

    `courses`: terms of all chips and filters, the reference filter first. `term`: name of the term,
    such as 'A_2'. `breaks`: dates that separate the segments of the released values.
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
        for course in mine:
            k = filters.index(course.filter)
            color = CYCLE[k % len(CYCLE)]
            ax.errorbar(
                course.epoch, 1e6 * (course.value - reference), 1e6 * course.sigma,
                fmt=MARKERS[k % len(MARKERS)], ms=3, mec="none", elinewidth=0.6,
                color=color, alpha=0.8, label=course.filter,
            )  # fmt: skip
            edges = (course.epoch.min() - 0.3, *breaks, course.epoch.max() + 0.3)
            for s, (level, error) in enumerate(zip(course.alpha, course.sigma_alpha, strict=True)):
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


_NEAR = 10.0  # log density below which the scale of the right-hand panel is linear
_APART = 0.12  # distance between markers of one order, in units of an order


@figure_style()
def order_comparison(found: OrderSelection) -> Figure:
    """Draw binned surfaces on the left, held-out stars and regions on the right."""
    fig = new_figure(WIDTH, 3.1)
    left_panel, right = fig.subplots(1, 2)
    _surfaces(left_panel, found)
    _held_out(right, found)
    for ax in (left_panel, right):
        ax.axvspan(found.order - 0.35, found.order + 0.35, color="#E8ECF0", zorder=0)
        ax.set_xlabel("order of the polynomial (chosen one shaded)")
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        ax.set_xlim(found.orders[0] - 0.6, found.orders[-1] + 0.6)
    return fig


def _surfaces(ax: Axes, found: OrderSelection) -> None:
    s = found.surfaces
    scale = display_scale(found.unit, s.rms.ravel())
    for axis, (name, color, mark) in enumerate(
        (("u", PALETTE["blue"], "o"), ("v", PALETTE["vermilion"], "s"))
    ):
        ax.plot(s.orders, s.rms[:, axis] * scale.factor, f"{mark}-", ms=4, color=color, label=name)
        noise = float(s.noise[axis]) * scale.factor
        ax.axhline(noise, ls=":", lw=1.0, color=color, label=f"noise of the means, {name}")
    ax.set_yscale("log")
    ax.set_ylabel(f"rms of {s.n_bins} bins after the surface [{scale.unit}]")
    ax.set_title("Binned surfaces")
    ax.legend()


def _held_out(ax: Axes, found: OrderSelection) -> None:
    rows = found.rows()
    stars = [(row["stars"] or 0.0, row["stars_error"] or 0.0) for row in rows]
    regions = [(row["regions"] or 0.0, row["regions_error"] or 0.0) for row in rows]
    for k, (key, pairs, color, mark) in enumerate(
        (("stars", stars, PALETTE["blue"], "o"), ("regions", regions, PALETTE["orange"], "D"))
    ):
        value, error = np.transpose(pairs)
        x = np.array(found.orders) + (2 * k - 1) * _APART
        ax.errorbar(x, value, error, fmt=mark, ms=4, lw=1.0, color=color, label=key)
    ax.axhline(0.0, lw=0.7, color="#9AA5B1", zorder=1)
    ax.set_yscale("symlog", linthresh=_NEAR)
    ax.set_ylabel(f"log density minus that of order {found.order}")
    ax.set_title("Held out (1 σ)")
    ax.legend()
