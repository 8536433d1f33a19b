"""How well the position is known over the detector: least squares beside the posterior."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from bayesdist.report.mosaic import Mosaic
from bayesdist.report.numbers import display_scale
from bayesdist.report.style import (
    CYCLE,
    INK,
    SEQUENTIAL,
    figure_style,
    nice_below,
    vector_key,
)
from bayesdist.report.vectors import grid_size, spacing, square_cells

if TYPE_CHECKING:
    from bayesdist.assess import UncertaintyMap

__all__ = ["contour_map", "crosses", "formal_uncertainty", "uncertainty_radius"]

Float = NDArray[np.float64]


def formal_uncertainty(
    *maps: UncertaintyMap, mosaic: Mosaic | None = None, magnification: float | None = None
) -> Figure:
    """Formal-uncertainty diagram: four vectors from each place, to (+-sigma_u, +-sigma_v).

    As section 6 of the WISE distortion report, which draws them 2000 times larger than the
    detector.  All maps are drawn to the same scale.

    Parameters
    ----------
    *maps : UncertaintyMap
        One, or least squares and posterior; of several chips these of each chip.
    mosaic : Mosaic, optional
        How the chips lie; one above the other by default.
    magnification : float, optional
        Pixels of the axes for one unit of the uncertainties; a round number by default.

    Returns
    -------
    matplotlib.figure.Figure
    """
    chips, mosaic = _by_chip(maps, mosaic)
    largest = max(float(np.max(m.radius)) for m in maps)
    widest = max(float(max(np.max(m.sigma_u), np.max(m.sigma_v))) for m in maps)
    # beyond half a grid step crosses overlap: a few do, in the corners, so that the inner ones show
    every = 2 if mosaic.several else 1  # panels of several chips are small
    step = min(_step(m, every) for m in maps)
    M = magnification or nice_below(0.8 * step / max(widest, 1e-300))
    margin = M * widest + 0.02 * max(max(s) for s in mosaic.sizes)
    fig, panels = mosaic.panels(len(chips[0]))
    with figure_style():
        for k, (axes, of_chip) in enumerate(zip(panels, chips, strict=True)):
            for ax, one, color in zip(axes, of_chip, CYCLE, strict=False):
                mosaic.draw(ax, k, margin=margin)
                ax.add_collection(
                    LineCollection(crosses(one, M, every), colors=color, linewidths=0.8)
                )
                radius = float(np.max(one.radius))
                text = display_scale(one.unit, radius).text(radius)
                title = mosaic.title(k, f"{one.kind}, max radius {text}", ", ")
                ax.set_title(title, pad=20)
                # one key serves all panels, but a panel that is cut out must state its scale too
                vector_key(ax, nice_below(largest), magnification=M, unit=one.unit)
    return fig


def _by_chip(
    maps: Sequence[UncertaintyMap], mosaic: Mosaic | None
) -> tuple[list[list[UncertaintyMap]], Mosaic]:
    """The maps of each chip, and how the chips lie."""
    numbers = dict.fromkeys(m.chip for m in maps)
    chips = [[m for m in maps if m.chip == number] for number in numbers]
    return chips, mosaic or Mosaic.column(*(grid_size(c[0].x, c[0].y) for c in chips))


def _step(m: UncertaintyMap, every: int) -> float:
    rows, columns = square_cells(m.x, m.y, every)
    return spacing(m.x[columns], m.y[rows])


def crosses(m: UncertaintyMap, magnification: float, every: int = 1) -> Float:
    """Four segments from each place, to all combinations of (+-sigma_u, +-sigma_v).

    Parameters
    ----------
    m : UncertaintyMap
    magnification : float
        Pixels of the axes for one unit of the uncertainties.
    every : int
        As of `square_cells`.

    Returns
    -------
    ndarray, shape (4 N, 2, 2)
        Ends (x, y) of each.
    """
    rows, columns = square_cells(m.x, m.y, every)
    gx, gy = np.meshgrid(m.x[columns], m.y[rows])
    start = np.stack([gx.ravel(), gy.ravel()], axis=-1)
    sigma = [s[rows, columns].ravel() for s in (m.sigma_u, m.sigma_v)]
    half = magnification * np.stack(sigma, axis=-1)
    ends = [start + half * np.array(s) for s in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    return np.concatenate([np.stack([start, end], axis=1) for end in ends])


def uncertainty_radius(*maps: UncertaintyMap, mosaic: Mosaic | None = None) -> Figure:
    """Radial uncertainty hypot(sigma_u, sigma_v) over the detector, all maps in one colour scale.

    Parameters
    ----------
    *maps : UncertaintyMap
        One, or least squares and posterior; of several chips these of each chip.
    mosaic : Mosaic, optional
        How the chips lie; one above the other by default.

    Returns
    -------
    matplotlib.figure.Figure
    """
    chips, mosaic = _by_chip(maps, mosaic)
    scale = display_scale(maps[0].unit, max(float(np.max(m.radius)) for m in maps))
    levels = contour_levels(np.concatenate([(m.radius * scale.factor).ravel() for m in maps]))
    fig, panels = mosaic.panels(len(chips[0]), colorbar=True)
    with figure_style():
        for k, (axes, of_chip) in enumerate(zip(panels, chips, strict=True)):
            for ax, one in zip(axes, of_chip, strict=True):
                radius = one.radius * scale.factor
                mosaic.draw(ax, k)
                filled = contour_map(ax, one.x, one.y, radius, levels, labels=False)
                x, y = one.position_of_max
                ring = {"ms": 5, "mfc": "none", "clip_on": False}
                ax.plot(x, y, "o", mec="white", mew=2.2, zorder=5, **ring)
                ax.plot(x, y, "o", mec=INK, mew=1.0, zorder=6, **ring)
                text = f"{one.kind}: {radius.min():.3g} to {radius.max():.3g}"
                ax.set_title(mosaic.title(k, text, ", "))
        every = [ax for axes in panels for ax in axes]
        fig.colorbar(
            filled, ax=every, label=f"radius (1 σ) [{scale.unit}]", fraction=0.05, pad=0.02
        )
    return fig


def contour_levels(values: Float, n: int = 10) -> Float:
    """Round levels that span some values, at least two."""
    low, high = float(np.min(values)), float(np.max(values))
    if not high > low:
        pad = max(abs(low), 1e-12) * 0.05
        low, high = low - pad, high + pad
    locator = MaxNLocator(n, steps=[1, 2, 2.5, 5, 10])
    return np.asarray(locator.tick_values(low, high), float)


def contour_map(
    ax: Axes, x: Float, y: Float, values: Float, levels: Float, *, labels: bool = True
) -> QuadContourSet:
    """Filled contours with lines between them, smooth between the places of the grid.

    What is drawn so comes from polynomials, which a spline through the grid follows closely.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
    x : ndarray, shape (nx,)
    y : ndarray, shape (ny,)
    values : ndarray, shape (ny, nx)
    levels : ndarray
        As of `contour_levels`.
    labels : bool
        Whether the lines carry their values.

    Returns
    -------
    matplotlib.contour.QuadContourSet
        The filled contours, for a colour bar.
    """
    spline = RectBivariateSpline(y, x, values, kx=min(3, len(y) - 1), ky=min(3, len(x) - 1))
    fine_x, fine_y = (np.linspace(a[0], a[-1], 4 * len(a)) for a in (x, y))
    # the spline may overshoot a little, and what is above the last level would stay white
    fine = np.clip(spline(fine_y, fine_x), values.min(), values.max())
    filled = ax.contourf(fine_x, fine_y, fine, levels, cmap=SEQUENTIAL)
    crossed = [v for v in levels if fine.min() < v < fine.max()]
    if crossed:
        lines = ax.contour(fine_x, fine_y, fine, crossed, colors="white", linewidths=0.6)
        if labels:
            ax.clabel(lines, fontsize=7, fmt=lambda v: f"{v:.4g}".replace("-", "−"))
    return filled
