"""Orders of the polynomial: surfaces in binned residuals, and predictions of held-out stars."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bayesdist.report.figures.style import PALETTE, WIDTH, figure_style, new_figure
from bayesdist.utils.numbers import display_scale

if TYPE_CHECKING:
    from bayesdist.infer.compare.order_result import OrderSelection

_NEAR = 10.0  # log density within which the right-hand axis is linear
_APART = 0.12  # of an order, by which markers of one order are apart


@figure_style()
def order_comparison(found: OrderSelection) -> Figure:
    """Figure with surfaces on the left, held-out stars and regions on the right."""
    fig = new_figure(WIDTH, 3.1)
    left, right = fig.subplots(1, 2)
    _surfaces(left, found)
    _held_out(right, found)
    for ax in (left, right):
        ax.axvspan(found.order - 0.35, found.order + 0.35, color="#E8ECF0", zorder=0)
        ax.set_xlabel("order of the polynomial (chosen one shaded)")
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        ax.set_xlim(found.orders[0] - 0.6, found.orders[-1] + 0.6)
    return fig


def _surfaces(ax: Axes, found: OrderSelection) -> None:
    s = found.surfaces
    scale = display_scale(found.unit, s.rms.ravel())
    for axis, (name, color, mark) in enumerate(
        (("u", PALETTE["blue"], "o"), ("v", PALETTE["vermilion"], "s"))
    ):
        ax.plot(s.orders, s.rms[:, axis] * scale.factor, f"{mark}-", ms=4, color=color, label=name)
        noise = float(s.noise[axis]) * scale.factor
        ax.axhline(noise, ls=":", lw=1.0, color=color, label=f"noise of the means, {name}")
    ax.set_yscale("log")
    ax.set_ylabel(f"rms of {s.n_bins} bins after the surface [{scale.unit}]")
    ax.set_title("Binned surfaces")
    ax.legend()


def _held_out(ax: Axes, found: OrderSelection) -> None:
    rows = found.rows()
    for k, (key, color, mark) in enumerate(
        (("stars", PALETTE["blue"], "o"), ("regions", PALETTE["orange"], "D"))
    ):
        value, error = (
            np.array([0.0 if row[name] is None else row[name] for row in rows], float)
            for name in (key, f"{key}_error")
        )
        x = np.array(found.orders) + (2 * k - 1) * _APART
        ax.errorbar(x, value, error, fmt=mark, ms=4, lw=1.0, color=color, label=key)
    ax.axhline(0.0, lw=0.7, color="#9AA5B1", zorder=1)
    ax.set_yscale("symlog", linthresh=_NEAR)
    ax.set_ylabel(f"log density minus that of order {found.order}")
    ax.set_title("Held out (1 σ)")
    ax.legend()
