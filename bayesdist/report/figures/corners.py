"""Corner plots: joint distributions of each pair of several quantities, from draws."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from bayesdist.report.figures.style import PALETTE, WIDTH, figure_style, new_figure
from bayesdist.utils.arrays import Float
from bayesdist.utils.numbers import display_scale

_LEVELS = tuple(1.0 - np.exp(-0.5 * np.array([1.0, 2.0]) ** 2))  # content of 1 and 2 sigma in 2-D


@dataclass(frozen=True, eq=False)
class Column:
    """Draws (N,) of one quantity."""

    label: str
    unit: str
    draws: Float


def _corner() -> Callable[..., Figure]:
    """The function of the library, which is imported where it is used, and without arviz.

    It would import that where it is installed, for tables that are none of ours: half a second.
    """
    with patch.dict(sys.modules, {"arviz": None}):
        from corner import corner
    found: Callable[..., Figure] = corner
    return found


def corner_figure(columns: Sequence[Column]) -> Figure:
    """Corner plot of draws of quantities that are never negative, at 1 and 2 sigma."""
    corner = _corner()
    n = len(columns)
    raw = np.stack([c.draws for c in columns], axis=-1)
    ranges = _ranges(raw)
    # by the middle of the axis: the numbers at its ticks are not the largest
    scales = [display_scale(c.unit, r.mean()) for c, r in zip(columns, ranges, strict=True)]
    factors = np.array([s.factor for s in scales])
    side = WIDTH if n > 3 else 1.6 * n + 0.9
    with figure_style():
        fig = new_figure(side, side, layout="none")
        corner(
            raw * factors,
            fig=fig,
            bins=26,
            range=[tuple(r) for r in ranges * factors[:, None]],
            labels=[
                f"{c.label} [{s.unit or 'no unit'}]" for c, s in zip(columns, scales, strict=True)
            ],
            color=PALETTE["blue"],
            quantiles=[0.1587, 0.8413],
            levels=_LEVELS,
            plot_datapoints=False,
            fill_contours=True,
            smooth=1.0,
            max_n_ticks=3,
            label_kwargs={"fontsize": 8},
            labelpad=0.04,
            hist_kwargs={"lw": 1.0, "density": True},
        )
        handles = [Patch(fc=PALETTE["blue"], alpha=0.6, label="posterior\n(1 σ and 2 σ)")]
        if n > 1:
            fig.legend(handles=handles, loc="upper right", fontsize=8.5)
        else:
            fig.axes[0].set_ylabel("density [relative]")
        room = 0.75 / side
        fig.subplots_adjust(
            left=room, bottom=room, right=0.985, top=0.985, wspace=0.06, hspace=0.06
        )
    return fig


def _ranges(draws: Float) -> Float:
    """Limits (n, 2) of each column: four standard deviations, from zero at least."""
    middle, spread = np.median(draws, axis=0), np.std(draws, axis=0)
    spread = np.where(spread > 0, spread, 1e-6 * np.abs(middle) + 1e-12)
    return np.stack([np.maximum(middle - 4 * spread, 0.0), middle + 4 * spread], axis=-1)
