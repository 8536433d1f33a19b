"""Plots of trends in residuals: means in bins of a quantity, and scatter by exposure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from bayesdist.errors import InputError, require_known
from bayesdist.report.figures.style import CYCLE, Tones, guide_lines
from bayesdist.report.plots.axes import axes_of, scale_of, set_title
from bayesdist.report.plots.residuals import AXES
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.text import Scale

if TYPE_CHECKING:
    from bayesdist.diagnose.residuals.stars import ExposureScatter, StarSample
    from bayesdist.infer.solution.solution import Solution

QUANTITIES = ("x", "y", "magnitude", "colour", "epoch")
MAX_POINTS = 1200  # single stars in a panel; more would overlap
STARS_PER_BIN = 25  # least average number of stars in a bin
MAX_BINS = 20  # along an axis
FEW_DAYS = 0.05  # years; dates in a shorter interval are shown in days
DAYS_PER_YEAR = 365.25
CHIP_MARKERS = "osD^vP"  # in addition to colours


@dataclass(frozen=True, eq=False)
class Means:
    """Weighted means of the residuals in bins with at least two stars."""

    at: Float  # (B,), mean of the quantity in the bin
    mean: Float  # (B, 2), of u and v
    error: Float  # (B, 2), from the scatter inside the bin
    n: Int  # (B,)

    @property
    def chi2(self) -> Float:
        """Sum of the squares of means over their errors, (2,)."""
        return np.asarray(((self.mean / self.error) ** 2).sum(axis=0))

    @property
    def largest_pull(self) -> float:
        """Largest mean in units of its error; 0 without bins."""
        return float(np.abs(self.mean / self.error).max()) if len(self.n) else 0.0

    @property
    def reach(self) -> float:
        """Largest mean with its error; 0 without bins."""
        return float((np.abs(self.mean) + self.error).max()) if len(self.n) else 0.0


def means_in_bins(t: Float, residual: Float, weight: Float, edges: Float) -> Means:
    """Means of the residuals (N, 2) of stars at t (N,), in bins with edges (B + 1,)."""
    bins = len(edges) - 1
    k = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, bins - 1)
    n, w = np.bincount(k, minlength=bins), np.bincount(k, weight, minlength=bins)
    good = n > 1
    at = np.bincount(k, t, minlength=bins)[good] / n[good]
    mean, error = np.zeros((2, bins)), np.zeros((2, bins))
    for axis, r in enumerate(residual.T):
        mean[axis, good] = np.bincount(k, weight * r, minlength=bins)[good] / w[good]
        square = np.bincount(k, (weight * (r - mean[axis, k])) ** 2, minlength=bins)
        error[axis, good] = np.sqrt(square[good] * n[good] / (n[good] - 1.0)) / w[good]
    return Means(at, mean[:, good].T, error[:, good].T, n[good])


@dataclass(frozen=True, eq=False)
class TrueResiduals:
    """Residuals of the stars that are probably true matches, along the axes of the polynomials."""

    sample: StarSample
    solution: Solution
    shown: Bool  # (N,), True for stars of the sample that are probably true matches
    residual: Float  # (n, 2), of these stars
    weight: Float  # (n,), inverse of the expected mean square

    @classmethod
    def of(cls, sample: StarSample, solution: Solution) -> TrueResiduals:
        """Residuals of a sample, converted from the frames of the exposures to the detector."""
        table, shown = sample.table, sample.probably_true
        residual, model = sample.residual[shown], solution.model
        if model.n_frame:  # effects of the detector would average out along the axes of the sky
            codes, theta = table.exposure[shown], np.asarray(solution.mean, float)
            residual = residual.copy()
            for code in np.unique(codes):
                matrix, _ = model.frame(theta, model.exposures.index(table.exposure_names[code]))
                turned = np.linalg.solve(matrix, residual[codes == code].T).T
                residual[codes == code] = turned
        variance = sample.expected_square[shown]
        return cls(sample, solution, shown, residual, np.asarray(1.0 / variance.mean(axis=1)))

    @property
    def scatter(self) -> float:
        """Robust standard deviation per axis."""
        return 1.4826 * float(np.median(np.abs(self.residual)))

    def pixels(self, which: str) -> Float:
        """Pixels x or y (n,) of the shown stars."""
        values = getattr(self.sample.table, which)[self.shown]
        return np.asarray(values, float)

    def on_chips(self) -> Iterator[tuple[int, Bool]]:
        """Index of each chip with stars, and mask (n,) of the shown stars on it."""
        chips = self.solution.model.chips
        numbers = self.sample.table.chip_number[self.shown]
        for k, chip in enumerate(chips):
            on_chip = numbers == chip.number if len(chips) > 1 else np.ones(len(numbers), bool)
            if on_chip.any():
                yield k, on_chip

    def by_pixel(self, which: str, most: int = MAX_BINS) -> dict[int, Means]:
        """Means in equal bins of x or y by index of the chip; at most `most` bins per chip."""
        t, column = self.pixels(which), "xy".index(which)
        means = {}
        for k, on_chip in self.on_chips():
            extent = self.solution.model.chips[k].size[column]
            bins = int(np.clip(int(on_chip.sum()) // STARS_PER_BIN, 2, most))
            edges = np.linspace(0.5, extent + 0.5, bins + 1)
            means[k] = means_in_bins(
                t[on_chip], self.residual[on_chip], self.weight[on_chip], edges
            )
        return means

    def by_property(self, values: Float) -> Means:
        """Means in bins of values (N,) of the sample, with equal numbers of stars."""
        t = values[self.shown]
        good = np.isfinite(t)
        edges = _quantile_edges(t[good])
        return means_in_bins(t[good], self.residual[good], self.weight[good], edges)


def properties_of(sample: StarSample) -> dict[str, tuple[str, Float]]:
    """Label with unit and values (N,) of magnitude, colour and epoch, unless all are equal."""
    table = sample.table
    columns = {
        "magnitude": ("magnitude [mag]", table.mag),
        "colour": ("colour [mag]", table.colour),
        "epoch": ("epoch [yr]", table.epoch),
    }
    out = {}
    for name, (label, values) in columns.items():
        if values is None:
            continue
        finite = values[np.isfinite(values) & sample.probably_true]
        if finite.size > 2 * STARS_PER_BIN and np.ptp(finite) > 0:
            shown = np.asarray(values, float)
            if name == "epoch" and np.ptp(finite) < FEW_DAYS:
                label = "epoch [days after the first]"
                shown = DAYS_PER_YEAR * (shown - finite.min())
            out[name] = label, shown
    return out


def _quantile_edges(values: Float) -> Float:
    """Edges of bins with equal numbers of stars, or midpoints if there are few distinct values."""
    distinct = np.unique(values)
    if distinct.size <= MAX_BINS:
        middle = (distinct[1:] + distinct[:-1]) / 2
        return np.concatenate([[distinct[0]], middle, [distinct[-1]]])
    n = int(np.clip(values.size // STARS_PER_BIN, 2, MAX_BINS))
    return np.unique(np.quantile(values, np.linspace(0, 1, n + 1)))


def plot_residual_means(
    sample: StarSample,
    against: str,
    ax: Axes | None = None,
    *,
    solution: Solution,
    axis: str = "u",
    title: str | None = None,
) -> Axes:
    """Plot weighted means of the residuals along one axis, with their errors.

    A trend of the means is an error that the model does not describe. Likely false matches are
    left out. In plots against x and y, single stars are shown as points behind the means.

    Parameters
    ----------
    sample : StarSample
        Result of `star_sample`, or the sample of the diagnostics.
    against : str
        'x', 'y', 'magnitude', 'colour' or 'epoch'.
    ax : matplotlib.axes.Axes, optional
        By default the axes of a new figure.
    solution : LinearFit or Posterior
        Solution of the residuals.
    axis : str
        'u' or 'v'.
    title : str, optional
        By default the chi-square of the means; an empty string for no title.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    InputError
        If the axis or quantity is unknown, the stars do not have the quantity or it is the same for
        all of them, or `ax` is not a single Axes.
    """
    require_known(axis, AXES, "axis", where="axis")
    require_known(against, QUANTITIES, "quantity", where="against")
    residuals = TrueResiduals.of(sample, solution)
    if against in ("x", "y"):
        means = residuals.by_pixel(against)
        ax, reach = axes_of(ax), 4.0 * residuals.scatter
        scale = scale_of(solution.model.unit, reach, None)
        default = draw_pixel_means(ax, residuals, means, against, axis, scale)
        ax.set_ylim(-reach * scale.factor, reach * scale.factor)
        ax.set_xlabel(f"{against} [pix]")
        if len(solution.model.chips) > 1:
            ax.legend()
    else:
        properties = properties_of(sample)
        if against not in properties:
            raise InputError(
                f"the stars have no {against}, or the same one",
                where="residuals",
                do=f"plot them against {', '.join(['x', 'y', *properties])}",
            )
        ax = axes_of(ax)
        label, values = properties[against]
        mean = residuals.by_property(values)
        scale = scale_of(solution.model.unit, mean.reach or 1.0, None)
        default = draw_property_means(ax, mean, axis, against, scale)
        ax.set_xlabel(label)
        ax.ticklabel_format(axis="x", useOffset=False)  # show years with four digits
    ax.set_ylabel(f"residual d{axis} [{scale.unit}]")
    set_title(ax, title, default)
    return ax


def draw_pixel_means(
    ax: Axes,
    residuals: TrueResiduals,
    means: dict[int, Means],
    against: str,
    axis: str,
    scale: Scale,
    *,
    points: bool = True,
) -> str:
    """Draw the means of each chip against x or y, with points for single stars; returns a title."""
    tones, k = Tones.of(ax), AXES.index(axis)
    chips = residuals.solution.model.chips
    if points:
        t, values = residuals.pixels(against), residuals.residual[:, k]
        step = max(1, len(t) // MAX_POINTS)
        look: dict[str, Any] = {"ms": 2.2, "color": tones.pale, "mew": 0, "zorder": 1}
        ax.plot(t[::step], values[::step] * scale.factor, ".", rasterized=True, **look)
    ax.axhline(0.0, color=tones.ink, lw=0.6, zorder=2)
    for chip, mean in means.items():
        values_of = mean.mean[:, k] * scale.factor, mean.error[:, k] * scale.factor
        draw_means(ax, chip, mean.at, *values_of, chips[chip].name if len(chips) > 1 else "")
    ax.set_xlim(0, max(chip.size["xy".index(against)] for chip in chips) + 1)
    guide_lines(ax)
    total = sum(float(mean.chi2[k]) for mean in means.values())
    bins = sum(len(mean.at) for mean in means.values())
    return f"d{axis} against {against}: χ² of the means {total:.0f} for {bins} bins"


def draw_property_means(ax: Axes, mean: Means, axis: str, against: str, scale: Scale) -> str:
    """Draw means against a property of the stars; returns a title."""
    k = AXES.index(axis)
    ax.axhline(0.0, color=Tones.of(ax).ink, lw=0.6, zorder=2)
    draw_means(ax, 0, mean.at, mean.mean[:, k] * scale.factor, mean.error[:, k] * scale.factor)
    ax.xaxis.set_major_locator(MaxNLocator(5))
    guide_lines(ax)
    return f"d{axis} against {against}: χ² {mean.chi2[k]:.0f} for {len(mean.at)} bins"


def draw_means(ax: Axes, chip: int, at: Float, mean: Float, error: Float, label: str = "") -> None:
    """Draw means with their errors in the colour and marker of a chip."""
    look: dict[str, Any] = {"color": CYCLE[chip % len(CYCLE)], "ms": 3.2, "elinewidth": 0.9}
    marker = CHIP_MARKERS[chip % len(CHIP_MARKERS)]
    ax.errorbar(at, mean, error, fmt=marker, label=label or None, zorder=3, **look)


# -- exposures ------------------------------------------------------------------------------------


def plot_exposures(scatter: ExposureScatter, ax: Axes | None = None) -> Axes:
    """Plot the chi-square per degree of freedom of each exposure.

    The line is the value of all exposures; the band around it contains 95 % by chance.

    Parameters
    ----------
    scatter : ExposureScatter
        `StarSample.by_exposure`.
    ax : matplotlib.axes.Axes, optional
        By default the axes of a new figure.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    InputError
        If `ax` is not a single Axes.
    """
    ax = axes_of(ax)
    tones, n, mean = Tones.of(ax), len(scatter.names), scatter.of_all
    width, at = 2 * mean * scatter.chance, np.arange(1, n + 1)
    band: dict[str, Any] = {"color": tones.outline, "alpha": 0.3, "lw": 0, "step": "mid"}
    ax.fill_between(at, mean - width, mean + width, **band)
    ax.axhline(mean, color=tones.ink, lw=0.6)
    ax.plot(at, scatter.ratio, "o", ms=3.2, color=CYCLE[0])
    ax.set_xlim(0.5, n + 0.5)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("exposure, in the order of the data [number]")
    ax.set_ylabel("χ² / dof [no unit]")
    guide_lines(ax)
    return ax
