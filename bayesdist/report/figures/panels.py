"""Panels of a figure: one for each chip, or one for all chips as a single array."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from matplotlib.patheffects import withStroke

from bayesdist.assess.solution import ChipFrame
from bayesdist.report.figures.style import (
    HALF_WIDTH,
    INK,
    LARGE_WIDTH,
    OUTLINE,
    WIDTH,
    Tones,
    figure_style,
    new_figure,
)
from bayesdist.report.run import Mosaic
from bayesdist.utils.arrays import Float

Size = tuple[float, float]
ToPlane = Callable[[Float, Float], Float]  # function of pixels x, y that returns positions (2, N)

TALLEST_PANEL = 8.0  # inches
WIDE = 0.7  # ratio of rows to columns below which maps of a chip are drawn one above the other


class Panels:
    """Axes of a figure by chip and map; titles begin with the name of the chip if it has one."""

    def __init__(self, figure: Figure, axes: list[list[Axes]], names: Sequence[str]) -> None:
        self.figure, self.axes, self.names = figure, axes, tuple(names)

    @property
    def all_axes(self) -> list[Axes]:
        """Axes of all maps, without duplicates."""
        return list(dict.fromkeys(ax for maps in self.axes for ax in maps))

    def offset(self, chip: int) -> tuple[float, float]:
        """Offset in the axes of the pixels of a chip, counted from 0."""
        return 0.0, 0.0

    def frame_of(self, chip: int) -> ToPlane | None:
        """Function that converts pixels of a chip to positions in its axes; None for identity."""
        return None

    def title(self, chip: int, text: str, joined: str = ": ") -> str:
        """Title of a panel, with the name of the chip if there are several."""
        return f"{self.names[chip]}{joined}{text}" if self.names[chip] else text


class ChipPanels(Panels):
    """A panel for each map of each chip, arranged like the chips, all at the same scale.

    `maps`: number of maps per chip, one or two. `colorbar`: True to leave room for a common colour
    bar.
    """

    @figure_style()
    def __init__(self, mosaic: Mosaic, maps: int = 1, *, colorbar: bool = False) -> None:
        self.mosaic = mosaic
        columns = 1 + max(place[1] for place in mosaic.legible_places)
        rows = 1 + max(place[0] for place in mosaic.legible_places)
        aspect = mosaic.largest[1] / mosaic.largest[0]
        # maps of a chip are side by side; for a wide detector or chip one above the other
        side_by_side = columns == 1 if mosaic.several else aspect >= WIDE
        down, across = (rows, maps) if side_by_side else (maps * rows, columns)
        # panels in a single column share a line of the page with another figure
        narrow = aspect >= WIDE or down > 1
        width = WIDTH if across > 1 or not narrow else HALF_WIDTH
        margin = 0.75 + 0.55 * (across - 1) + (0.8 if colorbar else 0.0)
        height = down * (min((width - margin) / across * aspect, TALLEST_PANEL) + 0.8)
        figure = new_figure(width, height, layout="compressed")
        grid = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False)
        axes = [
            [grid[row, k] if side_by_side else grid[k * rows + row, column] for k in range(maps)]
            for row, column in mosaic.legible_places
        ]
        super().__init__(figure, axes, mosaic.names if mosaic.several else ("",))
        for ax in set(grid.ravel()) - set(self.all_axes):
            ax.remove()

    def frame(self, margin: float = 0.0) -> None:
        """Make all panels maps of their chips; `margin` is in pixels beyond the outline."""
        largest = self.mosaic.largest
        for size, maps in zip(self.mosaic.sizes, self.axes, strict=True):
            for ax in maps:
                chip_axes(ax, largest, margin=margin)
                ax.label_outer()
                if self.mosaic.several:
                    _label_edges(ax)
                if size != largest:
                    ax.add_patch(
                        Rectangle((0.5, 0.5), *size, fill=False, lw=0.9, ec="#5B6673", zorder=1)
                    )


class ArrayPanels(Panels):
    """Panels of several arrays with equal widths, each in its pixels, in two columns.

    `sizes`: columns and rows by name of the array. `colorbar`: True to leave room for a common
    colour bar.
    """

    @figure_style()
    def __init__(self, sizes: Mapping[str, Size], *, colorbar: bool = False) -> None:
        self.sizes = tuple(sizes.values())
        columns = min(2, len(sizes))
        rows = -(-len(sizes) // columns)
        width = WIDTH if columns > 1 else HALF_WIDTH
        panel = (width - 0.75 - 0.5 * (columns - 1) - (0.8 if colorbar else 0.0)) / columns
        aspect = max(ny / nx for nx, ny in self.sizes)
        figure = new_figure(width, rows * (panel * aspect + 0.72), layout="compressed")
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for ax in grid[len(sizes) :]:
            ax.remove()
        super().__init__(figure, [[ax] for ax in grid[: len(sizes)]], tuple(sizes))
        self._columns, self._rows = columns, rows

    def frame(self, margin: float = 0.0) -> None:
        """Make all panels maps; `margin` is a fraction of the longer side of each array."""
        n, differ = len(self.sizes), len(set(self.sizes)) > 1
        for k, (size, (ax,)) in enumerate(zip(self.sizes, self.axes, strict=True)):
            chip_axes(ax, size, margin=margin * max(size))
            ax.label_outer()
            if differ:  # tick labels of a neighbour do not apply
                ax.tick_params(labelbottom=True, labelleft=True)
            # a panel above an empty place in the last row
            if k // self._columns == self._rows - 2 and k + self._columns >= n:
                ax.tick_params(labelbottom=True)
                ax.set_xlabel("x [pix]")


class OneArray(Panels):
    """A single panel for all chips, as one array.

    `sizes`: columns and rows by chip number. `offsets`: added to the pixels of each chip.
    `margin`: room beyond the array in pixels. `colorbar`: True to leave room for a colour bar.
    """

    @figure_style()
    def __init__(
        self,
        sizes: Mapping[int, Size],
        offsets: Mapping[int, Size],
        *,
        margin: float = 0.0,
        colorbar: bool = False,
    ) -> None:
        self._offsets = [offsets[n] for n in sizes]
        corners = np.array(self._offsets) + 0.5
        low = corners.min(axis=0) - margin
        high = (corners + np.array(list(sizes.values()))).max(axis=0) + margin
        width = 0.8 * WIDTH
        room = 0.8 + (0.7 if colorbar else 0.0)
        aspect = float((high[1] - low[1]) / (high[0] - low[0]))
        figure = new_figure(width, (width - room) * min(aspect, 1.6) + 0.9, layout="compressed")
        ax = figure.subplots()
        ax.set(aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        ax.set(xlabel="x [pix]", ylabel="y [pix]")
        self._outline(ax, sizes)
        super().__init__(figure, [[ax]] * len(sizes), [""] * len(sizes))

    def offset(self, chip: int) -> tuple[float, float]:
        """Offset in the array of the pixels of a chip, counted from 0."""
        return self._offsets[chip]

    def _outline(self, ax: Axes, sizes: Mapping[int, Size]) -> None:
        """Draw the edges of all chips; chips in a single column are named at the right."""
        shift = max(abs(px) for px, _ in self._offsets)
        named = len(sizes) > 1 and shift < 0.5 * min(size[0] for size in sizes.values())
        for (number, (nx, ny)), (px, py) in zip(sizes.items(), self._offsets, strict=True):
            corner = px + 0.5, py + 0.5
            ax.add_patch(Rectangle(corner, nx, ny, fill=False, lw=0.7, ec=OUTLINE, zorder=4))
            if named:
                at_edge = ax.get_yaxis_transform()
                text = ax.text(1.012, py + ny / 2, f"chip {number}", transform=at_edge)
                text.set(rotation=270, ha="left", va="center", fontsize=7.5)


class FocalPlane(Panels):
    """A panel for each map that shows all chips at their positions in the focal plane.

    `outlines`: corners (4, 2) of each chip in pixels of the axes. `margin`: room beyond them in
    pixels. `colorbar`: True to leave room for a colour bar. `frames`: functions that convert pixels
    of each chip to the axes; not needed if the data are already in the focal plane.
    """

    @figure_style()
    def __init__(
        self,
        outlines: Sequence[Float],
        names: Sequence[str],
        *,
        maps: int = 1,
        frames: Sequence[ChipFrame] = (),
        margin: float = 0.0,
        colorbar: bool = False,
    ) -> None:
        self.frames = tuple(frames)
        corners = np.concatenate(outlines)
        low, high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
        width = LARGE_WIDTH if maps == 1 else WIDTH
        room = 0.75 * maps + (0.75 if colorbar else 0.0)
        aspect = float((high[1] - low[1]) / (high[0] - low[0]))
        height = (width - room) / maps * min(aspect, 1.6) + 0.9
        figure = new_figure(width, height, layout="compressed")
        row = list(figure.subplots(1, maps, sharey=True, squeeze=False)[0])
        for ax in row:
            ax.set(aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
            ax.set(xlabel="x [pix]", ylabel="y [pix]")
            ax.label_outer()
            for outline, name in zip(outlines, names, strict=True):
                ax.add_patch(Polygon(outline, fill=False, lw=0.7, ec=OUTLINE, zorder=4))
                if len(outlines) > 1:
                    ax.text(*outline.mean(axis=0), name, **_CHIP_NAME)
        super().__init__(figure, [row] * len(outlines), [""] * len(outlines))

    def frame_of(self, chip: int) -> ToPlane | None:
        """Function that converts pixels of a chip to positions in the focal plane."""
        return self.frames[chip] if self.frames else None


_CHIP_NAME: Any = {
    "ha": "center",
    "va": "center",
    "fontsize": 7.5,
    "color": INK,
    "zorder": 4,
    "alpha": 0.45,
    "path_effects": [withStroke(linewidth=1.5, foreground="white", alpha=0.5)],
    "clip_on": True,
}


OVERLAP = 0.2  # of the shorter side; smaller errors of sizes do not obscure the arrangement


def overlap(outlines: Sequence[Float]) -> bool:
    """True if chips overlap by more than `OVERLAP`."""
    for k, a in enumerate(outlines):
        for b in outlines[k + 1 :]:
            shared = np.minimum(a.max(axis=0), b.max(axis=0)) - np.maximum(
                a.min(axis=0), b.min(axis=0)
            )
            if shared.min() > OVERLAP * min(np.ptp(a, axis=0).min(), np.ptp(b, axis=0).min()):
                return True
    return False


def chip_axes(ax: Axes, size: Size, *, margin: float = 0.0) -> None:
    """Make axes a map of a chip: x to the right, y up, square pixels, outline drawn.

    `margin`: width of the border around the outline, in pixels.
    """
    nx, ny = size
    ax.set_aspect("equal")
    ax.set_xlim(0.5 - margin, nx + 0.5 + margin)
    ax.set_ylim(0.5 - margin, ny + 0.5 + margin)
    if margin > 0:
        color = Tones.of(ax).outline
        ax.add_patch(Rectangle((0.5, 0.5), nx, ny, fill=False, lw=0.7, ec=color, zorder=0))
    ax.set_xlabel("x [pix]")
    ax.set_ylabel("y [pix]")


def _label_edges(ax: Axes) -> None:
    """Label axes that are at the edge because no chip is below or to the left of them."""
    spec = ax.get_subplotspec()
    if spec is None:
        return
    neighbours = [o.get_subplotspec() for o in ax.figure.axes if o is not ax]
    position = spec.rowspan.start, spec.colspan.start
    places = [(o.rowspan.start, o.colspan.start) for o in neighbours if o is not None]
    if not any(row > position[0] and column == position[1] for row, column in places):
        ax.tick_params(labelbottom=True)
        ax.set_xlabel("x [pix]")
    if not any(column < position[1] and row == position[0] for row, column in places):
        ax.tick_params(labelleft=True)
        ax.set_ylabel("y [pix]")
