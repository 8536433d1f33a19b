"""Maps in panels, as contours or cells, with one colour scale or a scale for each map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import BoundaryNorm, Colormap, Normalize
from matplotlib.contour import QuadContourSet
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import distance_transform_edt

from bayesdist.report.figures.panels import Panels, ToPlane
from bayesdist.report.figures.style import COLORBAR, INK, SEQUENTIAL, figure_style, small_font
from bayesdist.utils.arrays import Float

Drawn = QuadContourSet | AxesImage | QuadMesh
EMPTY = "#D9DEE3"  # colour of a cell without a value
NARROW = 1.5  # ratio of largest to smallest error, below which linear levels are used
MANTISSAS = (  # of logarithmic levels, 3 to 40 per decade
    (1.0, 2.0, 5.0),
    (1.0, 1.5, 2.0, 3.0, 5.0, 7.0),
    (1.0, 1.25, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0, 6.3, 8.0),
    tuple(np.round(10 ** (np.arange(20) / 20), 2)),
    tuple(np.round(10 ** (np.arange(40) / 40), 2)),
)
FAR = 15.0  # ratio of values, above which linear levels would show only the largest ones


@dataclass(frozen=True, eq=False)
class Grid:
    """Values on a grid over one chip."""

    x: Float  # (nx,), points or centres of cells, pixels
    y: Float  # (ny,)
    values: Float  # (ny, nx), in the displayed unit
    ring: tuple[float, float] | None = None  # position marked by a ring


def contour_levels(values: ArrayLike, n: int = 10) -> Float:
    """Round levels that span the values, at least two; 1, 2, 5, 10 if the range is large."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if low > 0 and high > FAR * low:
        decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
        steps = np.outer(decades, [1.0, 2.0, 5.0]).ravel()
        return steps[max(int((steps <= low).sum()) - 1, 0) : int((steps < high).sum()) + 1]
    if not high > low:
        pad = max(abs(low), 1e-12) * 0.05
        low, high = low - pad, high + pad
    locator = MaxNLocator(n, steps=[1, 2, 2.5, 5, 10])
    return np.asarray(locator.tick_values(low, high), float)


def error_levels(values: ArrayLike, least: int = 7) -> Float:
    """Round levels for errors, in approximately equal logarithmic steps.

    At least `least` levels are within the range of the values. Levels are linear if values are not
    positive, or differ by less than a factor of 1.5.
    """
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if not (low > 0 and high >= NARROW * low):
        return contour_levels(values)
    decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    for mantissas in MANTISSAS:
        levels = np.outer(decades, mantissas).ravel()
        if ((levels > low) & (levels < high)).sum() >= least:
            break
    first, last = (levels <= low).sum() - 1, (levels < high).sum()
    return levels[max(int(first), 0) : int(last) + 1]


@figure_style()
def scalar_map(
    panels: Panels,
    grids: Sequence[Grid | None],
    titles: Sequence[str],
    *,
    label: str = "",
    levels: Float | None = None,
    norm: Normalize | Sequence[Normalize] | None = None,
    cmap: str | Colormap = SEQUENTIAL,
    labelled: bool = False,
) -> None:
    """Draw the maps of each chip, as contours or cells.

    `grids`: maps of the first chip, followed by those of the next one, in framed `panels`.
    `label`: label of the colour bar with its unit; empty for no colour bar. `levels`: levels of
    contours; cells are drawn without it. `labelled`: True to show the values of contours. `norm`:
    one scale for all maps, or a scale for each map, with its colour bar.
    """
    drawn: dict[Axes, Drawn] = {}
    places = [(k, ax) for k, maps in enumerate(panels.axes) for ax in maps]
    single = norm is None or isinstance(norm, Normalize)
    norms: Sequence[Normalize | None] = (
        [norm] * len(places) if norm is None or isinstance(norm, Normalize) else norm
    )
    for (k, ax), grid, map_norm in zip(places, grids, norms, strict=True):
        if grid is None:
            continue
        look: dict[str, Any] = {
            "levels": levels,
            "norm": map_norm,
            "cmap": cmap,
            "labelled": labelled,
        }
        drawn[ax] = draw_grid(ax, grid, panels.offset(k), frame=panels.frame_of(k), **look)
    for ax, title in zip(panels.all_axes, titles, strict=True):
        ax.set_title(title)
    if not label or not drawn:
        return
    look = {"label": label, **COLORBAR}
    if levels is not None or single:
        last = list(drawn.values())[-1]
        if levels is None:
            look["extend"] = _extend(grids, last.get_clim())
        panels.figure.colorbar(last, ax=panels.all_axes, **look)
    else:
        for ax, image in drawn.items():
            look["extend"] = _extend([grids[panels.all_axes.index(ax)]], image.get_clim())
            panels.figure.colorbar(image, ax=ax, **look)


