"""Style of all figures: one palette, one width, plain numbers at ticks.

Figures are created as objects, never through pyplot, and the caller's rcParams are not changed.
Axes have a single tick object for all ticks, since ticks take most of the drawing time.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.axis import XAxis, XTick, YAxis, YTick
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap, to_hex, to_rgba
from matplotlib.figure import Figure
from matplotlib.rcsetup import cycler
from matplotlib.text import Text
from matplotlib.ticker import LogFormatterSciNotation, ScalarFormatter
from matplotlib.transforms import Bbox

from bayesdist.utils.arrays import Bool, Float

# palette of Okabe and Ito: eight colours that are distinct with any common colour blindness
PALETTE = {
    "black": "#000000",
    "orange": "#E69F00",
    "sky": "#56B4E9",
    "green": "#009E73",
    "yellow": "#F0E442",
    "blue": "#0072B2",
    "vermilion": "#D55E00",
    "purple": "#CC79A7",
}
CYCLE = tuple(PALETTE[c] for c in ("blue", "vermilion", "green", "purple", "orange", "sky"))
LEVEL_COLORS = {
    "pass": PALETTE["green"],
    "warn": PALETTE["orange"],
    "fail": PALETTE["vermilion"],
    "note": "#666666",
}
SEQUENTIAL = "cividis"
SIZES = ListedColormap(colormaps["cividis_r"](np.linspace(0.2, 1.0, 256)), "sizes")  # of vectors
DIVERGING = "RdBu_r"  # for values of both signs; distinct with any common colour blindness
INK = "#1F2A37"
PALE = "#A9B4C0"  # vectors that may be noise alone, and stars in the background
OUTLINE = "#9AA5B1"  # outlines of chips, and lines at zero
GUIDE = "#E3E8ED"  # grid lines behind data
BARS = "#C5CED8"  # histogram behind a curve
PAPER = "#FFFFFF"
COLORBAR: dict[str, Any] = {"fraction": 0.05, "pad": 0.02}  # next to maps
WIDTH = 7.2  # inches: the text width of an A4 or Letter page
LARGE_WIDTH = 4.6  # of a map next to a figure of full width on a wide screen
HALF_WIDTH = WIDTH / 2  # of figures side by side

_RC: Any = {
    "font.family": ["DejaVu Sans"],  # ships with matplotlib, so pages are equal on all machines
    "font.size": 8.5,
    "axes.titlesize": 8.5,
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # otherwise all ticks are measured again, in case some are above the panel
    "axes.labelsize": 8.5,
    "axes.linewidth": 0.7,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.prop_cycle": cycler(color=CYCLE),
    "axes.formatter.useoffset": False,
    "axes.formatter.use_mathtext": False,  # see `plain_ticks`
    "axes.formatter.limits": [-4, 5],
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "image.cmap": SEQUENTIAL,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "figure.autolayout": False,  # panels are laid out only once, see `bayesdist.report.drawing`
    "figure.constrained_layout.use": False,
    "figure.constrained_layout.h_pad": 0.06,
    "figure.constrained_layout.w_pad": 0.06,
    "svg.fonttype": "path",  # independent of the fonts of the viewer
    "svg.hashsalt": "bayesdist",
}


@contextmanager
def figure_style() -> Iterator[None]:
    """Context manager or decorator that applies the style and restores the caller's settings.

    Nested contexts do nothing, because copying all settings takes milliseconds.
    """
    if all(dict.get(matplotlib.rcParams, key) == value for key, value in _RC.items()):
        yield
        return
    with matplotlib.rc_context(_RC):
        yield


def new_figure(
    width: float,
    height: float,
    *,
    layout: Literal["constrained", "compressed", "none"] = "constrained",
) -> Figure:
    """Empty figure without a window and without pyplot state; sizes are in inches."""
    fig = OneTickFigure(figsize=(width, height))
    fig.set_layout_engine(layout)
    FigureCanvasAgg(fig)
    return fig


@dataclass(frozen=True)
class Tones:
    """Neutral colours of a panel: those of the report, or shades of the user's style.

    Colours with a meaning (of a verdict, an axis, a kind of error) are the same in all styles.
    """

    ink: str = INK  # vectors, lines at zero
    pale: str = PALE
    outline: str = OUTLINE
    guide: str = GUIDE
    bars: str = BARS
    paper: str = PAPER  # background

    @classmethod
    def of(cls, ax: Axes) -> Tones:
        """Colours that contrast with the background of a panel as its labels do."""
        ink = to_hex(ax.xaxis.label.get_color()).upper()
        layers = (ax.get_facecolor(), ax.figure.get_facecolor())
        paper = next((to_hex(c).upper() for c in layers if to_rgba(c)[3] > 0), PAPER)
        if (ink, paper) == (INK.upper(), PAPER):
            return cls()
        dark, light = np.array(to_rgba(ink)[:3]), np.array(to_rgba(paper)[:3])

        def shade(part: float) -> str:
            """Colour between text (0) and background (1)."""
            return to_hex(dark + part * (light - dark))

        return cls(ink, shade(0.6), shade(0.5), shade(0.85), shade(0.72), paper)


def small_font() -> Any:
    """Font size of text inside or next to a panel: that of legends."""
    return matplotlib.rcParams["legend.fontsize"]


def legend_above(figure: Figure, ax: Axes, **look: Any) -> None:
    """Draw the legend of one panel in a row above all panels."""
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=len(labels), **look)


def guide_lines(ax: Axes) -> None:
    """Draw grid lines behind the data."""
    ax.grid(True, lw=0.4, color=Tones.of(ax).guide)
    ax.set_axisbelow(True)


def nice_below(value: float) -> float:
    """Largest of 1, 2, 5 times a power of ten not above a positive number; 1 for other values."""
    if not (value > 0 and math.isfinite(value)):
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    # the factor allows for rounding, such as 5 / 5 = 0.9999999999999999
    step = max((m for m in (1.0, 2.0, 5.0) if m * power <= value * (1 + 1e-9)), default=1.0)
    return float(f"{step * power:.0e}")


# -- ticks: without mathematical text, which takes most of the drawing time ------------------------

_RAISED = str.maketrans("0123456789-−", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁻")


class _Powers(LogFormatterSciNotation):
    """Formatter of powers of ten with superscript digits."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        text = super().__call__(x, pos)
        text = text.removeprefix(r"$\mathdefault{").removesuffix("}$")
        return re.sub(r"\^\{(.*?)\}", lambda m: m[1].translate(_RAISED), _signs(text))


