"""Plots of residuals: over the detector, as histograms, and against magnitude."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LogNorm
from numpy.typing import ArrayLike
from scipy.special import ndtr

from bayesdist.errors import InputError, require_known, required
from bayesdist.report.figures.arrows import (
    CHANCE,
    Arrows,
    draw_arrows,
    draw_key,
    magnification_of,
)
from bayesdist.report.figures.panels import chip_axes
from bayesdist.report.figures.style import PALETTE, SEQUENTIAL, Tones, nice_below
from bayesdist.report.plots.axes import add_colorbar, axes_of, scale_of, set_title
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import Scale, count

if TYPE_CHECKING:
    from bayesdist.data import MagnitudeErrors
    from bayesdist.diagnose.residuals.binned import BinnedResiduals
    from bayesdist.diagnose.residuals.stars import StarSample
    from bayesdist.infer import LinearFit, Posterior

AXES = ("u", "v")
VECTOR_PAD = 24.0  # points between a panel and its title, so that the key fits below the title
SIGMA_BINS = 200  # largest number of widths, to which those of all stars are binned

# -- over the detector ----------------------------------------------------------------------------


def plot_residual_vectors(
    binned: BinnedResiduals,
    ax: Axes | None = None,
    *,
    unit: str = "pix",
    scale_mas: float | None = None,
    magnification: float | None = None,
    key: float | None = None,
    name: str = "",
    title: str | None = None,
) -> Axes:
    """Plot the mean residual of each cell of a chip as a vector.

    Dark vectors differ from zero by more than 2 sigma; pale ones are consistent with noise.

    Parameters
    ----------
    binned : BinnedResiduals
    ax : matplotlib.axes.Axes, optional
        By default the axes of a new figure.
    unit : str
        Unit of the residuals.
    scale_mas : float, optional
        Size of a pixel in mas; if given, a length in pixels is stated in mas.
    magnification : float, optional
        Length of a vector in pixels of the axes for a residual of 1; a round number by default.
    key : float, optional
        Length of the vector above the axes, in `unit`; a round number by default.
    name : str
        Name of the chip, which begins the default title.
    title : str, optional
        By default the number of significant vectors; an empty string for no title.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    InputError
        If `ax` is not a single Axes.
    """
    ax = axes_of(ax)
    arrows = Arrows.of_cells(binned)
    size = float(binned.x[0] + binned.x[-1] - 1), float(binned.y[0] + binned.y[-1] - 1)
    chip_axes(ax, size, margin=0.03 * max(size))
    scale = vector_scale([arrows])
    M = scale[0] if magnification is None else magnification
    draw_arrows(ax, arrows, magnification=M)
    length = scale[1] if key is None else key
    draw_key(ax, length, magnification=M, unit=unit, scale_mas=scale_mas)
    set_title(ax, title, significant(arrows), name, pad=VECTOR_PAD)
    return ax


def vector_scale(chips: Sequence[Arrows]) -> tuple[float, float]:
    """Magnification of the mean residuals of some chips, and length of their key."""
    length = np.concatenate([arrows.length for arrows in chips])
    # a single bad cell with three stars must not make all other vectors short
    typical = float(np.quantile(length, 0.95)) if length.size else 0.0
    step = min(arrows.step for arrows in chips)
    return magnification_of(1.1 * step, typical), nice_below(typical)


def significant(arrows: Arrows) -> str:
    """Number of significant vectors of a chip, and number expected by chance."""
    n = arrows.x.size
    return f"{arrows.n_clear} of {n} significant, {CHANCE * n:.0f} by chance"


# -- histograms -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class MixtureCurve:
    """Distribution of the residuals along one axis under the fitted mixture."""

    sigma: Float  # (N,), quoted error of each star on this axis
    fraction: float = 0.0  # fraction of outliers, f
    jitter: float = 0.0  # j, added in quadrature to every quoted error
    scale: float = 0.0  # s_out of Gaussian outliers, or the match radius of uniform ones
    outliers: str = "none"  # 'gaussian', 'uniform' or 'none'
    taken: Float | float = 0.0  # (N,), fraction of the variance absorbed by fitted star positions

    @property
    def typical_error(self) -> float:
        """Square root of the median variance of true matches."""
        return float(np.sqrt(np.median(self.sigma**2 + self.jitter**2)))

    @property
    def largest_error(self) -> float:
        """Largest standard error of a true match."""
        return float(np.sqrt(np.max(self.sigma**2 + self.jitter**2)))

    def expected(self, edges: ArrayLike) -> tuple[Float, Float]:
        """Expected numbers of true matches and of outliers in bins (B,) with edges (B + 1,)."""
        edges = np.asarray(edges, float)
        sigma, weight = self._widths()
        good = weight @ np.diff(ndtr(edges / sigma[:, None]), axis=1)
        n = float(self.sigma.size)
        outlying = n * np.diff(self._outlier_cdf(edges))
        f = 0.0 if self.outliers == "none" else self.fraction
        return (1.0 - f) * good, f * outlying

    def _widths(self) -> tuple[Float, Float]:
        """Distinct total widths, and numbers of stars with each; binned if there are many."""
        total = np.hypot(self.sigma, self.jitter) * np.sqrt(1.0 - self.taken)
        values, counts = np.unique(total, return_counts=True)
        if values.size > SIGMA_BINS:
            # equal steps of log width; the mean square of a bin preserves the variance
            edges = np.geomspace(values[0], values[-1], SIGMA_BINS + 1)
            bin_of_star = np.clip(
                np.searchsorted(edges, total, side="right") - 1, 0, SIGMA_BINS - 1
            )
            counts = np.bincount(bin_of_star, minlength=SIGMA_BINS)
            square = np.bincount(bin_of_star, weights=total**2, minlength=SIGMA_BINS)
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


def mixture_curves(
    sample: StarSample, fit: LinearFit, posterior: Posterior | None
) -> tuple[MixtureCurve, MixtureCurve]:
    """Distributions of the residuals in u and v for a posterior, or for the quoted errors only.

    The rms of the fit is used if no errors are quoted.
    """
    table = sample.table
    sigmas = [
        np.full(len(table), rms) if sigma is None else np.asarray(sigma, float)
        for sigma, rms in ((table.sigma_u, fit.rms_u), (table.sigma_v, fit.rms_v))
    ]
    if posterior is None:
        return MixtureCurve(sigmas[0]), MixtureCurve(sigmas[1])

    def sampled(name: str) -> float:
        """Posterior mean of a parameter of the mixture; 0 if it was not sampled."""
        return float(np.mean(posterior.hyper[name])) if name in posterior.hyper else 0.0

    mixture = posterior.mixture
    jitter = sampled("j") if mixture.jitter is None else float(mixture.jitter)
    absorbed = 0.0 if sample.taken is None else sample.taken
    scale = sampled("s_out")
    if mixture.model == "uniform":
        scale = required(mixture.match_radius, "a uniform mixture needs a match radius")
    u, v = (
        MixtureCurve(sigma, sampled("f"), jitter, scale, mixture.model, absorbed)
        for sigma in sigmas
    )
    return u, v


def plot_residual_histogram(
    sample: StarSample,
    ax: Axes | None = None,
    *,
    fit: LinearFit,
    posterior: Posterior | None = None,
    axis: str = "u",
    tails: bool = False,
    rows: str = "stars",
    title: str | None = None,
    legend: bool = True,
) -> Axes:
    """Plot a histogram of the residuals along one axis with the distribution that is expected.

    The expected curve is the fitted mixture summed over the stars' errors, not a fit to the bars.

    Parameters
    ----------
    sample : StarSample
        Result of `star_sample`, or the sample of the diagnostics.
    ax : matplotlib.axes.Axes, optional
        By default the axes of a new figure.
    fit : LinearFit
    posterior : Posterior, optional
        Posterior of the residuals; without it the curve uses the quoted errors.
    axis : str
        'u' or 'v'.
    tails : bool
        True for all residuals with a logarithmic scale of counts, False for the core only.
    rows : str
        Word for the rows of the data in labels, such as 'stars' or 'detections'.
    title : str, optional
        By default the axis and the range; an empty string for no title.
    legend : bool
        True for a legend inside the axes.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    InputError
        If the axis is unknown, or `ax` is not a single Axes.
    """
    require_known(axis, AXES, "axis", where="axis")
    ax, residual = axes_of(ax), sample.residual
    curves = mixture_curves(sample, fit, posterior)
    core, tail = histogram_reach(residual, curves)
    scale = scale_of(fit.model.unit, tail if tails else core, None)
    k = AXES.index(axis)
    draw_histogram(ax, residual[:, k], curves[k], tail if tails else core, scale, rows, tails=tails)
    ax.set_xlabel(f"residual in {axis} [{scale.unit}]")
    ax.set_ylabel(f"{rows} of the sample per bin" if sample.partial else f"{rows} per bin")
    everything = "whole sample" if sample.partial else f"all {rows}"
    set_title(ax, title, f"{axis}: {everything}, logarithmic" if tails else f"{axis}: core")
    if tails:
        ax.set_ylim(0.5, 2.0 * largest_count(residual, tail))
    if legend:
        ax.legend()
    return ax


def histogram_reach(residual: Float, curves: Sequence[MixtureCurve]) -> tuple[float, float]:
    """Largest residuals shown in the core and in full histograms, the same for both axes."""
    typical = max(curve.typical_error for curve in curves)
    widest = max(curve.largest_error for curve in curves)
    core = min(6.0 * typical, 4.0 * widest)
    return core, max(float(np.abs(residual).max()), 1.2 * core) * 1.02


def largest_count(residual: Float, tail: float) -> int:
    """Largest count of a bin on both axes, since expected curves may be far below one star."""
    edges = np.linspace(-tail, tail, 122)
    return max(*(int(np.histogram(values, edges)[0].max()) for values in residual.T), 1)


def draw_histogram(
    ax: Axes,
    values: Float,
    curve: MixtureCurve,
    reach: float,
    scale: Scale,
    rows: str,
    *,
    tails: bool,
) -> None:
    """Draw a histogram of residuals between -reach and reach, and the expected numbers."""
    edges = np.linspace(-reach, reach, (121 if tails else 81) + 1)
    counts, _ = np.histogram(values, edges)
    good, outlying = curve.expected(edges)
    middle = (edges[1:] + edges[:-1]) / 2 * scale.factor
    bars: dict[str, Any] = {"fill": True, "color": Tones.of(ax).bars, "label": rows, "zorder": 1}
    ax.stairs(counts, edges * scale.factor, **bars)
    ax.plot(middle, good + outlying, color=PALETTE["blue"], label="expected", zorder=3)
    if curve.outliers != "none":
        look: dict[str, Any] = {"color": PALETTE["vermilion"], "ls": "--", "zorder": 4}
        ax.plot(middle, outlying, label="of these, outliers", **look)
    ax.set_xlim(-reach * scale.factor, reach * scale.factor)
    if tails:
        ax.set_yscale("log")


# -- by magnitude ---------------------------------------------------------------------------------


def plot_residual_density(
    sample: StarSample,
    ax: Axes | None = None,
    *,
    unit: str = "pix",
    axis: str = "u",
    errors: MagnitudeErrors | None = None,
    rows: str = "stars",
    title: str | None = None,
    colorbar: bool = True,
) -> Axes:
    """Plot the density of the residuals along one axis against magnitude.

    Parameters
    ----------
    sample : StarSample
        Result of `star_sample`, or the sample of the diagnostics.
    ax : matplotlib.axes.Axes, optional
        By default the axes of a new figure.
    unit : str
        Unit of the residuals.
    axis : str
        'u' or 'v'.
    errors : MagnitudeErrors, optional
        Errors by magnitude, drawn as lines at +-1 sigma.
    rows : str
        Word for the rows of the data in labels, such as 'stars' or 'detections'.
    title : str, optional
        By default the number of residuals outside the axes; an empty string for no title.
    colorbar : bool
        True for a colour bar next to `ax`.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    InputError
        If stars have no magnitudes, the axis is unknown, or `ax` is not a single Axes.
    """
    require_known(axis, AXES, "axis", where="axis")
    mag = sample.table.mag
    if mag is None or not np.isfinite(mag).any():
        raise InputError(
            "the stars have no magnitudes",
            where="residuals by magnitude",
            do="plot them by position, or give the matches a magnitude",
        )
    ax, finite = axes_of(ax), np.isfinite(mag)
    shown = f"sampled {rows}" if sample.partial else rows
    drawn, scale, outside = draw_density(
        ax, mag[finite], sample.residual[finite], axis, unit=unit, errors=errors
    )
    set_title(ax, title, f"{axis}: {outside} {shown} lie outside")
    ax.set_xlabel("magnitude [mag]")
    ax.set_ylabel(f"residual in {axis} [{scale.unit}]")
    if colorbar:
        add_colorbar(ax, drawn, f"{shown} per hexagon")
    return ax


def draw_density(
    ax: Axes,
    mag: Float,
    residual: Float,
    axis: str,
    *,
    unit: str,
    errors: MagnitudeErrors | None,
) -> tuple[PolyCollection, Scale, str]:
    """Draw hexagons with counts of the residuals (N, 2) along one axis; both axes share limits.

    Returns the hexagons, the unit of the axes, and a text with the number of residuals outside.
    """
    k = AXES.index(axis)
    values, reach = residual[:, k], _magnitude_reach(residual, errors)
    scale = scale_of(unit, reach, None)
    low, high = np.quantile(mag, [0.002, 0.998])  # ignore a few very bright stars
    pad = 0.02 * max(high - low, 0.1)
    inside = (np.abs(values) <= reach) & (np.abs(2 * mag - low - high) <= high - low + 2 * pad)
    drawn = ax.hexbin(
        mag[inside],
        values[inside] * scale.factor,
        gridsize=(45, 30),
        extent=(low - pad, high + pad, -reach * scale.factor, reach * scale.factor),
        mincnt=1,
        norm=LogNorm(vmin=1),
        cmap=SEQUENTIAL,
        linewidths=0.1,
    )
    tones = Tones.of(ax)
    if errors is not None:
        grid = np.linspace(low - pad, high + pad, 200)
        sigma = np.asarray(errors.at(grid)[k]) * scale.factor
        for edge in (-sigma, sigma):
            ax.plot(grid, edge, color=tones.paper, lw=2.6)
            ax.plot(grid, edge, color=PALETTE["vermilion"], lw=1.3)
    ax.axhline(0.0, color=tones.ink, lw=0.5)
    ax.set_xlim(low - pad, high + pad)
    ax.set_ylim(-reach * scale.factor, reach * scale.factor)
    return drawn, scale, f"{count((~inside).sum())} of {count(values.size)}"


def _magnitude_reach(residual: Float, errors: MagnitudeErrors | None) -> float:
    """Largest residual shown: four times the errors of faint stars, ignoring outliers."""
    if errors is not None:
        return 4.0 * float(max(np.max(errors.sigma_u), np.max(errors.sigma_v)))
    scatter = 1.4826 * float(np.median(np.abs(residual)))
    return 8.0 * scatter or 1.0
