"""The look of every figure: one palette, one width, plain numbers at ticks.

Figures are made by objects, never through pyplot, and the caller's rcParams are left alone.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.quiver import Quiver
from matplotlib.text import Annotation
from matplotlib.ticker import LogFormatterSciNotation, ScalarFormatter
from numpy.typing import NDArray

from bayesdist.report.numbers import display_scale

__all__ = [
    "CYCLE",
    "HYPER_LABELS",
    "INK",
    "LEVEL_COLORS",
    "PALETTE",
    "SEQUENTIAL",
    "WIDTH",
    "detector_axes",
    "detector_panels",
    "draw_vectors",
    "figure_style",
    "new_figure",
    "nice_below",
    "plain_ticks",
    "vector_key",
]

Float = NDArray[np.float64]

# Okabe and Ito's palette: eight colours that remain distinct in every common colour blindness
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
INK = "#1F2A37"
HYPER_LABELS = {"f": "f", "j": "j", "s_out": r"$s_\mathrm{out}$"}
WIDTH = 7.2  # inches: the text width of an A4 or Letter page

_RC = {
    "font.family": "DejaVu Sans",  # ships with matplotlib: the same page on every machine
    "font.size": 8.5,
    "axes.titlesize": 8.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "axes.linewidth": 0.7,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.prop_cycle": matplotlib.cycler(color=CYCLE),
    "axes.formatter.useoffset": False,
    "axes.formatter.use_mathtext": False,  # see `plain_ticks`
    "axes.formatter.limits": (-4, 5),
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
    "figure.constrained_layout.h_pad": 0.06,
    "figure.constrained_layout.w_pad": 0.06,
}


@contextmanager
def figure_style() -> Iterator[None]:
    """The style, while the block runs; the caller's settings come back after it."""
    with matplotlib.rc_context(_RC):
        yield


def new_figure(width: float, height: float, *, layout: str = "constrained") -> Figure:
    """Empty figure that belongs to no window and to no pyplot state.

    Parameters
    ----------
    width, height : float
        Inches.
    layout : str
        Layout engine of matplotlib.

    Returns
    -------
    matplotlib.figure.Figure
    """
    fig = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(fig)
    return fig


def detector_panels(
    n: int, size: tuple[float, float], *, colorbar: bool = False
) -> tuple[Figure, list[Axes]]:
    """Figure with n maps of a detector at equal scale on both axes.

    Square detectors stand side by side, wide ones above each other.

    Parameters
    ----------
    n : int
        Number of maps, one or two.
    size : tuple of float
        Columns and rows of the detector, in pixels.
    colorbar : bool
        Whether room for one shared colour bar is needed.

    Returns
    -------
    fig : matplotlib.figure.Figure
    axes : list of matplotlib.axes.Axes
    """
    aspect = size[1] / size[0]
    stacked = n > 1 and aspect < 0.7
    columns = 1 if stacked else n
    width = WIDTH if n > 1 or aspect < 0.7 else 0.66 * WIDTH  # two squares on a printed page
    margin = 0.75 + 0.55 * (columns - 1) + (0.8 if colorbar else 0.0)
    panel = (width - margin) / columns
    height = (n if stacked else 1) * (min(panel * aspect, 8.0) + 0.8)
    with figure_style():
        fig = new_figure(width, height, layout="compressed")
        axes = fig.subplots(n if stacked else 1, columns, sharex=True, sharey=True, squeeze=False)
    return fig, list(axes.ravel())


def detector_axes(ax: Axes, size: tuple[float, float], *, margin: float = 0.0) -> None:
    """Make axes a map of the detector: x to the right, y up, pixels square, outline drawn.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
    size : tuple of float
        Columns and rows, in pixels.
    margin : float
        Room beyond the outline, in pixels.
    """
    nx, ny = size
    ax.set_aspect("equal")
    ax.set_xlim(0.5 - margin, nx + 0.5 + margin)
    ax.set_ylim(0.5 - margin, ny + 0.5 + margin)
    if margin > 0:
        ax.add_patch(Rectangle((0.5, 0.5), nx, ny, fill=False, lw=0.7, ec="#9AA5B1", zorder=0))
    ax.set_xlabel("x [pix]")
    ax.set_ylabel("y [pix]")
    ax.label_outer()


