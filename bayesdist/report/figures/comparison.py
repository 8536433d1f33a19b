"""Difference of two calibrations: over the detector, shaded by significance, and against time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from bayesdist.report.figures.arrows import Arrows, vector_map
from bayesdist.report.figures.mosaic import Mosaic
from bayesdist.report.figures.panels import ChipPanels
from bayesdist.report.figures.style import (
    COLORBAR,
    PALETTE,
    WIDTH,
    figure_style,
    new_figure,
    nice_below,
)
from bayesdist.utils.arrays import Float
from bayesdist.utils.distributions import chi2_ppf, chi2_sf, norm_isf
from bayesdist.utils.numbers import size_of

if TYPE_CHECKING:
    from bayesdist.assess.comparison.compare import Comparison

LEVELS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
# from white to a blue on which black arrows are still seen
_SHADES = LinearSegmentedColormap.from_list("significance", ["#FFFFFF", PALETTE["sky"]])


def gaussian_sigmas(chi2: Float) -> Float:
    """Sigmas of one axis that are as improbable as a chi-square of two axes.

    NaN stays NaN; not above 37, where probabilities underflow.
    """
    p = np.clip(chi2_sf(chi2, 2), 1e-300, 1.0)
    return np.asarray(norm_isf(p / 2))


@figure_style()
def difference_vectors(
    found: Sequence[Comparison], *, names: tuple[str, str] = ("A", "B")
) -> Figure:
    """Arrows of A minus B, over shades of the significance of each by itself.

    One chip is drawn above the other, on one scale; without shades where no covariance is known.
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
        M = nice_below(1.5 * min(one.step for one in chips) / largest)
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
            label="significance of each position separately [σ]",
            **COLORBAR,
        )
    return panels.figure


@figure_style()
def change_over_time(first: Float, gain: Float, dof: int, p_value: float | None) -> Figure:
    """Figure of the chi-square gains of a change from each first date (P,), in decimal years.

    `dof` is that of a change, `p_value` that of the largest, the search over the dates accounted
    for.
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
