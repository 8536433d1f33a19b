"""Style of all figures: one palette, one width, plain numbers at ticks.

Figures are created as objects, never through pyplot, and the caller's rcParams are not changed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap, to_hex, to_rgba
from matplotlib.figure import Figure
from matplotlib.rcsetup import cycler
from matplotlib.ticker import LogFormatterSciNotation, ScalarFormatter

from bayesdist.report.figures.ticks import OneTickFigure

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


class _Plain(ScalarFormatter):
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
                    put(_Plain(useOffset=now.get_useOffset(), useMathText=False))
                elif type(now) is LogFormatterSciNotation:
                    put(
                        _Powers(
                            now._base,  # type: ignore[attr-defined]  # has no getter
                            labelOnlyBase=now.labelOnlyBase,
                            minor_thresholds=now.minor_thresholds,
                            linthresh=now._linthresh,  # type: ignore[attr-defined]  # no getter
                        )
                    )
