"""The look-up tables themselves, and how well their nodes are known: Figures 11-13 of the ISR."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from bayesdist.model import Chip, LookupTable
from bayesdist.report.mosaic import Mosaic
from bayesdist.report.numbers import display_scale
from bayesdist.report.style import INK, draw_vectors, figure_style, nice_below, vector_key

__all__ = ["node_errors", "node_vectors"]


def _in_order(tables: Sequence[LookupTable], chips: Sequence[Chip]) -> list[LookupTable | None]:
    """The table of each chip, None where there is none."""
    of = {table.chip: table for table in tables}
    return [of.get(chip.number) for chip in chips]


def node_vectors(tables: Sequence[LookupTable], chips: Sequence[Chip], *, mosaic: Mosaic) -> Figure:
    """What the tables add to the pixels, an arrow at each node.

    Parameters
    ----------
    tables : sequence of LookupTable
        Of one filter, or the detector's; at most one for each chip.
    chips : sequence of Chip
        In the order of the mosaic.
    mosaic : Mosaic

    Returns
    -------
    matplotlib.figure.Figure
    """
    length = np.concatenate([np.hypot(*t.values).ravel() for t in tables])
    typical = float(np.quantile(length, 0.95))
    step = min(min(t.step) for t in tables)
    M = nice_below(1.6 * step / typical) if typical > 0 else 1.0
    fig, panels = mosaic.panels()
    with figure_style():
        for k, (table, (ax,)) in enumerate(zip(_in_order(tables, chips), panels, strict=True)):
            mosaic.draw(ax, k, margin=0.03 * max(max(s) for s in mosaic.sizes))
            if table is None:
                ax.set_title(mosaic.title(k, "no table"), pad=9)
                continue
            gx, gy = np.meshgrid(*table.nodes())
            draw_vectors(ax, gx, gy, *table.values, magnification=M, color=INK)
            largest = float(np.hypot(*table.values).max())
            ax.set_title(mosaic.title(k, f"largest shift {largest:.3g} pix"), pad=9)
            vector_key(ax, nice_below(length.max() / 1.5), magnification=M, unit="pix")
    return fig


def node_errors(tables: Sequence[LookupTable], chips: Sequence[Chip], *, mosaic: Mosaic) -> Figure:
    """Standard errors of the nodes along x and y, in one scale of colours.

    Parameters
    ----------
    tables : sequence of LookupTable
        Of one filter, or the detector's, with errors.
    chips : sequence of Chip
        In the order of the mosaic.
    mosaic : Mosaic

    Returns
    -------
    matplotlib.figure.Figure
    """
    every = np.concatenate([t.sigma.ravel() for t in tables if t.sigma is not None])
    # a few nodes without stars must not flatten all others
    low, high = float(every.min()), float(np.quantile(every, 0.995))
    scale = display_scale("pix", high)
    fig, panels = mosaic.panels(2, colorbar=True)
    image = None
    with figure_style():
        for k, (table, axes) in enumerate(zip(_in_order(tables, chips), panels, strict=True)):
            for axis, ax in enumerate(axes):
                mosaic.draw(ax, k)
                if table is None or table.sigma is None:
                    ax.set_title(mosaic.title(k, "none"))
                    continue
                x, y = table.nodes()
                hx, hy = (s / 2 for s in table.step)
                image = ax.imshow(
                    table.sigma[axis] * scale.factor,
                    origin="lower",
                    extent=(x[0] - hx, x[-1] + hx, y[0] - hy, y[-1] + hy),
                    vmin=low * scale.factor,
                    vmax=high * scale.factor,
                    aspect="equal",
                    interpolation="nearest",
                )
                mosaic.draw(ax, k)  # the image has set limits of its own
                median = float(np.median(table.sigma[axis])) * scale.factor
                what = f"σ of {'xy'[axis]}, median {median:.3g}"
                ax.set_title(mosaic.title(k, what))
        if image is not None:
            several = [ax for axes in panels for ax in axes]
            label = f"σ of a node [{scale.unit}]"
            extend = "max" if every.max() > high else "neither"
            fig.colorbar(image, ax=several, label=label, fraction=0.05, pad=0.02, extend=extend)
    return fig