class _PlainNumbers(ScalarFormatter):
    """Formatter of decimal numbers with a common power of ten in superscript digits."""

    def get_offset(self) -> str:
        text = super().get_offset()
        number, e, power = text.partition("e")
        if not e:
            return text
        times = f"{number}×" if number not in ("", "1") else "×"
        return f"{times}10{power.removeprefix('+').translate(_RAISED)}"


def _signs(text: str) -> str:
    return text.replace(r"\times", "×").replace("-", "−")


def plain_ticks(figure: Figure) -> None:
    """Replace the formatters of matplotlib on every axis by those without mathematical text."""
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            for now, put in (
                (axis.get_major_formatter(), axis.set_major_formatter),
                (axis.get_minor_formatter(), axis.set_minor_formatter),
            ):
                if type(now) is ScalarFormatter:
                    put(_PlainNumbers(useOffset=now.get_useOffset(), useMathText=False))
                elif type(now) is LogFormatterSciNotation:
                    put(
                        _Powers(
                            now._base,  # type: ignore[attr-defined]  # has no getter
                            labelOnlyBase=now.labelOnlyBase,
                            minor_thresholds=now.minor_thresholds,
                            linthresh=now._linthresh,  # type: ignore[attr-defined]  # no getter
                        )
                    )


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
