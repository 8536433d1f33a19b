"""Two exposures laid on each other, through the old files and the new ones (Figures 27, 28)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayesdist.report.style import (
    WIDTH,
    draw_vectors,
    figure_style,
    new_figure,
    nice_below,
    vector_key,
)
from bayesdist.report.vectors import spacing

if TYPE_CHECKING:
    from bayesdist.assess import BinnedResiduals
    from bayesdist.report.campaign.context import OverlapTest

__all__ = ["IN_CELL", "largest_vector", "overlap_residuals"]

Float = NDArray[np.float64]

IN_CELL = 5  # stars that a cell must have to be drawn, and to count


def _drawn(binned: BinnedResiduals) -> NDArray[np.bool_]:
    return np.asarray(binned.count) >= IN_CELL


def largest_vector(binned: BinnedResiduals) -> float:
    """Longest mean vector of the cells that are drawn, pixels."""
    length = np.hypot(binned.mean_u, binned.mean_v)[_drawn(binned)]
    return float(length.max(initial=0.0))


def overlap_residuals(test: OverlapTest) -> Figure:
    """What shift, rotation and scale leave between two exposures, in cells: old and new.

    Parameters
    ----------
    test : OverlapTest

    Returns
    -------
    matplotlib.figure.Figure
    """
    b = test.binned_old
    step = spacing(b.x, b.y)
    drawn = _drawn(b)
    length = np.hypot(b.mean_u, b.mean_v)[drawn]
    typical = float(np.quantile(length, 0.95)) if length.size else 1.0
    M = nice_below(1.1 * step / typical) if typical > 0 else 1.0
    size = np.ptp(test.new.position, axis=0)
    middle = np.array(test.corner) + size / 2
    half = 0.56 * size
    with figure_style():
        fig = new_figure(WIDTH, 0.5 * WIDTH * float(np.clip(size[1] / size[0], 0.5, 1.6)) + 0.9,
                         layout="compressed")  # fmt: skip
        axes = fig.subplots(1, 2, sharex=True, sharey=True)
        for ax, which in zip(axes, ("old", "new"), strict=True):
            binned, found = getattr(test, f"binned_{which}"), getattr(test, which)
            ax.set_aspect("equal")
            ax.set_xlim(middle[0] - half[0], middle[0] + half[0])
            ax.set_ylim(middle[1] - half[1], middle[1] + half[1])
            gx, gy = np.meshgrid(binned.x - 0.5 + test.corner[0], binned.y - 0.5 + test.corner[1])
            cells = _drawn(binned)
            ax.plot(gx[cells], gy[cells], ".", ms=1.2, color="#A9B4C0", zorder=2)
            vectors = binned.mean_u[cells], binned.mean_v[cells]
            draw_vectors(ax, gx[cells], gy[cells], *vectors, magnification=M)
            rms = float(np.sqrt(np.mean(found.rms**2)))
            name = "known distortion" if which == "old" else "this run"
            ax.set_title(f"{name}: largest {largest_vector(binned):.3f}, rms {rms:.3f} pix", pad=20)
            ax.set_xlabel(r"$\xi$ [pix]")
            vector_key(ax, nice_below(typical), magnification=M, unit="pix")
        axes[0].set_ylabel(r"$\eta$ [pix]")
    return fig
