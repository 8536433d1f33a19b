"""Diagrams of a whole detector, its chips as one array: as Figures 4.1 to 4.5 of the ACS handbook.

They stand as pipelines have them, x to the right and y up; two of the handbook's are rotated by
180 degrees.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from bayesdist.assess.detector_numbers import detector_numbers
from bayesdist.report.numbers import display_scale
from bayesdist.report.style import (
    INK,
    PALETTE,
    WIDTH,
    draw_vectors,
    figure_style,
    new_figure,
    nice_below,
    vector_key,
)
from bayesdist.report.uncertainty import contour_levels, contour_map
from bayesdist.report.vectors import significant_cells

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bayesdist.assess import BinnedResiduals
from bayesdist.assess.whole_detector import WholeDetector

__all__ = ["area_figure", "non_linear_figure", "residual_figure"]

Float = NDArray[np.float64]

# Vectors, and points of contours, along the longer side of a chip.
_VECTORS, _POINTS = 21, 65


def non_linear_figure(
    detector: WholeDetector, title: str = "", *, magnification: float | None = None
) -> Figure:
    """What the best linear map of the detector leaves, as vectors.

    Parameters
    ----------
    detector : WholeDetector
    title : str
        What it is of.
    magnification : float, optional
        How much longer than the axes' pixels the vectors are; a round number by default.

    Returns
    -------
    matplotlib.figure.Figure
        Vectors along the detector's axes, in its pixels.
    """
    fields = [
        detector.non_linear(n, *_grid(c.basis.size, _VECTORS)) for n, c in detector.chips.items()
    ]
    found = detector_numbers(detector)
    step = min(float(f.x[1] - f.x[0]) for f in fields)
    longest = max(float(np.hypot(f.along_x, f.along_y).max()) for f in fields)
    M = magnification or (nice_below(2.5 * step / longest) if longest > 1e-9 * step else 1.0)
    fig, ax = _panel(detector, margin=M * longest + 0.01 * step)
    with figure_style():
        for f in fields:
            gx, gy = np.meshgrid(f.x, f.y)
            draw_vectors(ax, gx, gy, f.along_x, f.along_y, magnification=M)
        ring = {"ms": 6, "mfc": "none", "mec": PALETTE["vermilion"], "mew": 1.3, "zorder": 5}
        ax.plot(*found.non_linear_at, "o", **ring)
        x, y = found.non_linear_at
        text = f"largest {found.non_linear_max:.3g}\u202foutput pix at ({x:.0f}, {y:.0f})".replace(
            "-", "−"
        )
        ax.set_title(f"{title}\n{text}" if title else text, pad=11)
        vector_key(ax, nice_below(longest / 1.5), magnification=M, unit="pix")
    return fig


def area_figure(detector: WholeDetector, title: str = "") -> Figure:
    """Pixel area over that at the centre of the detector, as contours.

    Parameters
    ----------
    detector : WholeDetector
    title : str
        What it is of.

    Returns
    -------
    matplotlib.figure.Figure
    """
    grids = {n: _grid(c.basis.size, _POINTS) for n, c in detector.chips.items()}
    areas = {n: detector.relative_area(n, *grid) for n, grid in grids.items()}
    every = np.concatenate([a.ravel() for a in areas.values()])
    levels = contour_levels(every, 12)
    fig, ax = _panel(detector, margin=0.0, colorbar=True)
    with figure_style():
        for n, (x, y) in grids.items():
            px, py = detector.places[n]
            filled = contour_map(ax, x + px, y + py, areas[n], levels)
        text = f"pixel area {every.min():.3f} to {every.max():.3f} of that at the centre"
        ax.set_title(f"{title}\n{text}" if title else text)
        fig.colorbar(
            filled, ax=ax, label="pixel area / area at the centre", fraction=0.05, pad=0.02
        )
    return fig


def residual_figure(
    detector: WholeDetector,
    binned: Mapping[int, BinnedResiduals],
    unit: str,
    title: str = "",
) -> Figure:
    """Mean residuals of a fit in cells of the detector, as vectors.

    Parameters
    ----------
    detector : WholeDetector
    binned : mapping of int to BinnedResiduals
        By chip number; along the axes of (u, v).
    unit : str
        Of the residuals.
    title : str
        What it is of.

    Returns
    -------
    matplotlib.figure.Figure
        Cells whose mean lies within two of its standard errors from zero are light.
    """
    full = {n: (b.count > 0) & np.isfinite(b.mean_u + b.mean_v) for n, b in binned.items()}
    length = np.concatenate([np.hypot(b.mean_u, b.mean_v)[full[n]] for n, b in binned.items()])
    typical = float(np.quantile(length, 0.95)) if length.size else 0.0
    step = min(float(b.x[1] - b.x[0]) for b in binned.values())
    M = nice_below(1.1 * step / typical) if typical > 0 else 1.0
    fig, ax = _panel(detector, margin=0.6 * step)
    with figure_style():
        for n, b in binned.items():
            px, py = detector.places[n]
            gx, gy = np.meshgrid(b.x + px, b.y + py)
            clear = full[n] & significant_cells(b)
            for cells, color in ((full[n] & ~clear, "#A9B4C0"), (clear, INK)):
                vectors = b.mean_u[cells], b.mean_v[cells]
                draw_vectors(ax, gx[cells], gy[cells], *vectors, magnification=M, color=color)
        scale = display_scale(unit, typical)
        lines = [title, "dark: beyond 2 sigma", f"95 % of cells below {scale.text(typical)}"]
        ax.set_title("\n".join(line for line in lines if line), pad=11)
        vector_key(ax, nice_below(typical), magnification=M, unit=unit)
    return fig


def _panel(
    detector: WholeDetector, *, margin: float, colorbar: bool = False
) -> tuple[Figure, Axes]:
    """Figure with the outlines of all chips, at equal scale on both axes."""
    low, high = detector.bounds
    extent = high - low + 2 * margin
    width = 0.8 * WIDTH
    room = 0.8 + (0.7 if colorbar else 0.0)
    height = (width - room) * min(float(extent[1] / extent[0]), 1.6) + 0.9
    with figure_style():
        fig = new_figure(width, height, layout="compressed")
        ax = fig.subplots()
        ax.set_aspect("equal")
        ax.set_xlim(low[0] - margin, high[0] + margin)
        ax.set_ylim(low[1] - margin, high[1] + margin)
        ax.set_xlabel("x [pix]")
        ax.set_ylabel("y [pix]")
        _outlines(ax, detector)
    return fig, ax


def _outlines(ax: Axes, detector: WholeDetector) -> None:
    """Edges of all chips; those of one column are named at the right."""
    places = detector.places
    shift = max(abs(px) for px, _ in places.values())
    named = len(places) > 1 and shift < 0.5 * min(c.basis.size[0] for c in detector.chips.values())
    for n, (px, py) in places.items():
        nx, ny = detector.chips[n].basis.size
        corner = px + 0.5, py + 0.5
        ax.add_patch(Rectangle(corner, nx, ny, fill=False, lw=0.7, ec="#9AA5B1", zorder=4))
        if named:
            beside = ax.get_yaxis_transform()
            words = {"rotation": 270, "ha": "left", "va": "center", "fontsize": 7.5}
            ax.text(1.012, py + ny / 2, f"chip {n}", transform=beside, **words)


def _grid(size: tuple[float, float], longest: int) -> tuple[Float, Float]:
    """Columns and rows about as far apart on both axes, corners included."""
    nx, ny = (max(3, round((longest - 1) * n / max(size)) + 1) for n in size)
    return np.linspace(1.0, size[0], nx), np.linspace(1.0, size[1], ny)
