"""Errors of catalogue and centroids, and the quality of the detections, against magnitude.

Figures 3 and 5 of ACS ISR 2015-06.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesdist.report.style import INK, PALETTE, WIDTH, figure_style, new_figure

if TYPE_CHECKING:
    from bayesdist.data import MagnitudeErrors
    from bayesdist.report.campaign.context import CatalogStars, Detections

__all__ = ["catalogue_errors", "fit_quality"]

_DOT = "#8FA3B5"
_LEFT_OUT = PALETTE["vermilion"]


def catalogue_errors(catalog: CatalogStars, centroids: MagnitudeErrors | None) -> Figure:
    """Errors of positions, and of proper motions with the limit of their selection.

    Parameters
    ----------
    catalog : CatalogStars
    centroids : MagnitudeErrors or None
        Of single detections.

    Returns
    -------
    matplotlib.figure.Figure
    """
    with figure_style():
        fig = new_figure(WIDTH, 3.3)
        left, right = fig.subplots(1, 2)
        if catalog.sigma is not None:
            left.plot(
                catalog.mag, catalog.sigma, ".", ms=1.2, color=_DOT, label="catalogue, quoted"
            )
        if centroids is not None:
            points = np.hypot(centroids.scatter_u, centroids.scatter_v)
            line = np.hypot(centroids.sigma_u, centroids.sigma_v)
            left.plot(
                centroids.mag,
                points,
                "o",
                ms=2.8,
                color=PALETTE["blue"],
                label="residuals, scatter",
            )
            left.plot(centroids.mag, line, color=INK, label="one detection, fitted")
        left.set_ylabel(rf"error of the position, $\sigma_{{uv}}$ [{catalog.unit}]")
        left.set_title("Positions")
        if catalog.sigma_motion is not None:
            _motions(right, catalog)
        else:
            right.remove()
        for ax in fig.axes:
            ax.set_yscale("log")
            ax.set_xlabel("instrumental magnitude")
            ax.grid(True, which="major", lw=0.4, color="#E3E8ED", zorder=0)
            legend = ax.legend(loc="upper center", markerscale=2.2, handlelength=1.6)
            legend.set_zorder(6)
    return fig


def _motions(ax: Axes, catalog: CatalogStars) -> None:
    assert catalog.sigma_motion is not None
    good = np.ones(len(catalog.mag), bool)
    if catalog.limit is not None:
        mag, sigma = catalog.limit
        good = catalog.sigma_motion <= np.exp(np.interp(catalog.mag, mag, np.log(sigma)))
    ax.plot(catalog.mag[good], catalog.sigma_motion[good], ".", ms=1.2, color=_DOT, label="used")
    if catalog.limit is not None:
        bad = ~good
        ax.plot(
            catalog.mag[bad],
            catalog.sigma_motion[bad],
            ".",
            ms=1.2,
            color=PALETTE["orange"],
            label="left out",
        )
        ax.plot(*catalog.limit, color=_LEFT_OUT, label="limit")
    ax.set_ylabel(f"error of the proper motion [{catalog.unit}/yr]")
    ax.set_title("Proper motions, larger axis")


def fit_quality(detections: Detections) -> Figure:
    """Quality of the PSF fit against magnitude, with the cuts.

    Parameters
    ----------
    detections : Detections

    Returns
    -------
    matplotlib.figure.Figure
    """
    d = detections
    faintest, brightest = np.quantile(d.mag, (0.9995, 0.001))
    low, high = np.quantile(d.q[d.q > 0], (0.0005, 0.9995))
    with figure_style():
        fig = new_figure(WIDTH, 3.5)
        ax = fig.subplots()
        for rows, color, label in ((~d.kept, "#C3CCD5", "left out"), (d.kept, "#2B6CA3", "kept")):
            ax.plot(d.mag[rows], d.q[rows], ".", ms=1.4, color=color, label=label)
        for edge in d.mag_cuts:
            ax.axvline(edge, color=_LEFT_OUT, lw=0.9, ls="--")
        if d.q_max is not None:
            ax.axhline(d.q_max, color=_LEFT_OUT, lw=0.9, ls="--", label="cuts")
        elif d.mag_cuts:
            ax.plot([], [], color=_LEFT_OUT, lw=0.9, ls="--", label="cuts")
        ax.set_yscale("log")
        ax.set_xlim(brightest - 0.4, faintest + 0.4)
        ax.set_ylim(low / 1.5, high * 3)  # room for the legend
        ax.set_xlabel("instrumental magnitude")
        ax.set_ylabel("quality of the fit q")
        legend = ax.legend(loc="upper center", ncols=3, markerscale=4)
        legend.set_zorder(6)
    return fig
