"""How the exposures were matched, and where they lie on the catalogue (Figure 4 of the ISR)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import ScalarFormatter

from bayesdist.report.style import INK, PALETTE, SEQUENTIAL, WIDTH, figure_style, new_figure

if TYPE_CHECKING:
    from astropy.table import Table

    from bayesdist.report.campaign.context import Footprints

__all__ = ["footprints", "matching_by_exposure"]


def matching_by_exposure(matching: Table) -> Figure:
    """Completeness and share of false pairs of each exposure, against its date.

    Parameters
    ----------
    matching : Table
        As matching.ecsv.

    Returns
    -------
    matplotlib.figure.Figure
    """
    epoch = np.asarray(matching["epoch"], float)
    rows = (
        ("completeness [%]", 100 * np.asarray(matching["completeness"], float), "blue"),
        ("false pairs [10⁻⁶]", 1e6 * np.asarray(matching["false_share"], float), "vermilion"),
        ("pairs", np.asarray(matching["matched"], float), "green"),
    )
    with figure_style():
        fig = new_figure(WIDTH, 4.2)
        axes = fig.subplots(len(rows), 1, sharex=True)
        for ax, (label, values, color) in zip(axes, rows, strict=True):
            ax.plot(epoch, values, "o", ms=3.2, mec="none", color=PALETTE[color])
            ax.set_ylabel(label)
            ax.margins(y=0.15)
            ax.grid(True, lw=0.4, color="#E3E8ED")
            ax.set_axisbelow(True)
        axes[1].set_ylim(bottom=-0.05 * max(axes[1].get_ylim()[1], 1.0))
        axes[2].set_ylim(bottom=0)
        axes[2].set_xlabel("epoch [yr]")
        fig.align_ylabels(axes)
    return fig


def footprints(field: Footprints) -> Figure:
    """Outlines of the chips of every exposure over the stars of the catalogue, coloured by date.

    Parameters
    ----------
    field : Footprints

    Returns
    -------
    matplotlib.figure.Figure
    """
    with figure_style():
        fig = new_figure(0.85 * WIDTH, 0.78 * WIDTH, layout="compressed")
        ax = fig.subplots()
        ax.plot(field.u, field.v, ".", ms=1.3, color="#9AA7B4", mec="none", zorder=1)
        # so many outlines hide each other: three of them show what one looks like
        dates = np.unique(field.epoch)
        strong = np.isin(field.epoch, dates[[0, len(dates) // 2, -1]])
        for some, style in (
            (~strong, {"lw": 0.4, "alpha": 0.35, "zorder": 2}),
            (strong, {"lw": 1.6, "alpha": 1.0, "zorder": 3}),
        ):
            rows = np.flatnonzero(some)
            shown = [field.outlines[k] for k in rows]
            lines = LineCollection(shown, array=field.epoch[rows], cmap=SEQUENTIAL, **style)
            lines.set_clim(dates[0], dates[-1])
            ax.add_collection(lines)
        ax.set_aspect("equal")
        ax.autoscale_view()
        ax.set_xlabel(f"u [{field.unit}]")
        ax.set_ylabel(f"v [{field.unit}]")
        bar = fig.colorbar(lines, ax=ax, fraction=0.045, pad=0.02, label="epoch [yr]")
        bar.ax.yaxis.set_major_formatter(ScalarFormatter(useOffset=False))
        ax.tick_params(colors=INK)
    return fig
