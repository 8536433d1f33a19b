"""How the area of a pixel on the sky varies over the detector."""

from __future__ import annotations

from typing import TYPE_CHECKING

from matplotlib.figure import Figure

from bayesdist.report.style import detector_axes, detector_panels, figure_style
from bayesdist.report.uncertainty import contour_levels, contour_map
from bayesdist.report.vectors import grid_size

if TYPE_CHECKING:
    from bayesdist.assess import AreaMap

__all__ = ["pixel_area"]


def pixel_area(area: AreaMap) -> Figure:
    """Contours of the pixel area relative to that at the reference pixel, in percent.

    As Figure 4.5 of the ACS handbook, which gives the same ratio without subtracting one.

    Parameters
    ----------
    area : AreaMap

    Returns
    -------
    matplotlib.figure.Figure
    """
    size = grid_size(area.x, area.y)
    percent = 100.0 * (area.area - 1.0)
    fig, (ax,) = detector_panels(1, size, colorbar=True)
    with figure_style():
        detector_axes(ax, size)
        filled = contour_map(ax, area.x, area.y, percent, contour_levels(percent))
        ax.set_title(f"relative area {area.area.min():.5g} to {area.area.max():.5g}")
        fig.colorbar(
            filled,
            ax=ax,
            label="pixel area − area at reference pixel [%]",
            fraction=0.05,
            pad=0.02,
        )
    return fig