def nice_below(value: float) -> float:
    """Largest of 1, 2, 5 times a power of ten that does not exceed a positive number; else 1."""
    if not (value > 0 and math.isfinite(value)):
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    # the factor pardons the rounding of 5 / 5 = 0.9999999999999999 and the like
    step = max((m for m in (1.0, 2.0, 5.0) if m * power <= value * (1 + 1e-9)), default=1.0)
    return float(f"{step * power:.0e}")


def draw_vectors(
    ax: Axes, x: Float, y: Float, du: Float, dv: Float, *, magnification: float, color: str = INK
) -> Quiver:
    """Arrows from (x, y) to (x + M du, y + M dv), in the axes' own pixels.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
    x, y : ndarray
        Tails, in pixels.
    du, dv : ndarray, same shape
        Vectors, in the unit of u and v.
    magnification : float
        Pixels of the axes for one unit of the vectors.
    color : str

    Returns
    -------
    matplotlib.quiver.Quiver
    """
    return ax.quiver(
        x,
        y,
        du,
        dv,
        angles="xy",
        scale_units="xy",
        scale=1.0 / magnification,
        units="inches",
        width=0.011,
        headwidth=4.0,
        headlength=5.0,
        headaxislength=4.5,
        minlength=0.3,
        color=color,
        zorder=3,
    )


def vector_key(ax: Axes, length: float, *, magnification: float, unit: str) -> Annotation:
    """Arrow of a stated length above the axes' right end, drawn to the vectors' own scale.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
        Its limits must be final.
    length : float
        What the arrow stands for, in the unit of the vectors.
    magnification : float
        Pixels of the axes for one unit of the vectors.
    unit : str

    Returns
    -------
    matplotlib.text.Annotation
        The arrow; it runs from ``xyann`` to ``xy`` in pixels of the x axis.
    """
    end = ax.get_xlim()[1]
    start = end - length * magnification
    transform = ax.get_xaxis_transform()
    drawn = length * magnification
    times = f"×{magnification:,.6g}".replace(",", "\u202f")
    how = times if unit == "pix" else f"as {drawn:.3g} pix"
    text = f"{display_scale(unit, length).text(length)}, drawn {how} "
    arrow = ax.annotate(
        "",
        xy=(end, 1.035),
        xytext=(start, 1.035),
        xycoords=transform,
        textcoords=transform,
        arrowprops={
            "arrowstyle": "-|>,head_width=0.18,head_length=0.35",
            "shrinkA": 0,
            "shrinkB": 0,
            "lw": 1.0,
            "color": INK,
            "mutation_scale": 9,
        },
        annotation_clip=False,
    )
    ax.text(start, 1.035, text, transform=transform, ha="right", va="center", fontsize=7.5)
    return arrow


# -- ticks: mathematical text takes most of the time of drawing ------------------------------------

_RAISED = str.maketrans("0123456789-−", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁻")


class _Powers(LogFormatterSciNotation):
    """Powers of ten in raised digits."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        text = super().__call__(x, pos)
        text = text.removeprefix(r"$\mathdefault{").removesuffix("}$")
        return re.sub(r"\^\{(.*?)\}", lambda m: m[1].translate(_RAISED), _signs(text))


class _Plain(ScalarFormatter):
    """Decimal numbers, a power of ten that they share in raised digits."""

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
    """Give every axis that has matplotlib's own numbers such without mathematical text."""
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
                            now._base,
                            labelOnlyBase=now.labelOnlyBase,
                            minor_thresholds=now.minor_thresholds,
                            linthresh=now._linthresh,
                        )
                    )
