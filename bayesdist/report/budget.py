"""The error budget: how much each term gives, and where which one is largest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from bayesdist.assess.product_terms import PRODUCT
from bayesdist.report.mosaic import Mosaic
from bayesdist.report.numbers import display_scale
from bayesdist.report.style import (
    CYCLE,
    INK,
    PALETTE,
    WIDTH,
    figure_style,
    new_figure,
)
from bayesdist.report.vectors import grid_size

if TYPE_CHECKING:
    from bayesdist.assess.detector_budget import DetectorBudget

__all__ = ["budget_terms", "dominating_term", "is_total"]

_MOST_PANELS = 3  # chips whose bars stand beside those of the detector
_KIND_COLORS = {
    "random": PALETTE["sky"],
    "systematic": PALETTE["blue"],
    "local": PALETTE["green"],
    PRODUCT: "#9AA5B1",
}
# one above the other, as both axes are often equal
_AXIS_MARKERS = {"u": ("o", -0.15), "v": ("s", 0.15)}
_MARKER_STYLE = {"ms": 5.5, "color": PALETTE["yellow"], "mec": INK, "mew": 0.7, "zorder": 4}


def is_total(row: Mapping[str, str | float]) -> bool:
    """Whether a row of `ErrorBudget.rows` is the sum of the others."""
    return row["kind"] == "total"


def budget_terms(budget: DetectorBudget, names: Sequence[str] = ()) -> Figure:
    """Bars of each term's radial rms over the detector, with its two axes marked.

    Parameters
    ----------
    budget : DetectorBudget
    names : sequence of str
        Of the chips.  Each of up to three chips has a panel beside that of the whole detector.

    Returns
    -------
    matplotlib.figure.Figure
    """
    rows = budget.rows()
    parts = {"all chips": rows}
    if 1 < len(budget.chips) <= _MOST_PANELS:
        parts |= {n: b.rows() for n, b in zip(names, budget.chips, strict=True)}
    largest = max(float(r["radial"]) for part in parts.values() for r in part)
    scale = display_scale(budget.unit, largest)
    with figure_style():
        fig = new_figure(WIDTH, (1.1 if len(parts) == 1 else 1.3) + 0.34 * len(rows))
        axes = fig.subplots(1, len(parts), sharey=True, squeeze=False)[0]
        for ax, (name, part) in zip(axes, parts.items(), strict=True):
            _bars(ax, part, scale.factor)
            # a number beyond its bar takes more of a narrow panel
            room = 1.12 if len(parts) == 1 else 1.12 + 0.12 * len(parts)
            ax.set_xlim(0, largest * scale.factor * room or 1.0)
            over = "the detector" if len(parts) == 1 else name
            ax.set_xlabel(f"rms over {over} [{scale.unit}]")
        axes[0].set_yticks(np.arange(len(rows)), [fill(str(r["name"]), 26) for r in rows])
        axes[0].invert_yaxis()
        kinds = [k for k in _KIND_COLORS if any(r["kind"] == k and not is_total(r) for r in rows)]
        handles = [Patch(color=_KIND_COLORS[k], label=f"{k}, radial") for k in kinds]
        handles.append(Patch(color=INK, label="total, radial"))
        for key, (marker, _) in _AXIS_MARKERS.items():
            handles += axes[0].plot([], [], marker, label=f"{key} alone", **_MARKER_STYLE)
        fig.legend(handles=handles, loc="outside upper left", ncols=len(handles))
    return fig


def _bars(ax: Axes, rows: Sequence[Mapping[str, str | float]], factor: float) -> None:
    place = np.arange(len(rows))
    radial = np.array([r["radial"] for r in rows], float) * factor
    colors = [INK if is_total(r) else _KIND_COLORS.get(str(r["kind"]), "#9AA5B1") for r in rows]
    ax.barh(place, radial, height=0.62, color=colors, zorder=2)
    for key, (marker, shift) in _AXIS_MARKERS.items():
        values = np.array([r[key] for r in rows], float) * factor
        ax.plot(values, place + shift, marker, **_MARKER_STYLE)
    for k, value in enumerate(radial):
        ax.annotate(f"{value:.3g}", (value, k), (5, 0), textcoords="offset points", va="center")
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(axis="y", length=0)


def _wrapped(name: str, width: int = 26) -> str:
    return name if len(name) <= width else name[: width - 1] + "…"


def dominating_term(budget: DetectorBudget, mosaic: Mosaic | None = None) -> Figure:
    """Map of the term that contributes most at each place.

    Parameters
    ----------
    budget : DetectorBudget
    mosaic : Mosaic, optional
        How the chips lie; one above the other by default.

    Returns
    -------
    matplotlib.figure.Figure
    """
    chips = budget.chips
    mosaic = mosaic or Mosaic.column(*(grid_size(b.x, b.y) for b in chips))
    share = budget.share
    present = np.flatnonzero(share)
    colors = [CYCLE[k % len(CYCLE)] for k in range(len(present))]
    fig, panels = mosaic.panels()
    with figure_style():
        for k, (b, (ax,)) in enumerate(zip(chips, panels, strict=True)):
            mosaic.draw(ax, k)
            ax.pcolormesh(
                b.x,
                b.y,
                np.searchsorted(present, b.dominant),
                cmap=ListedColormap(colors),
                norm=BoundaryNorm(np.arange(len(present) + 1) - 0.5, len(present)),
                shading="nearest",
            )
            ax.set_title(mosaic.names[k])
        handles = [
            Patch(color=c, label=f"{_wrapped(budget.names[k], 40)} ({100 * share[k]:.0f} %)")
            for c, k in zip(colors, present, strict=True)
        ]
        fig.legend(handles=handles, loc="outside upper left", ncols=2)
    return fig
