"""The error budget: how much each term gives, and where which one is largest."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from bayesdist.report.scales import display_scale
from bayesdist.report.style import (
    CYCLE,
    INK,
    PALETTE,
    WIDTH,
    detector_axes,
    detector_panels,
    figure_style,
    new_figure,
)
from bayesdist.report.vectors import grid_size

if TYPE_CHECKING:
    from bayesdist.assess import ErrorBudget

__all__ = ["budget_terms", "dominating_term", "is_total"]

_KIND_COLORS = {"random": PALETTE["sky"], "systematic": PALETTE["blue"]}
# one above the other, as both axes are often equal
_AXIS_MARKERS = {"u": ("o", -0.15), "v": ("s", 0.15)}
_MARKER_STYLE = {"ms": 5.5, "color": PALETTE["yellow"], "mec": INK, "mew": 0.7, "zorder": 4}


def is_total(row: dict) -> bool:
    """Whether a row of `ErrorBudget.rows` is the sum of the others."""
    return row["kind"] == "total"


def budget_terms(budget: ErrorBudget) -> Figure:
    """Bars of each term's radial rms over the detector, with its two axes marked.

    Parameters
    ----------
    budget : ErrorBudget

    Returns
    -------
    matplotlib.figure.Figure
    """
    rows = budget.rows()
    scale = display_scale(budget.unit, [r["radial"] for r in rows])
    place = np.arange(len(rows))
    radial = np.array([r["radial"] for r in rows], float) * scale.factor
    with figure_style():
        fig = new_figure(WIDTH, 1.1 + 0.34 * len(rows))
        ax = fig.subplots()
        colors = [INK if is_total(r) else _KIND_COLORS.get(r["kind"], "#9AA5B1") for r in rows]
        ax.barh(place, radial, height=0.62, color=colors, zorder=2)
        for key, (marker, shift) in _AXIS_MARKERS.items():
            values = np.array([r[key] for r in rows], float) * scale.factor
            ax.plot(values, place + shift, marker, **_MARKER_STYLE)
        for k, value in enumerate(radial):
            ax.annotate(f"{value:.3g}", (value, k), (5, 0), textcoords="offset points", va="center")
        ax.set_yticks(place, [_wrapped(str(r["name"])) for r in rows])
        ax.invert_yaxis()
        ax.set_xlim(0, float(radial.max()) * 1.12 or 1.0)
        ax.set_xlabel(f"rms over the detector [{scale.unit}]")
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(axis="y", length=0)
        kinds = [k for k in _KIND_COLORS if any(r["kind"] == k and not is_total(r) for r in rows)]
        handles = [Patch(color=_KIND_COLORS[k], label=f"{k}, radial") for k in kinds]
        handles.append(Patch(color=INK, label="total, radial"))
        for key, (marker, _) in _AXIS_MARKERS.items():
            handles += ax.plot([], [], marker, label=f"{key} alone", **_MARKER_STYLE)
        fig.legend(handles=handles, loc="outside upper left", ncols=len(handles))
    return fig


def _wrapped(name: str, width: int = 26) -> str:
    return name if len(name) <= width else name[: width - 1] + "…"


def dominating_term(budget: ErrorBudget) -> Figure:
    """Map of the term that contributes most at each place.

    Parameters
    ----------
    budget : ErrorBudget

    Returns
    -------
    matplotlib.figure.Figure
    """
    size = grid_size(budget.x, budget.y)
    present = [k for k in range(len(budget.terms)) if np.any(budget.dominant == k)]
    code = np.searchsorted(present, budget.dominant)
    colors = [CYCLE[k % len(CYCLE)] for k in range(len(present))]
    fig, (ax,) = detector_panels(1, size)
    with figure_style():
        detector_axes(ax, size)
        ax.pcolormesh(
            budget.x,
            budget.y,
            code,
            cmap=ListedColormap(colors),
            norm=BoundaryNorm(np.arange(len(present) + 1) - 0.5, len(present)),
            shading="nearest",
        )
        share = [float(np.mean(budget.dominant == k)) for k in present]
        handles = [
            Patch(color=c, label=f"{_wrapped(str(budget.terms[k].name), 40)} ({100 * s:.0f} %)")
            for c, k, s in zip(colors, present, share, strict=True)
        ]
        fig.legend(handles=handles, loc="outside upper left", ncols=2)
    return fig
