"""Plots over the detector: uncertainty of the position, and distortion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from bayesdist.errors import require_known
from bayesdist.report.figures.arrows import (
    Arrows,
    cell_magnification,
    crosses_magnification,
    draw_arrows,
    draw_crosses,
    draw_key,
    length_norm,
)
from bayesdist.report.figures.fields import Grid, draw_grid, error_levels
from bayesdist.report.figures.panels import chip_axes
from bayesdist.report.figures.style import COLORBAR, nice_below
from bayesdist.report.plots.axes import add_colorbar, axes_of, scale_of, set_title
from bayesdist.utils.text import number, size_of

if TYPE_CHECKING:
    from bayesdist.assess import UncertaintyMap, VectorMap

KINDS = ("contours", "crosses")
KEY_PAD = 20.0  # points between a panel and its title, so that the key fits below the title
BORDER = 0.02  # width of the border around a chip, as a fraction of its longer side


def plot_map(
    uncertainty_map: UncertaintyMap,
    ax: Axes | None = None,
    *,
    kind: str = "contours",
    scale_mas: float | None = None,
    levels: ArrayLike | None = None,
    magnification: float | None = None,
    colorbar: bool | Sequence[Axes] = True,
    name: str = "",
    title: str | None = None,
) -> Axes:
    """Plot the uncertainty of the position over a chip.

    Parameters
    ----------
    uncertainty_map : UncertaintyMap
    ax : matplotlib.axes.Axes, optional
        By default the axes of a new figure.
    kind : str
        'contours': filled contours of the uncertainty per axis, the rms of sigma_u and sigma_v,
        with a ring at its maximum. 'crosses': four vectors from each point of the grid to all
        combinations of (+-sigma_u, +-sigma_v), magnified as stated by the key above the axes.
    scale_mas : float, optional
        Size of a pixel in mas; if given, errors in pixels are shown in mas.
    levels : array_like, optional
        Levels of the contours in the unit of the map, for example those of another plot; round
        numbers by default.
    magnification : float, optional
        Length of the crosses in pixels of the axes for an error of 1; a round number by default.
    colorbar : bool or sequence of matplotlib.axes.Axes
        True for a colour bar next to `ax`, or all axes that share a colour bar.
    name : str
        Name of the chip, which begins the default title.
    title : str, optional
        By default the solution and its range of errors; an empty string for no title.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    InputError
        If the kind is unknown, or `ax` is not a single Axes.

    Examples
    --------
    >>> chip = bd.Chip(1, "camera", (2048, 2048), (1024.5, 1024.5))
    >>> model, rng = bd.DistortionModel(1, (chip,), "pix"), np.random.default_rng(1)
    >>> truth = [0, 1000, 0, 0, 0, 1000]
    >>> stars, _ = bd.simulate_matches(model, truth, 500, sigma=0.01, rng=rng)
    >>> errors = bd.uncertainty_map(bd.fit_linear(stars, model))
    >>> ax = plot_map(errors, Figure().subplots())
    >>> ax.get_xlabel()
    'x [pix]'
    """
    require_known(kind, KINDS, "kind of map", where="kind")
    ax, m = axes_of(ax), uncertainty_map
    size = float(m.x[-1]), float(m.y[-1])
    if kind == "crosses":
        M = crosses_magnification([m]) if magnification is None else magnification
        chip_axes(ax, size, margin=M * max(m.sigma_u_max, m.sigma_v_max) + BORDER * max(size))
        draw_crosses(ax, m, magnification=M)
        key = _key_length(m.radius_max, m.unit, scale_mas)
        draw_key(ax, key, magnification=M, unit=m.unit, scale_mas=scale_mas)
        largest = float(np.nanmax(m.per_axis))
        scale = scale_of(m.unit, largest, scale_mas)
        default = f"{m.kind}, largest {scale.text(largest)} per axis"
        set_title(ax, title, default, name, pad=KEY_PAD)
        return ax
    chip_axes(ax, size)
    scale = scale_of(m.unit, float(np.nanmax(m.per_axis)), scale_mas)
    grid = Grid(m.x, m.y, m.per_axis * scale.factor, m.position_of_max)
    shown = error_levels(grid.values) if levels is None else np.asarray(levels) * scale.factor
    drawn = draw_grid(ax, grid, levels=shown)
    label = f"per axis (1 σ) [{scale.unit}]"
    if colorbar is True:
        add_colorbar(ax, drawn, label)
    elif colorbar is not False:
        ax.figure.colorbar(drawn, ax=list(colorbar), label=label, **COLORBAR)
    low, high = number(np.nanmin(grid.values)), number(np.nanmax(grid.values))
    set_title(ax, title, f"{m.kind}: {low} to {high}", name)
    return ax


def plot_distortion(
    vector_map: VectorMap,
    ax: Axes | None = None,
    *,
    scale_mas: float | None = None,
    magnification: float | None = None,
    key: float | None = None,
    colorbar: bool = True,
    name: str = "",
    title: str | None = None,
) -> Axes:
    """Plot the distortion of a chip as vectors, with a ring around the origin of the longest.

    Vectors are along x and y of the detector, in its pixels. They point from a position to the
    position after distortion, magnified as stated by the key above the axes. Their colour is their
    length.

    Parameters
    ----------
    vector_map : VectorMap
        Result of `distortion_vectors`.
    ax : matplotlib.axes.Axes, optional
        By default the axes of a new figure.
    scale_mas : float, optional
        Size of a pixel in mas; if given, lengths are stated in mas.
    magnification : float, optional
        Magnification of the vectors; by default the longest one is as long as a grid step.
    key : float, optional
        Length of the vector above the axes, in pixels; a round number by default.
    colorbar : bool
        True for a colour bar of the lengths next to the axes.
    name : str
        Name of the chip, which begins the default title.
    title : str, optional
        By default the largest length; an empty string for no title.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    InputError
        If `ax` is not a single Axes.

    Examples
    --------
    >>> chip = bd.Chip(1, "camera", (2048, 2048), (1024.5, 1024.5))
    >>> model, rng = bd.DistortionModel(1, (chip,), "pix"), np.random.default_rng(1)
    >>> truth = [0, 1000, 0, 0, 0, 1000]
    >>> stars, _ = bd.simulate_matches(model, truth, 500, sigma=0.01, rng=rng)
    >>> vectors = distortion_vectors(bd.fit_linear(stars, model), grid=(9, 9))
    >>> ax = plot_distortion(vectors, Figure().subplots())
    >>> ax.get_aspect()
    1.0
    """
    ax, size = axes_of(ax), (float(vector_map.x[-1]), float(vector_map.y[-1]))
    arrows = Arrows.of_map(vector_map)
    M = distortion_magnification([vector_map]) if magnification is None else magnification
    chip_axes(ax, size, margin=arrows.reach(M, size) + BORDER * max(size))
    drawn = draw_arrows(ax, arrows, magnification=M, norm=length_norm([arrows]))
    if colorbar:
        add_colorbar(ax, drawn, "length [pix]")
    largest = _largest(vector_map)
    length = _key_length(largest / 1.5, "pix", scale_mas) if key is None else key
    draw_key(ax, length, magnification=M, scale_mas=scale_mas)
    shown = size_of(largest, digits=4) if scale_mas is None else size_of(largest * scale_mas, "mas")
    set_title(ax, title, f"largest {shown}", name, pad=KEY_PAD)
    return ax


def distortion_magnification(vectors: Sequence[VectorMap]) -> float:
    """Two-digit factor by which the longest vector of some maps is drawn as one grid step."""
    largest = max(map(_largest, vectors))
    return cell_magnification(min(Arrows.of_map(v).step for v in vectors), largest)


def _largest(vectors: VectorMap) -> float:
    """Largest length, in pixels of the detector."""
    return float(np.hypot(*vectors.on_detector).max())


def _key_length(below: float, unit: str, scale_mas: float | None) -> float:
    """Length of a key in `unit`, not above `below`, that is a round number when displayed."""
    factor = scale_mas if scale_mas is not None and unit == "pix" else 1.0
    return nice_below(below * factor) / factor
