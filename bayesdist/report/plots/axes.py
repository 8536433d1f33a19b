"""Axes, units and titles of the plots."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable

from bayesdist.errors import InputError
from bayesdist.utils.text import Scale, display_scale


def axes_of(ax: Axes | None, *, height: float = 0.0) -> Axes:
    """Axes to draw into: `ax`, or those of a new pyplot figure if it is None.

    The new figure has the size of the user's style and a height of at least `height` inches.
    """
    if ax is None:
        from matplotlib import pyplot  # selects a backend, so only if a figure is needed

        size = matplotlib.rcParams["figure.figsize"]
        # compressed: labels fit, and maps with square pixels have no empty space around them
        _, new_axes = pyplot.subplots(figsize=(size[0], max(size[1], height)), layout="compressed")
        return new_axes
    if not isinstance(ax, Axes):
        shape = f" of shape {np.shape(ax)}" if np.ndim(ax) else ""
        raise InputError(
            f"ax is a {type(ax).__name__}{shape}",
            where="plot",
            do="give one matplotlib Axes" + (", such as an element of that array" if shape else ""),
        )
    return ax


def scale_of(unit: str, largest: float, scale_mas: float | None) -> Scale:
    """Unit in which values of at most `largest` are shown, and the factor of conversion to it.

    Pixels are converted to milliarcseconds if `scale_mas`, the size of a pixel, is given.
    """
    if scale_mas is None or unit != "pix":
        return display_scale(unit, largest)
    scale = display_scale("mas", largest * scale_mas)
    return Scale(scale.factor * scale_mas, scale.unit)


def add_colorbar(ax: Axes, drawn: ScalarMappable, label: str, **look: Any) -> None:
    """Draw a colour bar next to `ax` with the same height, independent of the figure's layout."""
    ax.figure.colorbar(drawn, cax=ax.inset_axes((1.03, 0.0, 0.05, 1.0)), label=label, **look)


def set_title(
    ax: Axes, title: str | None, default: str, name: str = "", *, pad: float | None = None
) -> None:
    """Set the title of a plot: the default if `title` is None, no title if it is empty.

    The default title begins with the name of the chip, if any.
    """
    text = (f"{name}: {default}" if name else default) if title is None else title
    if text:
        ax.set_title(text, pad=pad)
