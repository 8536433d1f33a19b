"""Figures of a whole detector with all chips as one array, like Figures 4.1 to 4.5 of the handbook.

They are oriented as in pipelines, with x to the right and y upwards.  Two figures of the ACS
handbook are rotated by 180 degrees relative to these.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from bayesdist.missions.hst.handbook.numbers import detector_numbers
from bayesdist.missions.hst.handbook.whole_detector import WholeDetector
from bayesdist.model.grid import mesh
from bayesdist.report.figures.arrows import Arrows, magnification_of, vector_map
from bayesdist.report.figures.fields import Grid, contour_levels, scalar_map
from bayesdist.report.figures.panels import OneArray
from bayesdist.report.figures.style import PALETTE, nice_below
from bayesdist.utils.arrays import Float
from bayesdist.utils.numbers import size_of

if TYPE_CHECKING:
    from bayesdist.diagnose.residuals.binned import BinnedResiduals

# numbers of vectors, and of points for contours, along the longer side of a chip
_VECTORS, _POINTS = 21, 65


def non_linear_figure(
    detector: WholeDetector, title: str = "", *, magnification: float | None = None
) -> Figure:
    """Vector plot of the residuals from the best linear map of the detector, in its pixels.

    `magnification` is the factor by which vectors are enlarged, by default a round number.
    """
    numbers, sizes, chips = detector_numbers(detector), _sizes(detector), []
    for n, size in sizes.items():
        x, y = _grid(size, _VECTORS)
        f = detector.non_linear(n, x, y)
        along = f.along_x.ravel(), f.along_y.ravel()
        chips.append(Arrows(*mesh(x, y), *along, float(x[1] - x[0])))
    step = min(arrows.step for arrows in chips)
    longest = max(float(arrows.length.max()) for arrows in chips)
    M = magnification or (nice_below(2.5 * step / longest) if longest > 1e-9 * step else 1.0)
    panels = OneArray(sizes, detector.places, margin=M * longest + 0.01 * step)
    place = numbers.non_linear_at
    at = f"({place[0]:.0f}, {place[1]:.0f})"
    text = f"largest {numbers.non_linear_max:.3g}\u202foutput pix at {at}"
    text = text.replace("-", "−")
    vector_map(
        panels,
        chips,
        [f"{title}\n{text}" if title else text],
        magnification=M,
        key=nice_below(longest / 1.5),
        pad=11,
    )
    ring: dict[str, Any] = {
        "ms": 6,
        "mfc": "none",
        "mec": PALETTE["vermilion"],
        "mew": 1.3,
        "zorder": 5,
    }
    panels.all_axes[0].plot(*place, "o", **ring)
    return panels.figure


def area_figure(detector: WholeDetector, title: str = "") -> Figure:
    """Contour plot of the pixel area relative to that at the centre of the detector."""
    sizes = _sizes(detector)
    grids = []
    for n, size in sizes.items():
        x, y = _grid(size, _POINTS)
        grids.append(Grid(x, y, detector.relative_area(n, x, y)))
    areas = np.concatenate([g.values.ravel() for g in grids])
    panels = OneArray(sizes, detector.places, colorbar=True)
    text = f"pixel area {areas.min():.3f} to {areas.max():.3f} of that at the centre"
    scalar_map(
        panels,
        grids,
        [f"{title}\n{text}" if title else text],
        levels=contour_levels(areas, 12),
        label="pixel area / area at the centre",
        labelled=True,
    )
    return panels.figure


def residual_figure(
    detector: WholeDetector,
    binned: Mapping[int, BinnedResiduals],
    unit: str,
    title: str = "",
) -> Figure:
    """Vector plot of the mean residuals of a fit in cells of the detector.

    `binned` are the residuals by chip number, along the axes of (u, v).  Cells with a mean within
    two standard errors of zero are drawn in light colour.
    """
    chips = [Arrows.of_cells(b) for b in binned.values()]
    length = np.concatenate([arrows.length for arrows in chips])
    typical = float(np.quantile(length, 0.95)) if length.size else 0.0
    step = min(float(b.x[1] - b.x[0]) for b in binned.values())
    sizes = {n: _sizes(detector)[n] for n in binned}
    panels = OneArray(sizes, detector.places, margin=0.6 * step)
    lines = [
        title,
        "dark: beyond 2 sigma",
        f"95 % of cells below {size_of(typical, unit)}",
    ]
    vector_map(
        panels,
        chips,
        ["\n".join(line for line in lines if line)],
        magnification=magnification_of(1.1 * step, typical),
        key=nice_below(typical),
        unit=unit,
        pad=11,
    )
    return panels.figure


def _sizes(detector: WholeDetector) -> dict[int, tuple[float, float]]:
    return {n: c.basis.size for n, c in detector.chips.items()}


def _grid(size: tuple[float, float], longest: int) -> tuple[Float, Float]:
    """Columns and rows of a grid that includes the corners, with similar spacing on both axes."""
    nx, ny = (max(3, round((longest - 1) * n / max(size)) + 1) for n in size)
    return np.linspace(1.0, size[0], nx), np.linspace(1.0, size[1], ny)
