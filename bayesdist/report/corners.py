"""Corner plots: joint distributions of each pair of several quantities, from draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
    "corner_figure",
]

Float = NDArray[np.float64]

COLOR = PALETTE["blue"]
BINS = 26  # of each quantity
CONTENT = tuple(1.0 - np.exp(-0.5 * np.array([2.0, 1.0]) ** 2))  # of 2 and 1 sigma in 2-D


@dataclass(frozen=True, eq=False)
class Column:
    """Draws (N,) of one quantity."""

    label: str
    unit: str
    draws: Float


def corner_figure(columns: Sequence[Column], *, formal: Float | None = None) -> Figure:
    """Corner plot of draws, at 1 and 2 sigma, with a Gaussian about zero of a covariance (n, n)."""
    n = len(columns)
    raw = np.stack([c.draws for c in columns], axis=-1)
    ranges = _ranges(raw, formal)
    scales = [display_scale(c.unit, limits) for c, limits in zip(columns, ranges, strict=True)]
    factors = np.array([s.factor for s in scales])
    side = WIDTH if n > 3 else 1.6 * n + 0.9
    with figure_style():
        fig = new_figure(side, side, layout="none")
        panels = _panels(fig, n)
        draws, limits = raw * factors, ranges * factors[:, None]
        for row in range(n):
            _draw_marginal(panels[row, row], draws[:, row], limits[row])
            for column in range(row):
                pair = [column, row]
                _draw_joint(panels[row, column], draws[:, pair], limits[pair])
        for k, (c, s) in enumerate(zip(columns, scales, strict=True)):
            label = f"{c.label} [{s.unit or 'no unit'}]"
            panels[-1, k].set_xlabel(label, fontsize=8)
            panels[-1, k].xaxis.set_label_coords(0.5, -0.34)
            if k:
                panels[k, 0].set_ylabel(label, fontsize=8)
                panels[k, 0].yaxis.set_label_coords(-0.34, 0.5)
        handles = [Patch(fc=COLOR, alpha=0.6, label="posterior\n(1 σ and 2 σ)")]
        if formal is not None:
            _draw_gaussian(panels, formal * np.outer(factors, factors))
            handles.append(
                Patch(fill=False, ec=PALETTE["vermilion"], label="least squares,\nformal")
            )
        if n > 1:
            fig.legend(handles=handles, loc="upper right", fontsize=8.5)
        else:
            panels[0, 0].set_ylabel("density [relative]")
        room = 0.75 / side
        fig.subplots_adjust(
            left=room, bottom=room, right=0.985, top=0.985, wspace=0.06, hspace=0.06
        )
    return fig


def _panels(figure: Figure, n: int) -> NDArray[np.object_]:
    """Axes (n, n) of a corner plot, None above the diagonal; numbers at the left and below."""
    grid, panels = figure.add_gridspec(n, n), np.full((n, n), None, dtype=object)
    for row in range(n):
        for column in range(row + 1):
            ax = panels[row, column] = figure.add_subplot(grid[row, column])
            ax.xaxis.set_major_locator(MaxNLocator(3, prune="lower"))
            ax.yaxis.set_major_locator(
                NullLocator() if column == row else MaxNLocator(3, prune="lower")
            )
            ax.tick_params("x", labelrotation=45, labelbottom=row == n - 1)
            ax.tick_params("y", labelrotation=45, labelleft=column == 0)
    return panels


def _draw_marginal(ax: Axes, draws: Float, limits: Float) -> None:
    """Draw the histogram of one quantity; dashed lines hold 68 %."""
    density, edges = np.histogram(draws, BINS, range=tuple(limits), density=True)
    ax.stairs(density, edges, color=COLOR, lw=1.0)
    for quantile in np.quantile(draws, [0.1587, 0.8413]):
        ax.axvline(quantile, ls="dashed", color=COLOR)
    ax.set(xlim=limits, ylim=(0, 1.1 * density.max()))


def _draw_joint(ax: Axes, draws: Float, limits: Float) -> None:
    """Draw the regions that hold as many draws (N, 2) as 1 and 2 sigma of a Gaussian."""
    counts, *edges = np.histogram2d(draws[:, 0], draws[:, 1], bins=BINS, range=limits)
    # continued beyond the edges by its outermost values, so that regions end at the frame
    smooth = np.pad(gaussian_filter(counts, 1.0), 1, mode="edge")
    x, y = (np.append(e - 0.5 * (e[1] - e[0]), e[-1] + 0.5 * (e[1] - e[0])) for e in edges)
    falling = np.sort(smooth[1:-1, 1:-1], axis=None)[::-1]
    content = np.cumsum(falling) / falling.sum()
    levels = [*(float(falling[np.searchsorted(content, c)]) for c in CONTENT), 1.001 * falling[0]]
    shades = [to_rgba(COLOR, 0.35), COLOR]
    if levels[0] < levels[1] < levels[2]:
        ax.contourf(x, y, smooth.T, levels, colors=shades)
        ax.contour(x, y, smooth.T, levels[:2], colors=[COLOR])
    ax.set(xlim=limits[0], ylim=limits[1])


def _ranges(draws: Float, formal: Float | None) -> Float:
    """Limits (n, 2) of each column: four standard deviations, and the formal Gaussian if any."""
    middle, spread = np.median(draws, axis=0), np.std(draws, axis=0)
    spread = np.where(spread > 0, spread, 1e-6 * np.abs(middle) + 1e-12)
    low, high = middle - 4 * spread, middle + 4 * spread
    if formal is None:
        low = np.maximum(low, 0.0)  # f, j and s_out are never negative
    else:
        reach = 3 * np.sqrt(np.diag(formal))
        low, high = np.minimum(low, -reach), np.maximum(high, reach)
    return np.stack([low, high], axis=-1)


def _draw_gaussian(panels: NDArray[np.object_], cov: Float) -> None:
    """Draw the Gaussian of a covariance about zero, at 1 and 2 sigma, over a corner plot."""
    style = {"color": PALETTE["vermilion"], "lw": 1.1, "zorder": 6}
    turn = np.linspace(0.0, 2.0 * np.pi, 100)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    for row in range(len(panels)):
        own = panels[row, row]
        low, high = own.get_xlim()
        at = np.linspace(low, high, 200)
        density = np.exp(-0.5 * at**2 / cov[row, row]) / np.sqrt(2.0 * np.pi * cov[row, row])
        own.plot(at, density, **style)
        own.set_ylim(0, max(own.get_ylim()[1], 1.1 * density.max()))
        for column in range(row):
            index = [column, row]
            root = np.linalg.cholesky(cov[np.ix_(index, index)])
            for radius in (1.0, 2.0):
                panels[row, column].plot(*(radius * root @ circle), **style)
