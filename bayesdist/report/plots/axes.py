"""Axes, units and titles of the plots."""

from __future__ import annotations

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from bayesdist.errors import InputError
from bayesdist.utils.numbers import Scale, display_scale


def axes_of(ax: Axes | None, *, height: float = 0.0) -> Axes:
    """Axes to draw into: `ax`, or those of a new pyplot figure if it is None.

    The new figure has the size of the user's style and is at least `height` inches high.
    """
    if ax is None:
        from matplotlib import pyplot  # pyplot chooses a backend: only if a figure is asked for

        size = matplotlib.rcParams["figure.figsize"]
        _, made = pyplot.subplots(figsize=(size[0], max(size[1], height)), layout="constrained")
        return made
    if not isinstance(ax, Axes):
        shape = f" of shape {np.shape(ax)}" if np.ndim(ax) else ""
        raise InputError(
            f"ax is a {type(ax).__name__}{shape}",
            where="plot",
            do="give one matplotlib Axes, such as an element of that array",
        )
    return ax


def scale_of(unit: str, largest: float, scale_mas: float | None) -> Scale:
    """Unit in which values of at most `largest` are shown, and the factor that leads to it.

    Pixels become milliarcseconds if `scale_mas`, the size of a pixel, is given.
    """
    if scale_mas is None or unit != "pix":
        return display_scale(unit, largest)
    scale = display_scale("mas", largest * scale_mas)
    return Scale(scale.factor * scale_mas, scale.unit)


def set_title(ax: Axes, title: str | None, default: str, *, pad: float | None = None) -> None:
    """Set the title of a plot: the default one if `title` is None, and none if it is empty."""
    text = default if title is None else title
    if text:
        ax.set_title(text, pad=pad)
