"""Panels of several bands beside each other, each band in its own pixels."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from math import ceil

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayesdist.report.style import WIDTH, detector_axes, figure_style, new_figure

__all__ = ["DIVERGING", "band_axes", "band_images", "band_panels"]

Float = NDArray[np.float64]
Size = tuple[float, float]

DIVERGING = "RdBu_r"  # red and blue are told apart in every common colour blindness
EMPTY = "#D9DEE3"


def band_panels(
    sizes: Mapping[str, Size], *, columns: int = 2, colorbar: bool = False
) -> tuple[Figure, dict[str, Axes]]:
    """Figure with one panel for each name, all panels equally wide.

    Parameters
    ----------
    sizes : mapping of str to (float, float)
        Columns and rows of each array, in pixels.
    columns : int
        Panels beside each other, at most.
    colorbar : bool
        Whether room for one shared colour bar is needed.

    Returns
    -------
    fig : matplotlib.figure.Figure
    axes : dict of str to matplotlib.axes.Axes
    """
    columns = min(columns, len(sizes))
    rows = ceil(len(sizes) / columns)
    width = WIDTH if columns > 1 else 0.66 * WIDTH
    panel = (width - 0.75 - 0.5 * (columns - 1) - (0.8 if colorbar else 0.0)) / columns
    aspect = max(ny / nx for nx, ny in sizes.values())
    with figure_style():
        fig = new_figure(width, rows * (panel * aspect + 0.72), layout="compressed")
        grid = fig.subplots(rows, columns, squeeze=False).ravel()
    for ax in grid[len(sizes) :]:
        ax.remove()
    return fig, dict(zip(sizes, grid, strict=False))


def band_axes(axes: Mapping[str, Axes], sizes: Mapping[str, Size], margin: float = 0.0) -> None:
    """Make panels maps of the arrays; the margin is a part of each array's longer side."""
    places = {name: ax.get_subplotspec() for name, ax in axes.items()}
    last = max(p.rowspan.start for p in places.values() if p is not None)
    for k, (name, ax) in enumerate(axes.items()):
        detector_axes(ax, sizes[name], margin=margin * max(sizes[name]))
        if len(set(sizes.values())) > 1:  # then a neighbour's numbers do not serve
            ax.tick_params(labelbottom=True, labelleft=True)
        spec = places[name]
        assert spec is not None
        # nothing stands below it in a last row that is not full
        if spec.rowspan.start == last - 1 and k + spec.get_gridspec().ncols >= len(axes):
            ax.tick_params(labelbottom=True)
            ax.set_xlabel("x [pix]")


def band_images(
    images: Mapping[str, Float],
    sizes: Mapping[str, Size],
    titles: Mapping[str, str],
    *,
    label: str,
    limit: Callable[[Collection[Float]], float],
    centre: float = 0.0,
    alone: bool = False,
) -> Figure:
    """Images of bins over the arrays, in a diverging colour scale.

    Parameters
    ----------
    images : mapping of str to ndarray, shape (ny, nx)
        NaN where there is nothing.
    sizes, titles : mapping of str
        Of each panel.
    label : str
        Of the colour bar, with the unit.
    limit : callable
        Of some images: how far a scale for them runs to both sides of its centre; what is beyond
        shows its end colours.
    centre : float
    alone : bool
        Whether each panel has a scale of its own, and not one for all.

    Returns
    -------
    matplotlib.figure.Figure
    """
    fig, axes = band_panels(sizes, colorbar=True)
    with figure_style():
        band_axes(axes, sizes)
        *_, last = axes.values()
        for name, ax in axes.items():
            nx, ny = sizes[name]
            shown = [images[name]] if alone else list(images.values())
            reach = limit(shown)
            ax.set_facecolor(EMPTY)
            drawn = ax.imshow(
                images[name],
                origin="lower",
                extent=(0.5, nx + 0.5, 0.5, ny + 0.5),
                cmap=DIVERGING,
                norm=Normalize(centre - reach, centre + reach),
                interpolation="nearest",
            )
            ax.set_title(titles[name])
            if alone or ax is last:
                beyond = any((np.abs(image - centre) > reach).any() for image in shown)
                fig.colorbar(
                    drawn,
                    ax=ax if alone else list(axes.values()),
                    label=label,
                    fraction=0.046 if alone else 0.04,
                    pad=0.02,
                    shrink=1.0 if alone else 0.75,
                    extend="both" if beyond else "neither",
                )
    return fig
