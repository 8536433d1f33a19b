"""How the area of a pixel on the sky varies over the detector."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from bayesdist.report.mosaic import Mosaic
from bayesdist.report.style import figure_style
from bayesdist.report.uncertainty import contour_levels, contour_map
from bayesdist.report.vectors import grid_size

if TYPE_CHECKING:
    from bayesdist.assess import AreaMap

__all__ = ["pixel_area"]


def pixel_area(*areas: AreaMap, mosaic: Mosaic | None = None) -> Figure:
    """Contours of the pixel area relative to that at the reference pixel, in percent.

    As Figure 4.5 of the ACS handbook, which gives the same ratio without subtracting one.

    Parameters
    ----------
    *areas : AreaMap
        One for each chip, each relative to the chip's own reference pixel.
    mosaic : Mosaic, optional
        How the chips lie; one above the other by default.

    Returns
    -------
    matplotlib.figure.Figure
    """
    mosaic = mosaic or Mosaic.column(*(grid_size(a.x, a.y) for a in areas))
    percent = [100.0 * (a.area - 1.0) for a in areas]
    levels = contour_levels(np.concatenate([p.ravel() for p in percent]))
    fig, panels = mosaic.panels(colorbar=True)
    with figure_style():
        for k, (a, values, (ax,)) in enumerate(zip(areas, percent, panels, strict=True)):
            mosaic.draw(ax, k)
            filled = contour_map(ax, a.x, a.y, values, levels)
            text = f"relative area {a.area.min():.5g} to {a.area.max():.5g}"
            ax.set_title(mosaic.title(k, text))
        fig.colorbar(
            filled,
            ax=[ax for (ax,) in panels],
            label="pixel area − area at reference pixel [%]",
            fraction=0.05,
            pad=0.02,
        )
    return fig