def draw_grid(
    ax: Axes,
    grid: Grid,
    offset: tuple[float, float] = (0.0, 0.0),
    *,
    frame: ToPlane | None = None,
    levels: Float | None = None,
    norm: Normalize | None = None,
    cmap: str | Colormap = SEQUENTIAL,
    labelled: bool = False,
) -> Drawn:
    """Draw the values of a grid as contours between `levels`, or as cells, with its ring.

    `offset`: offset of the pixels of the grid in the axes. `frame`: function that converts pixels
    to positions in the axes, used instead of `offset`. `labelled`: True to show the values of
    contours.
    """
    if levels is not None:
        drawn: Drawn = _contours(ax, grid, offset, levels, frame=frame, labelled=labelled)
    elif frame is not None:
        drawn = _turned_cells(ax, grid, frame, norm, cmap)
    else:
        drawn = _cells(ax, grid, offset, norm, cmap)
    if grid.ring is not None:
        at = np.add(grid.ring, offset)
        if frame is not None:
            at = frame(*np.array(grid.ring)[:, None])[:, 0]
        # dark on light, visible on every colour of the map in every style
        for color, width, order in (("white", 2.2, 5), (INK, 1.0, 6)):
            ax.plot(*at, "o", ms=5, mfc="none", mec=color, mew=width, clip_on=False, zorder=order)
    return drawn


def _contours(
    ax: Axes,
    grid: Grid,
    offset: tuple[float, float],
    levels: Float,
    *,
    frame: ToPlane | None,
    labelled: bool,
) -> QuadContourSet:
    """Draw filled contours with lines between them; a spline suits maps that are polynomials.

    Nothing is drawn around positions without a value, outside the field of a detector.
    """
    x, y, values = grid.x, grid.y, grid.values
    empty = ~np.isfinite(values)
    if empty.any():  # a spline needs all values: use the nearest ones, which are masked later
        nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
        values = values[tuple(nearest)]
    spline = RectBivariateSpline(y, x, values, kx=min(3, len(y) - 1), ky=min(3, len(x) - 1))
    fine_x, fine_y = (np.linspace(a[0], a[-1], 4 * len(a)) for a in (x, y))
    # the spline may overshoot slightly, and values above the last level would remain white
    fine = np.clip(spline(fine_y, fine_x), values.min(), values.max())
    if empty.any():
        rows, columns = (
            np.abs(fine_a[:, None] - a).argmin(axis=1) for fine_a, a in ((fine_y, y), (fine_x, x))
        )
        fine = np.ma.masked_array(fine, empty[np.ix_(rows, columns)])
    at = fine_x + offset[0], fine_y + offset[1]
    if frame is not None:
        at = _in_plane(frame, fine_x, fine_y)
    even = np.ptp(np.diff(levels)) <= 1e-6 * levels[-1]
    norm = None if even else BoundaryNorm(levels, colormaps[SEQUENTIAL].N)
    filled = ax.contourf(*at, fine, levels, cmap=SEQUENTIAL, norm=norm)
    crossed = [v for v in levels if fine.min() < v < fine.max()]
    if crossed:
        lines = ax.contour(*at, fine, crossed, colors="white", linewidths=0.6)
        if labelled:
            digits = max(len(f"{v:.10g}".partition(".")[2]) for v in levels)
            ax.clabel(
                lines, fontsize=small_font(), fmt=lambda v: f"{v:.{digits}f}".replace("-", "−")
            )
    return filled


def _in_plane(frame: ToPlane, x: Float, y: Float) -> tuple[Float, Float]:
    """Positions (ny, nx) of a grid of pixels in the focal plane."""
    X, Y = np.meshgrid(x, y)
    at = frame(X.ravel(), Y.ravel())
    return at[0].reshape(X.shape), at[1].reshape(X.shape)


def _turned_cells(
    ax: Axes, grid: Grid, frame: ToPlane, norm: Normalize | None, cmap: str | Colormap
) -> QuadMesh:
    """Draw cells in the focal plane, where chips may be rotated."""
    edges = []
    for a in (grid.x, grid.y):
        half = 0.5 * (a[-1] - a[0]) / max(len(a) - 1, 1)
        edges.append(np.linspace(a[0] - half, a[-1] + half, len(a) + 1))
    values = np.ma.masked_invalid(grid.values)
    return ax.pcolormesh(*_in_plane(frame, *edges), values, norm=norm, cmap=cmap, rasterized=True)


def _cells(
    ax: Axes, grid: Grid, offset: tuple[float, float], norm: Normalize | None, cmap: str | Colormap
) -> AxesImage:
    """Draw cells of uniform colour."""
    limits = ax.get_xlim(), ax.get_ylim()
    if not np.isfinite(grid.values).all():
        ax.set_facecolor(EMPTY)
    edges = []
    for a, shift in zip((grid.x, grid.y), offset, strict=True):
        half = 0.5 * (a[-1] - a[0]) / max(len(a) - 1, 1)
        edges += [a[0] - half + shift, a[-1] + half + shift]
    image = ax.imshow(
        grid.values,
        origin="lower",
        extent=tuple(edges),
        cmap=cmap,
        norm=norm,
        aspect="equal",
        interpolation="nearest",
    )
    ax.set(xlim=limits[0], ylim=limits[1])  # imshow has changed the limits
    return image


def _extend(grids: Sequence[Grid | None], limits: tuple[float, float]) -> str:
    """Ends of the colour bar beyond which there are values, in the terms of matplotlib."""
    low, high = limits
    values = np.concatenate([g.values[np.isfinite(g.values)] for g in grids if g is not None])
    below, above = (values < low).any(), (values > high).any()
    return {(0, 0): "neither", (1, 0): "min", (0, 1): "max"}.get((int(below), int(above)), "both")
