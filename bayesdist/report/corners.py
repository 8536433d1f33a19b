"""Corner plots: joint distributions of each pair of several quantities, from draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, NullLocator
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from bayesdist.numbers import display_scale
from bayesdist.report.style import PALETTE, WIDTH, figure_style, new_figure

__all__ = [
    "Column",
    "content_levels",
    "corner_figure",
]

Float = NDArray[np.float64]

_BINS = 26
_CONTENT = tuple(1.0 - np.exp(-0.5 * np.array([2.0, 1.0]) ** 2))  # of 2 and 1 sigma in 2-D
_MIDDLE = (0.1587, 0.8413)  # quantiles that hold 68 %
_COLOR = PALETTE["blue"]
_FILL = to_rgba(_COLOR, alpha=1 / 3), to_rgba(_COLOR)  # beyond 1 sigma, and within


@dataclass(frozen=True, eq=False)
class Column:
    """Draws (N,) of one quantity."""

    label: str
    unit: str
    draws: Float


def corner_figure(columns: Sequence[Column]) -> Figure:
    """Corner plot of draws of quantities that are never negative, at 1 and 2 sigma."""
    n = len(columns)
    raw = np.stack([c.draws for c in columns], axis=-1)
    ranges = _ranges(raw)
    scales = [display_scale(c.unit, limits) for c, limits in zip(columns, ranges, strict=True)]
    factors = np.array([s.factor for s in scales])
    draws, ranges = raw * factors, ranges * factors[:, None]
    labels = [f"{c.label} [{s.unit or 'no unit'}]" for c, s in zip(columns, scales, strict=True)]
    side = WIDTH if n > 3 else 1.6 * n + 0.9
    with figure_style():
        fig = new_figure(side, side, layout="none")
        grid = fig.add_gridspec(n, n)
        for row in range(n):
            for column in range(row + 1):
                ax = fig.add_subplot(grid[row, column])
                ax.set_xlim(*ranges[column])
                _ticks(ax, "x", labels[column] if row == n - 1 else None)
                if row == column:
                    _histogram(ax, draws[:, row], ranges[row])
                    continue
                ax.set_ylim(*ranges[row])
                _ticks(ax, "y", labels[row] if column == 0 else None)
                _contours(ax, draws[:, [column, row]], ranges[[column, row]])
        handles = [Patch(fc=_COLOR, alpha=0.6, label="posterior\n(1 σ and 2 σ)")]
        if n > 1:
            fig.legend(handles=handles, loc="upper right", fontsize=8.5)
        else:
            fig.axes[0].set_ylabel("density [relative]")
        room = 0.75 / side
        fig.subplots_adjust(
            left=room, bottom=room, right=0.985, top=0.985, wspace=0.06, hspace=0.06
        )
    return fig


def _ticks(ax: Axes, which: Literal["x", "y"], label: str | None) -> None:
    """Give an axis few ticks, and at the edge of the figure, where it has a label, their values."""
    axis = ax.xaxis if which == "x" else ax.yaxis
    axis.set_major_locator(MaxNLocator(3, prune="lower"))
    ax.tick_params(
        which, labelrotation=45, labelbottom=label is not None, labelleft=label is not None
    )
    if label is not None:
        axis.set_label_text(label, fontsize=8)
        axis.set_label_coords(*((0.5, -0.34) if which == "x" else (-0.34, 0.5)))


def _histogram(ax: Axes, draws: Float, limits: Float) -> None:
    """Draw a histogram, and lines that hold 68 % of the draws."""
    density, edges = np.histogram(draws, _BINS, tuple(limits), density=True)
    ax.stairs(density, edges, color=_COLOR, lw=1.0)
    for at in np.quantile(draws, _MIDDLE):
        ax.axvline(at, ls="dashed", color=_COLOR)
    ax.set_ylim(0.0, 1.1 * density.max())
    ax.yaxis.set_major_locator(NullLocator())


def _contours(ax: Axes, draws: Float, limits: Float) -> None:
    """Draw the smoothed density of pairs (N, 2), filled where it holds 1 and 2 sigma."""
    found, *edges = np.histogram2d(draws[:, 0], draws[:, 1], _BINS, limits.tolist())
    density = gaussian_filter(found, 1.0)
    outer, inner = content_levels(density)
    # one more cell on each side, so that contours end at the edge of the panel and not within
    x, y = (
        np.concatenate(
            [[1.5 * e[0] - 0.5 * e[1]], 0.5 * (e[1:] + e[:-1]), [1.5 * e[-1] - 0.5 * e[-2]]]
        )
        for e in edges
    )
    padded = np.pad(density, 1, mode="edge").T
    ax.contourf(x, y, padded, [outer, inner, np.inf], colors=_FILL)
    ax.contour(x, y, padded, [outer, inner], colors=_COLOR)


def content_levels(density: Float) -> tuple[float, float]:
    """Densities above which there are the contents of 2 and of 1 sigma, the second one larger."""
    ordered = np.sort(density, axis=None)[::-1]
    within = np.cumsum(ordered) / ordered.sum()
    outer, inner = (ordered[max(np.searchsorted(within, c, "right") - 1, 0)] for c in _CONTENT)
    return float(min(outer, inner * (1.0 - 1e-4))), float(inner)


def _ranges(draws: Float) -> Float:
    """Limits (n, 2) of each column: four standard deviations, from zero at least."""
    middle, spread = np.median(draws, axis=0), np.std(draws, axis=0)
    spread = np.where(spread > 0, spread, 1e-6 * np.abs(middle) + 1e-12)
    return np.stack([np.maximum(middle - 4 * spread, 0.0), middle + 4 * spread], axis=-1)
