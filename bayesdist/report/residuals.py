"""Residuals against what the fitted mixture says that they should be.

However many stars there are, what is drawn is counts: histograms and hexagons.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from bayesdist.report.numbers import display_scale
from bayesdist.report.style import INK, PALETTE, SEQUENTIAL, WIDTH, figure_style, new_figure

if TYPE_CHECKING:
    from bayesdist.data import MagnitudeErrors

__all__ = [
    "MixtureCurve",
    "residual_histogram",
    "residuals_by_magnitude",
]

Float = NDArray[np.float64]

_SIGMA_BINS = 200


@dataclass(frozen=True)
class MixtureCurve:
    """Distribution of one axis of the residuals under the fitted mixture.

    Parameters
    ----------
    sigma : ndarray, shape (N,)
        Quoted error of each star on this axis.
    fraction : float
        Outlier fraction f.
    jitter : float
        j, added in quadrature to every quoted error.
    scale : float
        s_out of a Gaussian outlier component, or the match radius of a uniform one.
    outliers : str
        'gaussian', 'uniform' or 'none'.
    taken : ndarray, shape (N,), or float
        Share of the variance of each residual that fitted places of the stars take out of it.
    """

    sigma: Float
    fraction: float = 0.0
    jitter: float = 0.0
    scale: float = 0.0
    outliers: str = "none"
    taken: Float | float = 0.0

    def expected(self, edges: ArrayLike) -> tuple[Float, Float]:
        """Stars expected in each bin: of the good component, and of the outliers.

        Parameters
        ----------
        edges : array_like, shape (B + 1,)
            Bin edges, in the unit of `sigma`.

        Returns
        -------
        good, outlying : ndarray, shape (B,)
        """
        edges = np.asarray(edges, float)
        sigma, weight = self._widths()
        good = weight @ np.diff(ndtr(edges / sigma[:, None]), axis=1)
        n = float(self.sigma.size)
        outlying = n * np.diff(self._outlier_cdf(edges))
        f = 0.0 if self.outliers == "none" else self.fraction
        return (1.0 - f) * good, f * outlying

    def _widths(self) -> tuple[Float, Float]:
        """Total widths that occur, and how many stars have each (binned where there are many)."""
        total = np.hypot(self.sigma, self.jitter) * np.sqrt(1.0 - self.taken)
        values, counts = np.unique(total, return_counts=True)
        if values.size > _SIGMA_BINS:
            # in equal steps of log width; the mean square in a bin keeps the variance exact
            edges = np.geomspace(values[0], values[-1], _SIGMA_BINS + 1)
            which = np.clip(np.searchsorted(edges, total, side="right") - 1, 0, _SIGMA_BINS - 1)
            counts = np.bincount(which, minlength=_SIGMA_BINS)
            square = np.bincount(which, weights=total**2, minlength=_SIGMA_BINS)
            keep = counts > 0
            values, counts = np.sqrt(square[keep] / counts[keep]), counts[keep]
        return values, counts.astype(float)

    def _outlier_cdf(self, edges: Float) -> Float:
        if self.outliers == "gaussian":
            return ndtr(edges / self.scale)
        if self.outliers == "uniform":  # one axis of a uniform disc: a semicircle
            t = np.clip(edges / self.scale, -1.0, 1.0)
            return 0.5 + (t * np.sqrt(1.0 - t**2) + np.arcsin(t)) / np.pi
        return np.zeros_like(edges)


def residual_histogram(
    residual: Float,
    curves: tuple[MixtureCurve, MixtureCurve],
    *,
    unit: str,
    sampled: bool = False,
    things: str = "stars",
) -> Figure:
    """Histograms of the two axes: the core, and everything on a logarithmic scale of counts.

    Parameters
    ----------
    residual : ndarray, shape (N, 2)
        In the unit of u and v.
    curves : tuple of MixtureCurve
        What is expected of u and of v, for the same stars.
    unit : str
    sampled : bool
        Whether these are some stars of more, which the labels then say.
    things : str
        What the residuals are of: 'stars' or 'detections'.

    Returns
    -------
    matplotlib.figure.Figure
    """
    width = max(float(np.sqrt(np.median(c.sigma**2 + c.jitter**2))) for c in curves)
    widest = max(float(np.sqrt(np.max(c.sigma**2 + c.jitter**2))) for c in curves)
    core = min(6.0 * width, 4.0 * widest)
    tail = max(float(np.abs(residual).max()), 1.2 * core) * 1.02
    everything = "whole sample" if sampled else f"all {things}"
    with figure_style():
        fig = new_figure(WIDTH, 4.9)
        axes = fig.subplots(2, 2, sharey="row")
        for column, (axis, curve) in enumerate(zip("uv", curves, strict=True)):
            for row, (reach, bins) in enumerate(((core, 81), (tail, 121))):
                ax = axes[row, column]
                scale = display_scale(unit, reach)
                _histogram(ax, residual[:, column], curve, reach, bins, scale.factor, things)
                ax.set_xlabel(f"residual in {axis} [{scale.unit}]")
            axes[0, column].set_title(f"{axis}: core")
            axes[1, column].set_title(f"{axis}: {everything}, logarithmic")
            axes[1, column].set_yscale("log")
        # curves fall far below one star: they are not what the axis is for
        most = [np.histogram(r, np.linspace(-tail, tail, 122))[0].max() for r in residual.T]
        axes[1, 0].set_ylim(0.5, 2.0 * max(*most, 1))
        for ax in axes[:, 0]:
            ax.set_ylabel(f"{things} of the sample per bin" if sampled else f"{things} per bin")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        fig.legend(handles, labels, loc="outside upper left", ncols=len(labels))
    return fig


def _histogram(
    ax: Axes,
    values: Float,
    curve: MixtureCurve,
    reach: float,
    bins: int,
    factor: float,
    things: str,
) -> None:
    edges = np.linspace(-reach, reach, bins + 1)
    counts, _ = np.histogram(values, edges)
    good, outlying = curve.expected(edges)
    middle = (edges[1:] + edges[:-1]) / 2 * factor
    ax.stairs(counts, edges * factor, fill=True, color="#C5CED8", label=things, zorder=1)
    ax.plot(middle, good + outlying, color=PALETTE["blue"], label="expected", zorder=3)
    if curve.outliers != "none":
        ax.plot(
            middle,
            outlying,
            color=PALETTE["vermilion"],
            ls="--",
            label="of these, outliers",
            zorder=4,
        )
    ax.set_xlim(-reach * factor, reach * factor)


def residuals_by_magnitude(
    mag: Float,
    residual: Float,
    *,
    unit: str,
    errors: MagnitudeErrors | None = None,
    sampled: bool = False,
    things: str = "stars",
) -> Figure:
    """Density of the residuals against magnitude, with the errors assigned to each magnitude.

    Parameters
    ----------
    mag : ndarray, shape (N,)
        Stars without a finite magnitude are left out.
    residual : ndarray, shape (N, 2)
    unit : str
        Of the residuals.
    errors : MagnitudeErrors, optional
    sampled : bool
        Whether these are some stars of more, which the labels then say.
    things : str
        What the residuals are of: 'stars' or 'detections'.

    Returns
    -------
    matplotlib.figure.Figure
    """
    shown = f"sampled {things}" if sampled else things
    known = np.isfinite(mag)
    mag, residual = mag[known], residual[known]
    reach = _magnitude_reach(residual, errors)
    scale = display_scale(unit, reach)
    low, high = np.quantile(mag, [0.002, 0.998])  # a few very bright stars must not fill the plot
    pad = 0.02 * max(high - low, 0.1)
    with figure_style():
        fig = new_figure(WIDTH, 3.2)
        axes = fig.subplots(1, 2, sharey=True)
        for ax, axis, values in zip(axes, "uv", residual.T, strict=True):
            inside = (np.abs(values) <= reach) & (
                np.abs(2 * mag - low - high) <= high - low + 2 * pad
            )
            hexagons = ax.hexbin(
                mag[inside],
                values[inside] * scale.factor,
                gridsize=(45, 30),
                extent=(low - pad, high + pad, -reach * scale.factor, reach * scale.factor),
                mincnt=1,
                norm=LogNorm(vmin=1),
                cmap=SEQUENTIAL,
                linewidths=0.1,
            )
            if errors is not None:
                grid = np.linspace(low - pad, high + pad, 200)
                sigma = np.asarray(errors.at(grid)["uv".index(axis)]) * scale.factor
                for edge in (-sigma, sigma):
                    ax.plot(grid, edge, color="white", lw=2.6)
                    ax.plot(grid, edge, color=PALETTE["vermilion"], lw=1.3)
            ax.axhline(0.0, color=INK, lw=0.5)
            ax.set_xlim(low - pad, high + pad)
            ax.set_ylim(-reach * scale.factor, reach * scale.factor)
            ax.set_title(f"{axis}: {int((~inside).sum())} of {values.size} {shown} lie outside")
            ax.set_xlabel("magnitude [mag]")
        axes[0].set_ylabel(f"residual [{scale.unit}]")
        fig.colorbar(hexagons, ax=axes, label=f"{shown} per hexagon", fraction=0.04, pad=0.01)
    return fig


def _magnitude_reach(residual: Float, errors: MagnitudeErrors | None) -> float:
    """Height of the plot: the faintest stars' errors with room, and not the outliers."""
    if errors is not None:
        return 4.0 * float(max(np.max(errors.sigma_u), np.max(errors.sigma_v)))
    scatter = 1.4826 * float(np.median(np.abs(residual)))
    return 8.0 * scatter or 1.0
