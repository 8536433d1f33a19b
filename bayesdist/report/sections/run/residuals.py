"""Residuals against their distribution under the fitted mixture, and over the detector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from scipy.special import ndtr

from bayesdist.errors import required
from bayesdist.report.contents import REPORT, Plot
from bayesdist.report.context import ReportInput
from bayesdist.report.figures.arrows import (
    CHANCE,
    Arrows,
    magnification_of,
    significant_cells,
    vector_map,
)
from bayesdist.report.figures.mosaic import Mosaic
from bayesdist.report.figures.panels import ChipPanels, Panels
from bayesdist.report.figures.style import PALETTE, WIDTH, legend_above, new_figure, nice_below
from bayesdist.utils.arrays import Float
from bayesdist.utils.numbers import display_scale

if TYPE_CHECKING:
    from bayesdist.diagnose.residuals.binned import BinnedResiduals

_SIGMA_BINS = 200


@dataclass(frozen=True)
class MixtureCurve:
    """Distribution of one axis of the residuals under the fitted mixture."""

    sigma: Float  # (N,), quoted error of each star on this axis
    fraction: float = 0.0  # of outliers, f
    jitter: float = 0.0  # j, in quadrature with every quoted error
    scale: float = 0.0  # s_out of Gaussian outliers, or the match radius of uniform ones
    outliers: str = "none"  # 'gaussian', 'uniform' or 'none'
    taken: Float | float = 0.0  # (N,), fraction of the variance taken by fitted star positions

    def expected(self, edges: ArrayLike) -> tuple[Float, Float]:
        """Stars expected in each bin (B,) between edges (B + 1,): good component, outliers."""
        edges = np.asarray(edges, float)
        sigma, weight = self._widths()
        good = weight @ np.diff(ndtr(edges / sigma[:, None]), axis=1)
        n = float(self.sigma.size)
        outlying = n * np.diff(self._outlier_cdf(edges))
        f = 0.0 if self.outliers == "none" else self.fraction
        return (1.0 - f) * good, f * outlying

    def _widths(self) -> tuple[Float, Float]:
        """Total widths that occur, and numbers of stars with each (binned where there are many)."""
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


def _mixture_curves(r: ReportInput) -> tuple[MixtureCurve, MixtureCurve]:
    """Distributions of the residuals in u and in v by the results.

    Without quoted errors the rms of the fit stands in for them.
    """
    f, matches = r.fit, r.stars.table
    sigmas = [
        np.full(len(matches), rms) if sigma is None else np.asarray(sigma, float)
        for sigma, rms in ((matches.sigma_u, f.rms_u), (matches.sigma_v, f.rms_v))
    ]
    if r.posterior is None:
        return MixtureCurve(sigmas[0]), MixtureCurve(sigmas[1])
    mixture = r.posterior.mixture
    jitter = mixture.jitter if mixture.jitter is not None else r.sampled_mean("j")
    taken = 0.0 if r.stars.taken is None else r.stars.taken
    uniform = mixture.model == "uniform"
    scale = (
        required(mixture.match_radius, "a uniform mixture needs a match radius")
        if uniform
        else r.sampled_mean("s_out")
    )
    u, v = (
        MixtureCurve(s, r.sampled_mean("f"), float(jitter), scale, mixture.model, taken)
        for s in sigmas
    )
    return u, v


@REPORT.figure("fit")
def residual_histogram(r: ReportInput) -> Plot:
    """Histograms of the two axes: the core, and everything on a logarithmic scale of counts."""
    words = r.words
    if r.posterior is None:
        text = (
            "The line is what the quoted errors alone predict;"
            f" {words.rows} above it in the wings are outliers."
        )
    else:
        text = (
            f"The line is the fitted mixture summed over the {words.rows}' own errors"
            f"{words.leverage}, not a fit to the bars: it should follow them in the core (top)"
            " and in the wings (bottom, logarithmic)."
        )
        if r.posterior.mixture.model != "none":
            text += f" The dashed part is {words.false_rows}."
    if r.sample:
        text += f" Drawn from {r.sample}."
    return Plot(
        _histograms(
            r.stars.residual,
            _mixture_curves(r),
            unit=r.unit,
            sampled=r.stars.partial,
            rows=words.rows,
        ),
        "Residual histograms",
        text,
        "Histograms of residuals in u and v, core and full range, under the expected curve.",
    )


def _histograms(
    residual: Float,
    curves: tuple[MixtureCurve, MixtureCurve],
    *,
    unit: str,
    sampled: bool,
    rows: str,
) -> Figure:
    """Figure with two rows of panels: the core, and everything."""
    width = max(float(np.sqrt(np.median(c.sigma**2 + c.jitter**2))) for c in curves)
    widest = max(float(np.sqrt(np.max(c.sigma**2 + c.jitter**2))) for c in curves)
    core = min(6.0 * width, 4.0 * widest)
    tail = max(float(np.abs(residual).max()), 1.2 * core) * 1.02
    everything = "whole sample" if sampled else f"all {rows}"
    fig = new_figure(WIDTH, 4.9)
    axes = fig.subplots(2, 2, sharey="row")
    for column, (axis, curve) in enumerate(zip("uv", curves, strict=True)):
        for row, (reach, bins) in enumerate(((core, 81), (tail, 121))):
            ax = axes[row, column]
            scale = display_scale(unit, reach)
            _histogram(ax, residual[:, column], curve, reach, bins, scale.factor, rows)
            ax.set_xlabel(f"residual in {axis} [{scale.unit}]")
        axes[0, column].set_title(f"{axis}: core")
        axes[1, column].set_title(f"{axis}: {everything}, logarithmic")
        axes[1, column].set_yscale("log")
    # curves fall far below one star: the axis is not for them
    most = [np.histogram(r, np.linspace(-tail, tail, 122))[0].max() for r in residual.T]
    axes[1, 0].set_ylim(0.5, 2.0 * max(*most, 1))
    for ax in axes[:, 0]:
        ax.set_ylabel(f"{rows} of the sample per bin" if sampled else f"{rows} per bin")
    legend_above(fig, axes[0, 0])
    return fig


def _histogram(
    ax: Axes,
    values: Float,
    curve: MixtureCurve,
    reach: float,
    bins: int,
    factor: float,
    rows: str,
) -> None:
    edges = np.linspace(-reach, reach, bins + 1)
    counts, _ = np.histogram(values, edges)
    good, outlying = curve.expected(edges)
    middle = (edges[1:] + edges[:-1]) / 2 * factor
    ax.stairs(counts, edges * factor, fill=True, color="#C5CED8", label=rows, zorder=1)
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


@REPORT.figure("fit", printed=lambda r: r.campaign is None)
def residual_vectors(r: ReportInput) -> Plot:
    """Mean residual vector of each cell of the detector; pale ones are what noise would give."""
    panels = residual_panels([c.binned for c in r.chips], r.mosaic, unit=r.unit)
    filled = sum(int((np.asarray(c.binned.count) > 0).sum()) for c in r.chips)
    significant = sum(int(significant_cells(c.binned).sum()) for c in r.chips)
    chance = CHANCE * filled
    axes, which, cannot = "", "", "the polynomial cannot follow"
    if r.fit.model.frames not in ("none", "shift"):  # they turn u and v
        axes = ", along the axes of the polynomials, before the exposures' frames turn them"
    if r.campaign is not None:
        which = (
            " These are the residuals of the joint fit, with all tables, in the cells of the test"
            " for structure (see the status)."
        )
        if r.campaign.tables:
            cannot = "neither tables nor polynomial follow"
            if significant < chance / 2:
                which += " They are fewer than by chance, as the tables follow these very stars."
    if r.words.leverage:
        which = (
            " Stars were fitted to these detections, so that fewer may do so than by chance; the"
            " status has the test that allows for it."
        )
    return Plot(
        panels.figure,
        "Binned residuals",
        f"Mean residual of each cell{axes}; dark arrows differ from zero by more than 2 σ."
        f" {significant} of {filled} cells do, and chance alone would give {chance:.0f}:"
        " neighbouring dark arrows that point the same way would be structure that"
        f" {cannot}.{which}",
        f"Map of binned residual vectors; {significant} of {filled} cells are significant.",
    )


def residual_panels(
    binned: Sequence[BinnedResiduals],
    mosaic: Mosaic,
    *,
    unit: str,
    magnification: float | None = None,
    key: float | None = None,
) -> Panels:
    """Panels with the mean residual of each cell, all chips on one scale; empty cells stay empty.

    `magnification` is in pixels of the axes for one `unit` of the vectors, a round number by
    default; `key` is the length of the arrow that states the scale, that of a typical vector by
    default.
    """
    chips = [Arrows.of_cells(b) for b in binned]
    length = np.concatenate([c.length for c in chips])
    # one bad cell with three stars must not flatten all others
    typical = float(np.quantile(length, 0.95)) if length.size else 0.0
    panels = ChipPanels(mosaic)
    panels.frame(0.03 * mosaic.longest_side)
    titles = [
        panels.title(
            k,
            f"{c.n_clear} of {c.x.size} significant, {CHANCE * c.x.size:.0f} by chance",
        )
        for k, c in enumerate(chips)
    ]
    vector_map(
        panels,
        chips,
        titles,
        magnification=magnification or magnification_of(1.1 * min(c.step for c in chips), typical),
        key=key or nice_below(typical),
        unit=unit,
        pad=24.0,
    )
    return panels
