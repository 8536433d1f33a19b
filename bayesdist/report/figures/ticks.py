"""Axes with a single tick object for all ticks, since ticks take most of the drawing time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import XAxis, XTick, YAxis, YTick
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from bayesdist.utils.arrays import Bool, Float


class _AllTicks:
    """Tick that represents all ticks of an axis: its lines have all marks, its labels are moved."""

    def __init__(self: Any, *place: Any, **look: Any) -> None:
        super().__init__(*place, **look)
        self.around = self.axes.figure.around

    def place(self: Any, at: Float, texts: Sequence[str]) -> None:
        """Set positions, in the unit of the axis, and labels."""
        self.at, self.texts = at, texts
        gaps = np.full(at.shape, np.nan)
        grid = np.column_stack([at, at, gaps]).ravel(), np.tile([0.0, 1.0, np.nan], len(at))
        self.gridline.set_data(*self.in_order(*grid))
        for line, side in ((self.tick1line, 0.0), (self.tick2line, 1.0)):
            line.set_data(*self.in_order(at, np.full(at.shape, side)))

    def draw(self: Any, renderer: Any) -> None:
        """Draw lines, then marks, then labels."""
        if not self.get_visible():
            return
        for line in (self.gridline, self.tick1line, self.tick2line):
            line.draw(renderer)
        for label in (self.label1, self.label2):
            if label.get_visible():
                for moved in self.moved(label):
                    moved.draw(renderer)

    def boxes(self: Any, label: Text, renderer: Any) -> list[Bbox]:
        """Bounding boxes of one of the two labels at all positions."""
        if not (label.get_visible() and label.get_in_layout()):
            return []
        out, dpi = [], self.axes.figure.dpi
        for moved in self.moved(label):
            at = moved.get_transform().transform(moved.get_position())
            look = moved.get_fontsize(), moved.get_rotation(), moved.get_ha(), moved.get_va()
            key = moved.get_text(), dpi, *look
            if key not in self.around:
                extent = moved.get_window_extent(renderer)
                self.around[key] = extent.get_points() - at
            out.append(Bbox(self.around[key] + at))
        return out

    def moved(self: Any, label: Text) -> Iterator[Text]:
        """Yield the label with the text of each position, moved to that position."""
        (side,) = self.in_order(label.get_position()[1:], label.get_position()[:1])[0]
        for at, text in zip(self.at, self.texts, strict=True):
            label.set_position(self.in_order(at, side))
            label.set_text(text)
            yield label


class _XTicks(_AllTicks, XTick):
    def in_order(self, along: Any, across: Any) -> tuple[Any, Any]:
        """x and y, from values along the axis and across it."""
        return along, across


class _YTicks(_AllTicks, YTick):
    def in_order(self, along: Any, across: Any) -> tuple[Any, Any]:
        """x and y, from values along the axis and across it."""
        return across, along


class _OneTickAxis:
    """Axis with a single tick object; requests for single labels are handled by matplotlib."""

    _one_by_one = False
    _placed: tuple[Any, ...] = ()
    _measured: tuple[Any, ...] = ()

    def reset_ticks(self: Any) -> None:
        """Drop the ticks; they are created again when they are drawn."""
        self.majorTicks: list[Any] = []
        self.minorTicks: list[Any] = []
        self._placed = ()

    def _update_ticks(self: Any) -> list[Any]:
        """Ticks to be drawn: one for major and one for minor ticks."""
        if self._one_by_one:
            ticks: list[Any] = super()._update_ticks()  # type: ignore[misc]
            return ticks
        bbox, dpi = self.axes.bbox, self.axes.figure.dpi  # ticks depend on size, not on position
        size = round(bbox.width / dpi, 6), round(bbox.height / dpi, 6)
        sources = (self.major.locator, self.major.formatter, self.minor.locator)
        state = (*sources, *self.get_view_interval(), *size)
        if not self._placed or self._placed[0] != state:
            single_ticks = []
            for major, locs, formatter in (
                (True, self.get_majorticklocs(), self.major.formatter),
                (False, self.get_minorticklocs(), self.minor.formatter),
            ):
                texts = formatter.format_ticks(locs)
                shown = self._within(locs)
                if shown.any():
                    tick = self._tick_of_all(major)
                    at = np.asarray(locs, float)[shown]
                    tick.place(
                        at, [text for text, visible in zip(texts, shown, strict=True) if visible]
                    )
                    single_ticks.append(tick)
            self._placed = state, single_ticks
        return list(self._placed[1])

    def _within(self: Any, locs: Any) -> Bool:
        """Boolean mask of the positions between the limits of the axis."""
        transform = self.get_transform()
        low, high = np.sort(transform.transform(np.asarray(self.get_view_interval(), float)))
        at, room = transform.transform(np.asarray(locs, float)), 1e-10 * (high - low)
        return np.asarray((at >= low - room) & (at <= high + room))

    def _tick_of_all(self: Any, major: bool) -> Any:
        ticks = self.majorTicks if major else self.minorTicks
        if not ticks:
            ticks.append(self._get_tick(major))
            ticks[0].set_clip_path(self.axes.patch)
        return ticks[0]

    def _get_ticklabel_bboxes(
        self: Any, ticks: Sequence[Any], renderer: Any
    ) -> tuple[list[Bbox], list[Bbox]]:
        if self._one_by_one:
            boxes: tuple[list[Bbox], list[Bbox]]
            boxes = super()._get_ticklabel_bboxes(ticks, renderer)  # type: ignore[misc]
            return boxes
        shown = [(t, t.label1.get_visible(), t.label2.get_visible()) for t in ticks]
        state = self._placed[0], shown, self.axes.bbox.bounds, self.axes.figure.dpi
        if not self._measured or self._measured[0] != state:  # this is called twice in a row
            first = [box for tick in ticks for box in tick.boxes(tick.label1, renderer)]
            second = [box for tick in ticks for box in tick.boxes(tick.label2, renderer)]
            self._measured = state, first, second
        return self._measured[1], self._measured[2]

    def _update_label_position(self: Any, renderer: Any) -> None:
        if self.label.get_visible():
            super()._update_label_position(renderer)  # type: ignore[misc]

    def set_tick_params(self: Any, *which: Any, **look: Any) -> None:
        """Set the look of ticks and their labels."""
        self._measured = ()
        super().set_tick_params(*which, **look)  # type: ignore[misc]

    @contextmanager
    def _separate(self) -> Iterator[None]:
        """Context manager that restores the ticks of matplotlib."""
        self._one_by_one, self._placed = True, ()
        try:
            yield
        finally:
            self._one_by_one = False

    def get_majorticklabels(self) -> list[Text]:
        """Labels of the major ticks as matplotlib creates them."""
        with self._separate():
            labels: list[Text] = super().get_majorticklabels()  # type: ignore[misc]
        return labels

    def get_minorticklabels(self) -> list[Text]:
        """Labels of the minor ticks as matplotlib creates them."""
        with self._separate():
            labels: list[Text] = super().get_minorticklabels()  # type: ignore[misc]
        return labels


class _OneTickXAxis(_OneTickAxis, XAxis):
    _tick_class = _XTicks


class _OneTickYAxis(_OneTickAxis, YAxis):
    _tick_class = _YTicks


class OneTickAxes(Axes):
    """Axes that look like those of matplotlib but are laid out and drawn in a third of the time."""

    def _init_axis(self) -> None:
        self.xaxis, self.yaxis = _OneTickXAxis(self, clear=False), _OneTickYAxis(self, clear=False)
        for axis, sides in ((self.xaxis, ("bottom", "top")), (self.yaxis, ("left", "right"))):
            for side in sides:
                self.spines[side].register_axis(axis)

    def clear(self) -> None:
        """Remove all content, and put the spines at the edges."""
        super().clear()
        for spine in self.spines.values():  # otherwise the first of many ticks does this
            spine.set_position(("outward", 0.0))


class OneTickFigure(Figure):
    """Figure with `OneTickAxes` as panels and colour bars."""

    def __init__(self, *size: Any, **options: Any) -> None:
        super().__init__(*size, **options)
        self.around: dict[tuple[Any, ...], Float] = {}  # extents of labels about their positions

    def add_subplot(self, *place: Any, **options: Any) -> Any:
        """Add a panel in a grid."""
        return super().add_subplot(*place, **{"axes_class": OneTickAxes} | options)

    def add_axes(self, *place: Any, **options: Any) -> Any:
        """Add a panel at a position of the figure."""
        return super().add_axes(*place, **{"axes_class": OneTickAxes} | options)
