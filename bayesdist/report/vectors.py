"""Maps of vectors over the detector: the distortion itself, and what the fit leaves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from bayesdist.report.mosaic import Mosaic
from bayesdist.report.numbers import display_scale
from bayesdist.report.style import (
    INK,
    PALETTE,
    draw_vectors,
    figure_style,
    nice_below,
    vector_key,
)

if TYPE_CHECKING:
    from bayesdist.assess import BinnedResiduals, VectorMap

__all__ = [
    "CHANCE",
    "VectorFlow",
    "grid_size",
    "residual_vectors",
    "significant_cells",
    "spacing",
    "square_cells",
    "vector_flow",
]

Float = NDArray[np.float64]

CHANCE = 0.0455  # how often noise alone puts one axis beyond 2 sigma


def grid_size(x: Float, y: Float) -> tuple[float, float]:
    """Columns and rows of the detector that an assessment grid spans from its first pixel on."""
    return float(np.max(x)), float(np.max(y))


def spacing(x: Float, y: Float) -> float:
    """Smaller distance between neighbouring places of a grid, in pixels."""
    steps = [np.diff(np.unique(a)) for a in (x, y)]
    return float(min((s.min() for s in steps if s.size), default=1.0))


def square_cells(x: Float, y: Float, every: int = 1) -> tuple[slice, slice]:
    """Rows and columns of a map to draw, so that its arrows stand about as far apart on both axes.

    With `every`, only every so manieth of these, for small panels.  Only steps that keep both ends
    are taken: the corners are where distortions are largest.
    """
    steps = [(a[-1] - a[0]) / (len(a) - 1) for a in (y, x)]
    out = []
    for a, step in zip((y, x), steps, strict=True):
        stride = round(max(steps) / step)
        fitting = [s for s in (stride * every, stride, 1) if (len(a) - 1) % s == 0]
        out.append(slice(None, None, fitting[0]))
    return out[0], out[1]


def _magnification(reach: float, length: float) -> float:
    """Round factor that draws a length about that far; 1 for one that is only rounding."""
    return nice_below(reach / length) if length > 1e-10 * reach else 1.0


def vector_flow(
    *vectors: VectorMap, mosaic: Mosaic | None = None, magnification: float | None = None
) -> Figure:
    """Vector-flow diagram: from each array position towards where the distortion puts it.

    As section 4 of the WISE distortion report where the zeroth order is suppressed, and as
    Figure 4.1 of the ACS handbook for the non-linear part.

    Parameters
    ----------
    *vectors : VectorMap
        One for each chip; all are drawn to the same scale.
    mosaic : Mosaic, optional
        How the chips lie; one above the other by default.
    magnification : float, optional
        How much longer than the axes' pixels the vectors are; a round number by default.

    Returns
    -------
    matplotlib.figure.Figure
        The vectors are in pixels along x and y, whatever the unit and orientation of u and v.
    """
    flows = [VectorFlow.of(v) for v in vectors]
    mosaic = mosaic or Mosaic.column(*(f.size for f in flows))
    largest = max(f.largest for f in flows)
    M = magnification or min(f.magnification for f in flows)
    margin = max(f.reach(M) for f in flows) + 0.02 * max(max(f.size) for f in flows)
    fig, panels = mosaic.panels()
    with figure_style():
        for k, (f, (ax,)) in enumerate(zip(flows, panels, strict=True)):
            mosaic.draw(ax, k, margin=margin)
            f.draw(ax, M)
            text = (
                f"largest {display_scale('pix', f.largest).text(f.largest, 4)}"
                f" at ({f.place[0]:.0f}, {f.place[1]:.0f})"
            )
            ax.set_title(mosaic.title(k, text), pad=9)
            vector_key(ax, nice_below(largest / 1.5), magnification=M, unit="pix")
    return fig


@dataclass(frozen=True, eq=False)
class VectorFlow:
    """Vectors of one chip as they are drawn, and the largest of all of them.

    Parameters
    ----------
    gx, gy, du, dv : ndarray
        Places and vectors that are drawn, pixels of the chip.
    largest : float
        Length of the largest vector of the map, drawn or not.
    place : tuple of float
        Where that is.
    size : tuple of float
        Columns and rows of the chip.
    step : float
        Between neighbouring vectors, in pixels.
    """

    gx: Float
    gy: Float
    du: Float
    dv: Float
    largest: float
    place: tuple[float, float]
    size: tuple[float, float]
    step: float

    @classmethod
    def of(cls, vectors: VectorMap, every: int = 1) -> VectorFlow:
        """Those of a map that stand far enough apart; with `every`, only every so manieth."""
        rows, columns = square_cells(vectors.x, vectors.y, every)
        gx, gy = np.meshgrid(vectors.x[columns], vectors.y[rows])
        along_x, along_y = vectors.on_detector
        length = np.hypot(along_x, along_y)
        iy, ix = np.unravel_index(int(length.argmax()), length.shape)
        return cls(
            gx=gx,
            gy=gy,
            du=along_x[rows, columns],
            dv=along_y[rows, columns],
            largest=float(length.max()),
            place=(float(vectors.x[ix]), float(vectors.y[iy])),
            size=grid_size(vectors.x, vectors.y),
            step=spacing(vectors.x[columns], vectors.y[rows]),
        )

    @property
    def magnification(self) -> float:
        """Round factor under which the largest vector does not hide its neighbours."""
        # one and a half grid steps do not yet, as they flow alike
        return _magnification(1.5 * self.step, self.largest)

    def reach(self, magnification: float) -> float:
        """How far the vectors stand out beyond the chip, in pixels."""
        (nx, ny), M = self.size, magnification
        reach_x = np.abs(self.gx + M * self.du - (nx + 1) / 2).max() - nx / 2
        reach_y = np.abs(self.gy + M * self.dv - (ny + 1) / 2).max() - ny / 2
        return float(max(reach_x, reach_y, 0.0))

    def draw(self, ax: Axes, magnification: float, *, fine: bool = False) -> None:
        """The vectors, in small panels with fine arrows, and a ring about the largest."""
        arrows = draw_vectors(ax, self.gx, self.gy, self.du, self.dv, magnification=magnification)
        if fine:
            arrows.width, arrows.headwidth, arrows.headlength = 0.007, 3.2, 4.0
            arrows.headaxislength = 3.6
        ax.plot(*self.place, "o", ms=4.5, mfc="none", mec=PALETTE["vermilion"], mew=1.2)


def residual_vectors(
    *binned: BinnedResiduals,
    unit: str,
    mosaic: Mosaic,
    magnification: float | None = None,
    key: float | None = None,
) -> Figure:
    """Mean residual vector of each cell of the detector.

    Cells whose mean lies within two of its standard errors from zero are drawn light: they are what
    noise alone would give.

    Parameters
    ----------
    *binned : BinnedResiduals
        One for each chip; all are drawn to the same scale.  Empty cells hold NaN and stay empty.
    unit : str
        Unit of the residuals.
    mosaic : Mosaic
        Sizes of the chips, and how they lie.
    magnification : float, optional
        Pixels of the axes for one unit of the vectors; a round number by default.
    key : float, optional
        Length of the arrow that states the scale; that of a typical vector by default.

    Returns
    -------
    matplotlib.figure.Figure
    """
    filled = [
        (np.asarray(b.count) > 0) & np.isfinite(b.mean_u) & np.isfinite(b.mean_v) for b in binned
    ]
    length = np.concatenate(
        [np.hypot(b.mean_u, b.mean_v)[full] for b, full in zip(binned, filled, strict=True)]
    )
    # one bad cell with three stars must not flatten all others
    typical = float(np.quantile(length, 0.95)) if length.size else 0.0
    step = min(spacing(b.x, b.y) for b in binned)
    M = magnification or _magnification(1.1 * step, typical)
    fig, panels = mosaic.panels()
    with figure_style():
        for k, (b, full, (ax,)) in enumerate(zip(binned, filled, panels, strict=True)):
            gx, gy = np.meshgrid(b.x, b.y)
            significant = full & significant_cells(b)
            mosaic.draw(ax, k, margin=0.03 * max(max(s) for s in mosaic.sizes))
            for cells, color in ((full & ~significant, "#A9B4C0"), (significant, INK)):
                vectors = b.mean_u[cells], b.mean_v[cells]
                draw_vectors(ax, gx[cells], gy[cells], *vectors, magnification=M, color=color)
            ax.plot(gx[full], gy[full], ".", ms=1.2, color="#A9B4C0", zorder=2)
            text = (
                f"{int(significant.sum())} of {int(full.sum())} cells significant,\n"
                f"{CHANCE * full.sum():.0f} by chance"
            )
            ax.set_title(mosaic.title(k, text), pad=9)
            vector_key(ax, key or nice_below(typical), magnification=M, unit=unit)
    return fig


def significant_cells(binned: BinnedResiduals) -> NDArray[np.bool_]:
    """Cells whose mean lies so far from zero as noise puts it with probability `CHANCE`.

    Parameters
    ----------
    binned : BinnedResiduals

    Returns
    -------
    ndarray of bool
        False where a standard error is unknown or zero.
    """
    # the errors are those of as few stars as the cell has: the tails are nearly Fisher's
    beyond = 2.0 * f_distribution.isf(CHANCE, 2, np.maximum(binned.count - 1, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        z2 = (binned.mean_u / binned.sem_u) ** 2 + (binned.mean_v / binned.sem_v) ** 2
    return np.isfinite(z2) & (z2 > beyond)
