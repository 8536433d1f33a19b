"""Maps of a detector of one or many chips: one panel for each chip, placed as the chips lie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from bayesdist.model import Chip
from bayesdist.report.style import (
    WIDTH,
    detector_axes,
    detector_panels,
    figure_style,
    new_figure,
)

__all__ = ["Mosaic"]

Size = tuple[float, float]

MOST_COLUMNS = 3  # of panels: more would be too narrow to be read


@dataclass(frozen=True)
class Mosaic:
    """Chips of a detector, as figures show them.

    Parameters
    ----------
    sizes : tuple of (float, float)
        Columns and rows of each chip, in pixels.
    names : tuple of str
        Of each chip; panels of several chips carry them.
    places : tuple of (int, int)
        Row (0 on top) and column of each chip.
    """

    sizes: tuple[Size, ...]
    names: tuple[str, ...] = ("",)
    places: tuple[tuple[int, int], ...] = ((0, 0),)

    @classmethod
    def of_chips(cls, chips: Sequence[Chip], places: Sequence[tuple[int, int]]) -> Mosaic:
        """Chips of a model, which go by their names where there are several."""
        names = tuple(chip.name if len(chips) > 1 else "" for chip in chips)
        return cls(tuple(chip.size for chip in chips), names, tuple(places))

    @classmethod
    def column(cls, *sizes: Size) -> Mosaic:
        """Chips one above the other, the first on top, with numbers for names."""
        n = range(len(sizes))
        return cls(sizes, tuple(f"chip {k + 1}" for k in n), tuple((k, 0) for k in n))

    @property
    def several(self) -> bool:
        """Whether there is more than one chip."""
        return len(self.sizes) > 1

    def title(self, chip: int, text: str, joined: str = ": ") -> str:
        """A panel's title, which names the chip where there are several."""
        return f"{self.names[chip]}{joined}{text}" if self.several else text

    def panels(self, n: int = 1, *, colorbar: bool = False) -> tuple[Figure, list[list[Axes]]]:
        """Figure with n maps of each chip, all at one scale.

        Parameters
        ----------
        n : int
            Maps of the same chip: one or two.
        colorbar : bool
            Whether room for one shared colour bar is needed.

        Returns
        -------
        fig : matplotlib.figure.Figure
        axes : list of list of matplotlib.axes.Axes
            For each chip those of its maps.
        """
        if not self.several:
            fig, axes = detector_panels(n, self.sizes[0], colorbar=colorbar)
            return fig, [axes]
        places = self._legible_places()
        rows, columns = (max(p[k] for p in places) + 1 for k in (0, 1))
        # chips in one column have their maps beside each other; a wider detector is drawn n times
        beside = columns == 1
        down, across = (rows, n) if beside else (n * rows, columns)
        aspect = self._largest[1] / self._largest[0]
        width = WIDTH if across > 1 or aspect < 0.7 else 0.66 * WIDTH
        margin = 0.75 + 0.55 * (across - 1) + (0.8 if colorbar else 0.0)
        height = down * (min((width - margin) / across * aspect, 8.0) + 0.8)
        with figure_style():
            fig = new_figure(width, height, layout="compressed")
            grid = fig.subplots(down, across, sharex=True, sharey=True, squeeze=False)
        axes = [
            [grid[row, k] if beside else grid[k * rows + row, column] for k in range(n)]
            for row, column in places
        ]
        used = {ax for several in axes for ax in several}
        for ax in grid.ravel():
            if ax not in used:
                ax.remove()
        return fig, axes

    def draw(self, ax: Axes, chip: int, *, margin: float = 0.0) -> None:
        """Make axes a map of a chip; `margin` must be the same for all panels of a figure.

        Parameters
        ----------
        ax : matplotlib.axes.Axes
        chip : int
            Which one, from 0.
        margin : float
            Room beyond the outline, in pixels.
        """
        detector_axes(ax, self._largest if self.several else self.sizes[0], margin=margin)
        if self.several:
            _label_edges(ax)
        size = self.sizes[chip]
        if size != self._largest:
            outline = Rectangle((0.5, 0.5), *size, fill=False, lw=0.9, ec="#5B6673", zorder=1)
            ax.add_patch(outline)

    def _legible_places(self) -> tuple[tuple[int, int], ...]:
        """The places, or of a wide detector the chips row by row in fewer columns."""
        if max(column for _, column in self.places) < MOST_COLUMNS:
            return self.places
        order = sorted(self.places)
        wrapped = [divmod(order.index(p), MOST_COLUMNS) for p in self.places]
        return tuple(wrapped)

    @property
    def _largest(self) -> Size:
        return max(s[0] for s in self.sizes), max(s[1] for s in self.sizes)


def _label_edges(ax: Axes) -> None:
    """Label axes that stand at the edge because there is no chip beyond them."""
    spec = ax.get_subplotspec()
    assert spec is not None
    others = [o.get_subplotspec() for o in ax.figure.axes if o is not ax]
    here = spec.rowspan.start, spec.colspan.start
    places = [(o.rowspan.start, o.colspan.start) for o in others if o is not None]
    if not any(row > here[0] and column == here[1] for row, column in places):
        ax.tick_params(labelbottom=True)
        ax.set_xlabel("x [pix]")
    if not any(column < here[1] and row == here[0] for row, column in places):
        ax.tick_params(labelleft=True)
        ax.set_ylabel("y [pix]")
