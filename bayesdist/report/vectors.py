"""Maps of vectors over the detector: the distortion itself, and what the fit leaves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayesdist.report.scales import display_scale
from bayesdist.report.style import (
    INK,
    PALETTE,
    detector_axes,
    detector_panels,
    draw_vectors,
    figure_style,
    nice_below,
    vector_key,
)

if TYPE_CHECKING:
    from bayesdist.assess import BinnedResiduals, VectorMap

__all__ = [
    "CHANCE",
    "grid_size",
    "residual_vectors",
    "significant_cells",
    "spacing",
    "square_cells",
    "vector_flow",
]

Float = NDArray[np.float64]

CHANCE = 0.0455  # how often noise alone puts one axis beyond 2 sigma
_SIGNIFICANT = -2.0 * np.log(CHANCE)  # chi-square of two axes that it passes as rarely


def grid_size(x: Float, y: Float) -> tuple[float, float]:
    """Columns and rows of the detector that an assessment grid spans from its first pixel on."""
    return float(np.max(x)), float(np.max(y))


def spacing(x: Float, y: Float) -> float:
    """Smaller distance between neighbouring places of a grid, in pixels."""
    steps = [np.diff(np.unique(a)) for a in (x, y)]
    return float(min((s.min() for s in steps if s.size), default=1.0))


def square_cells(x: Float, y: Float) -> tuple[slice, slice]:
    """Rows and columns of a map to draw, so that its arrows stand about as far apart on both axes.

    Only steps that keep both ends are taken: the corners are where distortions are largest.
    """
    steps = [(a[-1] - a[0]) / (len(a) - 1) for a in (y, x)]
    out = []
    for a, step in zip((y, x), steps, strict=True):
        stride = round(max(steps) / step)
        out.append(slice(None, None, stride if (len(a) - 1) % stride == 0 else 1))
    return out[0], out[1]


def _magnification(reach: float, length: float) -> float:
    """Round factor that draws a length about that far; 1 for one that is only rounding."""
    return nice_below(reach / length) if length > 1e-10 * reach else 1.0


def vector_flow(vectors: VectorMap, *, magnification: float | None = None) -> Figure:
    """Vector-flow diagram: from each array position towards where the distortion puts it.

    As section 4 of the WISE distortion report where the zeroth order is suppressed, and as
    Figure 4.1 of the ACS handbook for the non-linear part.

    Parameters
    ----------
    vectors : VectorMap
    magnification : float, optional
        How much longer than the axes' pixels the vectors are; a round number by default.

    Returns
    -------
    matplotlib.figure.Figure
        The vectors are in pixels along x and y, whatever the unit and orientation of u and v.
    """
    size = grid_size(vectors.x, vectors.y)
    rows, columns = square_cells(vectors.x, vectors.y)
    gx, gy = np.meshgrid(vectors.x[columns], vectors.y[rows])
    along_x, along_y = vectors.on_detector
    du, dv = along_x[rows, columns], along_y[rows, columns]
    length = np.hypot(along_x, along_y)
    largest = float(length.max())
    iy, ix = np.unravel_index(int(length.argmax()), length.shape)
    place = float(vectors.x[ix]), float(vectors.y[iy])
    # one and a half grid steps do not yet hide a vector's neighbours, as they flow alike
    step = spacing(vectors.x[columns], vectors.y[rows])
    M = magnification or _magnification(1.5 * step, largest)
    fig, (ax,) = detector_panels(1, size)
    with figure_style():
        reach_x = np.abs(gx + M * du - (size[0] + 1) / 2).max() - size[0] / 2
        reach_y = np.abs(gy + M * dv - (size[1] + 1) / 2).max() - size[1] / 2
        detector_axes(ax, size, margin=max(reach_x, reach_y, 0.0) + 0.02 * max(size))
        draw_vectors(ax, gx, gy, du, dv, magnification=M)
        ax.plot(*place, "o", ms=4.5, mfc="none", mec=PALETTE["vermilion"], mew=1.2)
        ax.set_title(
            f"largest {display_scale('pix', largest).text(largest, 4)}"
            f" at ({place[0]:.0f}, {place[1]:.0f})",
            pad=9,
        )
        vector_key(ax, nice_below(largest / 1.5), magnification=M, unit="pix")
    return fig


def residual_vectors(
    binned: BinnedResiduals,
    *,
    unit: str,
    size: tuple[float, float],
    magnification: float | None = None,
) -> Figure:
    """Mean residual vector of each cell of the detector.

    Cells whose mean lies within two of its standard errors from zero are drawn light: they are what
    noise alone would give.

    Parameters
    ----------
    binned : BinnedResiduals
        Empty cells hold NaN and stay empty.
    unit : str
        Unit of the residuals.
    size : tuple of float
        Columns and rows of the detector, in pixels.
    magnification : float, optional
        Pixels of the axes for one unit of the vectors; a round number by default.

    Returns
    -------
    matplotlib.figure.Figure
    """
    gx, gy = np.meshgrid(binned.x, binned.y)
    du, dv = np.asarray(binned.mean_u, float), np.asarray(binned.mean_v, float)
    filled = (np.asarray(binned.count) > 0) & np.isfinite(du) & np.isfinite(dv)
    significant = filled & significant_cells(binned)
    length = np.where(filled, np.hypot(du, dv), 0.0)
    # one bad cell with three stars must not flatten all others
    typical = float(np.quantile(length[filled], 0.95)) if filled.any() else 0.0
    M = magnification or _magnification(1.1 * spacing(binned.x, binned.y), typical)
    fig, (ax,) = detector_panels(1, size)
    with figure_style():
        detector_axes(ax, size, margin=0.03 * max(size))
        for k, color in ((filled & ~significant, "#A9B4C0"), (significant, INK)):
            draw_vectors(ax, gx[k], gy[k], du[k], dv[k], magnification=M, color=color)
        ax.plot(gx[filled], gy[filled], ".", ms=1.2, color="#A9B4C0", zorder=2)
        ax.set_title(
            f"{int(significant.sum())} of {int(filled.sum())} cells significant,\n"
            f"{CHANCE * filled.sum():.0f} by chance",
            pad=9,
        )
        vector_key(ax, nice_below(typical), magnification=M, unit=unit)
    return fig


def significant_cells(binned: BinnedResiduals) -> NDArray[np.bool_]:
    """Cells whose mean lies beyond 2 sigma from zero, both axes taken together.

    Parameters
    ----------
    binned : BinnedResiduals

    Returns
    -------
    ndarray of bool
        False where a standard error is unknown or zero.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        z2 = (binned.mean_u / binned.sem_u) ** 2 + (binned.mean_v / binned.sem_v) ** 2
    return np.isfinite(z2) & (z2 > _SIGNIFICANT)
