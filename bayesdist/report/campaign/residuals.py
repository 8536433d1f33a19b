"""What the look-up tables take out of the residuals: Figures 6, 7 and 10 of ACS ISR 2015-06."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayesdist.report.mosaic import Mosaic
from bayesdist.report.numbers import display_scale
from bayesdist.report.style import PALETTE, WIDTH, figure_style, new_figure, nice_below
from bayesdist.report.vectors import residual_vectors, spacing

if TYPE_CHECKING:
    from bayesdist.assess import BinnedResiduals
    from bayesdist.report.campaign.context import ChipResiduals

__all__ = [
    "binned_of",
    "common_scale",
    "largest_cell",
    "residual_map",
    "rms_of_cells",
    "table_residuals",
]

Float = NDArray[np.float64]

WITHOUT, WITH = PALETTE["vermilion"], PALETTE["blue"]
_REACH = 4.5  # times the robust width of the residuals without tables: where axes end


def table_residuals(chips: Sequence[ChipResiduals]) -> Figure:
    """Residuals of single stars on each chip, without the tables and with them.

    Parameters
    ----------
    chips : sequence of ChipResiduals
        In the order of the panels, from the top; with tables.

    Returns
    -------
    matplotlib.figure.Figure
    """
    every = np.concatenate([c.without for c in chips])
    reach = _REACH * 1.4826 * float(np.median(np.abs(every)))
    scale = display_scale("pix", reach)
    with figure_style():
        fig = new_figure(WIDTH, 2.35 * len(chips) + 0.35)
        grid = fig.subplots(len(chips), 3, squeeze=False)
        for axes, chip in zip(grid, chips, strict=True):
            assert chip.with_tables is not None
            name = chip.chip.name or f"chip {chip.chip.number}"
            parts = ((chip.without, "without tables", WITHOUT), (chip.with_tables, "with", WITH))
            for ax, (r, what, color) in zip(axes, parts, strict=False):
                _cloud(ax, r * scale.factor, reach * scale.factor, color)
                ax.set_title(f"{name}, {what}")
                ax.set_xlabel(f"residual in x [{scale.unit}]")
            axes[0].set_ylabel(f"residual in y [{scale.unit}]")
            axes[1].tick_params(labelleft=False)
            edges = np.linspace(-reach, reach, 91) * scale.factor
            for r, what, color in parts:
                for k, style in enumerate(("-", ":")):
                    counts, _ = np.histogram(r[:, k] * scale.factor, edges)
                    label = f"{'xy'[k]}, {what.split()[0]}"
                    axes[2].stairs(counts, edges, color=color, ls=style, lw=1.0, label=label)
            axes[2].set_xlim(edges[0], edges[-1])
            axes[2].set_title(f"{name}, histograms")
            axes[2].set_xlabel(f"residual [{scale.unit}]")
            axes[2].set_ylabel("stars drawn per bin")
        grid[0, 2].legend(loc="upper left", fontsize=6.5, handlelength=1.5, borderaxespad=0.2)
    return fig


def _cloud(ax: Axes, residual: Float, reach: float, color: str) -> None:
    ax.axhline(0, color="#9AA5B1", lw=0.5, zorder=0)
    ax.axvline(0, color="#9AA5B1", lw=0.5, zorder=0)
    ax.plot(*residual.T, ".", ms=1.3, mec="none", alpha=0.55, color=color)
    ax.set_xlim(-reach, reach)
    ax.set_ylim(-reach, reach)
    ax.set_box_aspect(1)


def common_scale(chips: Sequence[ChipResiduals]) -> tuple[float, float]:
    """Magnification at which the vectors without tables are seen well, and length of the key.

    Both maps are drawn so.
    """
    length = np.concatenate([_lengths(c.binned_without) for c in chips])
    typical = float(np.quantile(length, 0.95)) if length.size else 1.0
    step = min(spacing(c.binned_without.x, c.binned_without.y) for c in chips)
    magnification = nice_below(1.6 * step / typical) if typical > 0 else 1.0
    return magnification, nice_below(float(length.max(initial=0.0)) / 1.5)


def residual_map(chips: Sequence[ChipResiduals], which: str, *, mosaic: Mosaic) -> Figure:
    """Mean residual of each cell, without the tables or with them, at one scale for both.

    Parameters
    ----------
    chips : sequence of ChipResiduals
    which : {'without', 'with'}
    mosaic : Mosaic

    Returns
    -------
    matplotlib.figure.Figure
    """
    M, key = common_scale(chips)
    return residual_vectors(
        *binned_of(chips, which), unit="pix", mosaic=mosaic, magnification=M, key=key
    )


def binned_of(chips: Sequence[ChipResiduals], which: str) -> list[BinnedResiduals]:
    """Binned residuals of all chips, 'without' the tables or 'with' them."""
    found = [c.binned_without if which == "without" else c.binned_with for c in chips]
    return [one for one in found if one is not None]


def _lengths(binned: BinnedResiduals) -> Float:
    length = np.hypot(binned.mean_u, binned.mean_v)[np.asarray(binned.count) > 0]
    return np.asarray(length[np.isfinite(length)], float)


def largest_cell(*binned: BinnedResiduals) -> float:
    """Length of the longest mean vector."""
    return max((float(_lengths(b).max(initial=0.0)) for b in binned), default=0.0)


def rms_of_cells(*binned: BinnedResiduals) -> tuple[float, float]:
    """Rms of the cells' means on an axis, and what the scatter in the cells alone would give."""
    mean, noise = [], []
    for b in binned:
        full = np.isfinite(b.mean_u) & np.isfinite(b.sem_u) & np.isfinite(b.sem_v)
        mean += [b.mean_u[full], b.mean_v[full]]
        noise += [b.sem_u[full], b.sem_v[full]]
    square = (np.concatenate(a) ** 2 for a in (mean, noise))
    first, second = (float(np.sqrt(s.mean())) if s.size else np.nan for s in square)
    return first, second
