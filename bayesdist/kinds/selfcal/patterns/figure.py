"""Figure of dither patterns: footprints and uncertainty maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from bayesdist.kinds.selfcal.patterns.dithers import PlannedPattern
from bayesdist.model.grid import mesh, outline_pixels
from bayesdist.report.figures.style import (
    COLORBAR,
    INK,
    PALETTE,
    SEQUENTIAL,
    WIDTH,
    figure_style,
    new_figure,
)
from bayesdist.utils.arrays import Float

if TYPE_CHECKING:
    from matplotlib.collections import QuadMesh

SHOWN = ("gauge-free", "shape")
ROW = 2.3  # inches
UNBOUNDED = "#E8ECF0"
FIRST = PALETTE["vermilion"]


@figure_style()
def pattern_maps(found: Sequence[PlannedPattern]) -> Figure:
    """Draw footprints and uncertainty maps of dither patterns, each on a common scale."""
    bounded = [
        pattern.per_axis(kind)
        for pattern in found
        for kind in SHOWN
        if pattern.maps[kind] is not None
    ]
    values = np.concatenate(bounded)
    norm = LogNorm(max(values.min(), 1e-4 * values.max()), values.max() * (1 + 1e-9))
    outlines = [_outlines(pattern) for pattern in found]
    limits = _limits(np.concatenate([o for of_one in outlines for o in of_one]))
    fig = new_figure(WIDTH, ROW * len(found) + 0.5, layout="compressed")
    axes = fig.subplots(len(found), 1 + len(SHOWN), squeeze=False)
    filled: list[QuadMesh] = []
    for k, (row, pattern, of_one) in enumerate(zip(axes, found, outlines, strict=True)):
        last = k == len(found) - 1
        _footprint(row[0], pattern, of_one, limits, last)
        row[0].set_title(
            f"first exposure in orange\n{pattern.pattern.name}" if not k else pattern.pattern.name
        )
        for ax, kind in zip(row[1:], SHOWN, strict=True):
            filled += _map(ax, pattern, kind, norm, last)
            if not k:
                ax.set_title(f"{kind}, rms\n{ax.get_title(loc='left')}")
    label = "per axis (1 σ) [pix]"
    fig.colorbar(filled[0], ax=list(axes[:, 1:].ravel()), label=label, **COLORBAR)
    return fig


def _outlines(one: PlannedPattern) -> list[Float]:
    """Outline (N, 2) of every chip in every exposure, on the sky."""
    model, theta = one.solution.model, one.solution.mean
    return [
        model.predict(theta, *outline_pixels(chip.size), exposure=e, chip=chip.number)
        for e in range(len(model.exposures))
        for chip in model.chips
    ]


def _limits(points: Float) -> tuple[Float, Float]:
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = (low + high) / 2, 0.52 * float((high - low).max())
    return middle - half, middle + half


def _footprint(
    ax: Axes,
    one: PlannedPattern,
    outlines: Sequence[Float],
    limits: tuple[Float, Float],
    last: bool,
) -> None:
    chips = len(one.camera.chips)
    for k, outline in reversed(list(enumerate(outlines))):
        first = k < chips
        ax.plot(*outline.T, lw=1.1 if first else 0.5, color=FIRST if first else INK,
                alpha=1.0 if first else 0.45)  # fmt: skip
    (x0, y0), (x1, y1) = limits
    ax.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
    ax.set_ylabel("v [pix]")
    _sky_axis(ax, last)


def _map(ax: Axes, one: PlannedPattern, kind: str, norm: LogNorm, last: bool) -> list[QuadMesh]:
    """Draw the chips as in the first exposure; a text instead of values for unbounded errors."""
    model, theta, maps = one.solution.model, one.solution.mean, one.maps[kind]
    outlines = [
        model.predict(theta, *outline_pixels(c.size), exposure=0, chip=c.number)
        for c in model.chips
    ]
    filled = []
    for m in maps or ():
        x, y = mesh(m.x, m.y)
        u, v = model.predict(theta, x, y, exposure=0, chip=m.chip).T.reshape(2, len(m.y), len(m.x))
        look: dict[str, Any] = {"cmap": SEQUENTIAL, "shading": "gouraud", "rasterized": True}
        filled.append(ax.pcolormesh(u, v, m.per_axis, norm=norm, **look))
    (x0, y0), (x1, y1) = _limits(np.concatenate(outlines))
    ax.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
    if maps is None:
        ax.set_title("not bounded")
        ax.set_facecolor(UNBOUNDED)
    else:
        ax.set_title(f"{one.rms(kind):.2g}, max {one.largest(kind):.2g} pix")
    ax.tick_params(labelleft=False)
    _sky_axis(ax, last)
    return filled


def _sky_axis(ax: Axes, last: bool) -> None:
    ax.tick_params(labelbottom=last)
    ax.locator_params(nbins=4)
    if last:
        ax.set_xlabel("u [pix]")
