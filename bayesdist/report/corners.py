"""Corner plots: joint distributions of each pair of several quantities, from draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, NullLocator
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from bayesdist.numbers import display_scale
from bayesdist.report.style import PALETTE, WIDTH, new_figure

__all__ = [
    "Column",
    "corner_figure",
]

Float = NDArray[np.float64]

BINS = 26
_COLOR = PALETTE["blue"]
_QUANTILES = (0.1587, 0.8413)  # dashed lines
_LEVELS = tuple(1.0 - np.exp(-0.5 * np.array([1.0, 2.0]) ** 2))  # content of 1 and 2 sigma in 2-D
_LABELS_AT = -0.34  # of a panel's side, from its edge


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
    limits = _ranges(raw, formal)
    scales = [display_scale(c.unit, ends) for c, ends in zip(columns, limits, strict=True)]
    factors = np.array([s.factor for s in scales])
    labels = [f"{c.label} [{s.unit or 'no unit'}]" for c, s in zip(columns, scales, strict=True)]
    draws, limits = raw * factors, limits * factors[:, None]
    side = WIDTH if n > 3 else 1.6 * n + 0.9
    fig = new_figure(side, side, layout="none")
    room = 0.75 / side
    fig.subplots_adjust(left=room, bottom=room, right=0.985, top=0.985, wspace=0.06, hspace=0.06)
    panels = fig.subplots(n, n, squeeze=False)
    for row in range(n):
        for column in range(row + 1, n):
            panels[row, column].set_axis_off()
        for column in range(row):
            _draw_pair(panels[row, column], draws[:, [column, row]], limits[[column, row]])
        _draw_single(panels[row, row], draws[:, row], limits[row])
        for ax in panels[row, : row + 1]:
            ax.tick_params(labelbottom=row == n - 1, labelleft=False, labelrotation=45)
            ax.xaxis.set_major_locator(MaxNLocator(3, prune="lower"))
        if row:
            panels[row, 0].tick_params(labelleft=True)
            panels[row, 0].set_ylabel(labels[row], fontsize=8)
            panels[row, 0].yaxis.set_label_coords(_LABELS_AT, 0.5)
        panels[-1, row].set_xlabel(labels[row], fontsize=8)
        panels[-1, row].xaxis.set_label_coords(0.5, _LABELS_AT)
    handles = [Patch(fc=_COLOR, alpha=0.6, label="posterior\n(1 σ and 2 σ)")]
    if formal is not None:
        _draw_gaussian(panels, formal * np.outer(factors, factors))
        handles.append(Patch(fill=False, ec=PALETTE["vermilion"], label="least squares,\nformal"))
    if n > 1:
        fig.legend(handles=handles, loc="upper right", fontsize=8.5)
    else:
        panels[0, 0].set_ylabel("density [relative]")
    return fig


def _draw_single(ax: Axes, draws: Float, limits: Float) -> None:
    """Draw a histogram of one quantity."""
    edges = _edges(limits)
    height, _, _ = ax.hist(
        draws, edges.tolist(), histtype="step", density=True, color=_COLOR, lw=1.0
    )
    for value in np.quantile(draws, _QUANTILES):
        ax.axvline(value, ls="dashed", color=_COLOR)
    ax.set(xlim=limits, ylim=(0, 1.1 * np.max(height)))
    ax.yaxis.set_major_locator(NullLocator())


def _edges(limits: Float) -> Float:
    low, high = limits
    return np.linspace(low, high, BINS + 1)


def _draw_pair(ax: Axes, draws: Float, limits: Float) -> None:
    """Draw contours of the smoothed density of two quantities (N, 2)."""
    edges = [_edges(ends) for ends in limits]
    counts, _, _ = np.histogram2d(draws[:, 0], draws[:, 1], bins=edges)
    density = gaussian_filter(counts, 1.0)
    levels = _levels(density)
    # two cells more on each side close the contours at the edges
    padded = np.pad(np.pad(density, 1, mode="edge"), 1, constant_values=density.min())
    x, y = (e[0] + (np.arange(-2, BINS + 2) + 0.5) * (e[1] - e[0]) for e in edges)
    fills = [*levels, density.max() * (1 + 1e-4)]
    ax.contourf(x, y, padded.T, fills, colors=[(_COLOR, 1 / 3), _COLOR], antialiased=False)
    ax.contour(x, y, padded.T, levels, colors=_COLOR)
    ax.set(xlim=limits[0], ylim=limits[1])
    ax.yaxis.set_major_locator(MaxNLocator(3, prune="lower"))


def _levels(density: Float) -> Float:
    """Rising densities that enclose 2 and 1 sigma."""
    ordered = np.sort(density, axis=None)[::-1]
    content = np.cumsum(ordered) / ordered.sum()
    last = np.searchsorted(content, _LEVELS, side="right") - 1
    levels = np.sort(ordered[np.maximum(last, 0)])
    if levels[0] == levels[1]:  # too few draws: contours need two levels
        levels[0] *= 1.0 - 1e-4
    return levels


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
