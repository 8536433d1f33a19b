"""Histograms of the residuals and their correlation over the array, band by band."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from bayesdist.assess.residual_correlation import DRAWS
from bayesdist.report.numbers import probability
from bayesdist.report.style import INK, PALETTE, WIDTH, figure_style, new_figure

if TYPE_CHECKING:
    from bayesdist.assess.histograms import ResidualHistogram
    from bayesdist.report.bands.context import BandResult

__all__ = ["CASES", "chance_of", "correlation_curves", "histograms"]

# colour, width and dashes by case, drawn in this order
CASES = {
    "no correction": (PALETTE["blue"], 1.0, "-"),
    "optical model": (PALETTE["green"], 1.0, (0, (3.5, 1.0))),
    "calibrated": (PALETTE["vermilion"], 1.3, "-"),
}


def histograms(bands: Mapping[str, Mapping[str, ResidualHistogram]]) -> Figure:
    """Residuals along x and y of all pairs, on a logarithmic scale of counts.

    Parameters
    ----------
    bands : mapping of str to mapping of str to ResidualHistogram
        By band and by case, as in `CASES`.

    Returns
    -------
    matplotlib.figure.Figure
    """
    with figure_style():
        fig = new_figure(WIDTH, 0.5 + 1.75 * len(bands))
        axes = fig.subplots(len(bands), 2, sharey="row", sharex="row", squeeze=False)
        for (name, cases), row in zip(bands.items(), axes, strict=True):
            for k, (ax, axis) in enumerate(zip(row, "XY", strict=True)):
                for case, (color, width, dashes) in CASES.items():
                    if case not in cases:
                        continue
                    one = cases[case]
                    ax.stairs(
                        one.counts[k], one.edges, color=color, lw=width, ls=dashes, label=case
                    )
                reach = next(iter(cases.values())).reach
                ax.set_xlim(-reach, reach)
                ax.set_yscale("log")
                ax.set_ylim(bottom=0.7)
                ax.set_title(f"{name} {axis}", pad=3)
            row[0].set_ylabel("pairs per bin")
        for ax in axes[-1]:
            ax.set_xlabel("residual [pix]")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        fig.legend(handles, labels, loc="outside upper left", ncols=len(labels))
    return fig


def correlation_curves(bands: tuple[BandResult, ...]) -> Figure:
    """Correlation of mean residuals of bins against their separation, with what noise gives.

    Parameters
    ----------
    bands : tuple of BandResult

    Returns
    -------
    matplotlib.figure.Figure
    """
    columns = min(2, len(bands))
    rows = -(-len(bands) // columns)
    with figure_style():
        fig = new_figure(WIDTH, 0.5 + 2.1 * rows)
        axes = fig.subplots(rows, columns, squeeze=False).ravel()
        for ax in axes[len(bands) :]:
            ax.remove()
        for band, ax in zip(bands, axes, strict=False):
            c = band.correlation
            both = (("X", c.uu, c.sigma_uu, "blue", "-"), ("Y", c.vv, c.sigma_vv, "orange", "--"))
            for label, values, sigma, color, dashes in both:
                ax.fill_between(
                    c.separation,
                    -2e6 * sigma,
                    2e6 * sigma,
                    color=PALETTE[color],
                    alpha=0.25,
                    lw=0,
                    label=f"±2 σ of noise in {label}",
                )
                ax.plot(
                    c.separation,
                    1e6 * values,
                    color=PALETTE[color],
                    ls=dashes,
                    marker="o",
                    ms=2.5,
                    label=f"{label} with {label}",
                )
            ax.axhline(0.0, color=INK, lw=0.5)
            ax.set_xlim(0.0, float(np.max(c.separation)) * 1.02)
            ax.set_title(f"{band.name}: {chance_of(c.p_value)}", pad=3)
            ax.set_xlabel("separation [pix]")
        for ax in axes[: len(bands) : columns]:
            ax.set_ylabel("mean product [10⁻⁶ pix²]")
        handles, labels = axes[0].get_legend_handles_labels()
        fig.legend(handles, labels, loc="outside upper left", ncols=len(labels))
    return fig


def chance_of(p: float) -> str:
    """A probability counted in draws: the smallest that they tell is a bound."""
    return f"p < {2 / DRAWS:g}" if p < 1.5 / DRAWS else probability(p)
