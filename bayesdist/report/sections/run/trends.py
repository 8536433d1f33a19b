"""Residuals against position, column and row, magnitude, colour, epoch and exposure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bayesdist.report.contents import REPORT, Plot
from bayesdist.report.context import ReportInput, needed
from bayesdist.report.figures.style import (
    CYCLE,
    INK,
    OUTLINE,
    PALE,
    WIDTH,
    guide_lines,
    legend_above,
    new_figure,
)
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.numbers import count, display_scale, number

_POINTS = 1200  # single stars in a panel: more hide each other
_MIN_STARS = 25  # in a bin on average
_BINS, _FINE_BINS = 20, 100  # most bins along an axis
_FEW_DAYS = 0.05  # years: dates in years would differ in their last digits alone
_DAYS_PER_YEAR = 365.25
_MARKERS = "osD^vP"  # of chips, beside colours


@dataclass(frozen=True, eq=False)
class Means:
    """Weighted means of the residuals in bins that hold two stars or more."""

    at: Float  # (B,), mean of the quantity in the bin
    mean: Float  # (B, 2), of u and v
    error: Float  # (B, 2), from the scatter inside the bin
    n: Int  # (B,)

    @property
    def chi2(self) -> Float:
        """Sum of the squares of means over their errors, (2,)."""
        return np.asarray(((self.mean / self.error) ** 2).sum(axis=0))


def means_in_bins(t: Float, residual: Float, weight: Float, edges: Float) -> Means:
    """Means of the residuals (N, 2) of stars at t (N,), between edges (B + 1,)."""
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
class _Residuals:
    """Residuals of the stars that are probably true, along the axes of the polynomials."""

    shown: Bool  # (N,), of the sample
    residual: Float  # (n, 2), of those shown
    variance: Float  # (n, 2), expected of them

    @property
    def weight(self) -> Float:
        """Weights (n,)."""
        return np.asarray(1.0 / self.variance.mean(axis=1))

    @property
    def scatter(self) -> float:
        """Robust standard deviation of one axis."""
        return 1.4826 * float(np.median(np.abs(self.residual)))


def _residuals_of(r: ReportInput) -> _Residuals:
    table, shown = r.stars.table, r.stars.probably_true
    residual = r.stars.residual[shown]
    model = r.fit.model
    if model.n_frame:  # what belongs to the detector would cancel along the axes of the sky
        codes, theta = table.exposure[shown], np.asarray(r.solution.mean, float)
        residual = residual.copy()
        for code in np.unique(codes):
            matrix, _ = model.frame(theta, model.exposures.index(table.exposure_names[code]))
            residual[codes == code] = np.linalg.solve(matrix, residual[codes == code].T).T
    return _Residuals(shown, residual, r.stars.expected_square[shown])


def _on_chips(r: ReportInput, shown: Bool) -> Iterator[tuple[int, str, Bool]]:
    """Index, name and mask (n,) of the stars that are shown, of each chip that has some."""
    numbers = r.stars.table.chip_number[shown]
    for k, c in enumerate(r.chips):
        here = numbers == c.chip.number if r.several else np.ones(len(numbers), bool)
        if here.any():
            yield k, c.chip.name, here


def _edges(extent: float, n: int, most: int) -> Float:
    return np.linspace(0.5, extent + 0.5, int(np.clip(n // _MIN_STARS, 2, most)) + 1)


def _errorbar(ax: Axes, k: int, at: Float, mean: Float, error: Float, label: str = "") -> None:
    """Draw means with their errors, in colour and marker of chip k."""
    ax.errorbar(
        at,
        mean,
        error,
        fmt=_MARKERS[k % len(_MARKERS)],
        ms=3.2,
        color=CYCLE[k % len(CYCLE)],
        elinewidth=0.9,
        label=label or None,
        zorder=3,
    )


def _against_pixels(r: ReportInput, most: int, *, points: bool) -> tuple[Figure, float]:
    """Figure of u and v against x and y; and the largest mean in units of its error."""
    found, table = _residuals_of(r), r.stars.table
    pixels = table.x[found.shown], table.y[found.shown]
    fig = new_figure(WIDTH, 2.4)
    axes = fig.subplots(2, 2, sharey=True, sharex="col")
    means: list[list[Means]] = [[], []]
    for k, _, here in _on_chips(r, found.shown):
        for column, t in enumerate(pixels):
            edges = _edges(r.chips[k].chip.size[column], int(here.sum()), most)
            one = means_in_bins(t[here], found.residual[here], found.weight[here], edges)
            means[column].append(one)
    reach = 4.0 * found.scatter if points else 1.1 * _reach(means)
    scale = display_scale(r.unit, reach)
    for column, t in enumerate(pixels):
        for row in (0, 1):
            ax = axes[row, column]
            if points:
                _cloud(ax, t, found.residual[:, row] * scale.factor)
            ax.axhline(0.0, color=INK, lw=0.6, zorder=2)
            for (k, name, _), one in zip(_on_chips(r, found.shown), means[column], strict=True):
                values = one.mean[:, row] * scale.factor, one.error[:, row] * scale.factor
                _errorbar(ax, k, one.at, *values, name if r.several else "")
            total = sum(float(one.chi2[row]) for one in means[column])
            bins = sum(len(one.at) for one in means[column])
            ax.set_title(
                f"d{'uv'[row]} against {'xy'[column]}: χ² of the means {total:.0f} for {bins} bins"
            )
            guide_lines(ax)
    for row in (0, 1):
        axes[row, 0].set_ylabel(f"residual d{'uv'[row]}\n[{scale.unit}]")
    for column in (0, 1):
        axes[1, column].set_xlabel(f"{'xy'[column]} [pix]")
        axes[1, column].set_xlim(0, max(c.chip.size[column] for c in r.chips) + 1)
    axes[0, 0].set_ylim(-reach * scale.factor, reach * scale.factor)
    if r.several:
        legend_above(fig, axes[0, 0])
    # largest of all means in units of their errors
    pulls = [np.abs(one.mean / one.error).max() for one in (*means[0], *means[1]) if len(one.n)]
    worst = float(max(pulls, default=0.0))
    return fig, worst


def _reach(means: Sequence[Sequence[Means]]) -> float:
    every = [np.abs(one.mean) + one.error for group in means for one in group if len(one.n)]
    return max((float(one.max()) for one in every), default=1.0) or 1.0


def _cloud(ax: Axes, t: Float, values: Float) -> None:
    step = max(1, len(t) // _POINTS)
    ax.plot(t[::step], values[::step], ".", ms=2.2, color=PALE, mew=0, zorder=1, rasterized=True)


def _sample_words(r: ReportInput) -> str:
    words = f" Likely {r.words.false_rows} are left out."
    return f"{words} Drawn from {r.sample}." if r.sample else words


@REPORT.figure("residuals", when=lambda r: r.stars.by_exposure is not None, printed=True)
def chi_square_by_exposure(r: ReportInput) -> Plot:
    """Chi-square per degree of freedom of each exposure, with the range that chance gives."""
    found = needed(r.stars.by_exposure)
    n, mean = len(found.names), found.of_all
    width = 2 * mean * found.chance
    fig = new_figure(WIDTH, 1.5)
    ax = fig.subplots()
    at = np.arange(1, n + 1)
    ax.fill_between(at, mean - width, mean + width, color=OUTLINE, alpha=0.3, lw=0, step="mid")
    ax.axhline(mean, color=INK, lw=0.6)
    ax.plot(at, found.ratio, "o", ms=3.2, color=CYCLE[0])
    ax.set_xlim(0.5, n + 0.5)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("exposure, in the order of the data [number]")
    ax.set_ylabel("χ² / dof [no unit]")
    guide_lines(ax)
    away = np.abs(found.ratio - mean) / width
    worst, beyond = int(np.argmax(away)), int((away > 1).sum())
    return Plot(
        fig,
        "Chi-square by exposure",
        "Chi-square per degree of freedom with the errors that the posterior uses, jitter"
        f" included. The line is that of all exposures, {number(mean)}: below 1 where many"
        f" parameters were fitted to few {r.words.rows}. The band about it holds 95 % by chance;"
        f" {count(beyond)} of {count(n)} exposures lie outside it, and the farthest is"
        f" {found.names[worst]}, with {number(float(found.ratio[worst]))}. Exposures above the band"
        " have larger errors than the others (guiding, focus, breathing); the status says whether"
        f" that is more than a trifle.{_sample_words(r)}",
        f"Chi-square per degree of freedom of {n} exposures; {beyond} lie outside the band of"
        " chance.",
    )


@REPORT.figure("residuals", printed=True)
def residuals_by_position(r: ReportInput) -> Plot:
    """Residuals du and dv against x and y, with means in bins and their errors."""
    figure, worst = _against_pixels(r, _BINS, points=True)
    return Plot(
        figure,
        "Residuals against position",
        f"Points are single {r.words.rows}, markers the weighted means in bins with their 1 σ"
        " errors. Means scatter about zero, with a χ² near the number of bins, where the polynomial"
        f" follows the distortion; the largest is {worst:.1f} times its error.{_sample_words(r)}",
        "Four panels of residuals du and dv against x and y, with binned means; the largest mean"
        f" is {worst:.1f} times its error.",
    )


@REPORT.figure("residuals", printed=True)
def residuals_by_column_and_row(r: ReportInput) -> Plot:
    """Mean residuals of narrow strips of columns and of rows, with their errors."""
    figure, worst = _against_pixels(r, _FINE_BINS, points=False)
    return Plot(
        figure,
        "Mean residuals by column and row",
        "Weighted means over narrow strips of columns (left) and of rows (right), with 1 σ errors."
        " Steps or saw teeth are errors of the pixel grid, as at the edges of stitched blocks, that"
        f" no polynomial follows. The largest mean is {worst:.1f} times its error."
        f"{_sample_words(r)}",
        "Four panels of mean residuals by column and by row; the largest mean is"
        f" {worst:.1f} times its error.",
    )


def _properties(r: ReportInput) -> list[tuple[str, Float]]:
    """Label with unit and values (N,) of what the stars have: magnitude, colour, epoch."""
    table = r.stars.table
    known = {"magnitude [mag]": table.mag, "colour [mag]": table.colour, "epoch [yr]": table.epoch}
    out = []
    for label, values in known.items():
        if values is not None:
            finite = values[np.isfinite(values) & r.stars.probably_true]
            if finite.size > 2 * _MIN_STARS and np.ptp(finite) > 0:
                shown = np.asarray(values, float)
                if values is table.epoch and np.ptp(finite) < _FEW_DAYS:
                    label, shown = (
                        "epoch [days after the first]",
                        _DAYS_PER_YEAR * (shown - finite.min()),
                    )
                out.append((label, shown))
    return out


def _quantile_edges(values: Float) -> Float:
    """Edges of bins with equal numbers of stars; of few distinct values, between these."""
    distinct = np.unique(values)
    if distinct.size <= _BINS:
        middle = (distinct[1:] + distinct[:-1]) / 2
        return np.concatenate([[distinct[0]], middle, [distinct[-1]]])
    n = int(np.clip(values.size // _MIN_STARS, 2, _BINS))
    return np.unique(np.quantile(values, np.linspace(0, 1, n + 1)))


@REPORT.figure("residuals", when=lambda r: bool(_properties(r)), printed=True)
def residuals_by_property(r: ReportInput) -> Plot:
    """Mean residuals against magnitude, colour and epoch, with their errors."""
    found, rows = _residuals_of(r), _properties(r)
    fig = new_figure(WIDTH, 0.4 + 1.25 * len(rows))
    axes = fig.subplots(len(rows), 2, sharex="row", sharey="row", squeeze=False)
    worst = []
    for panels, (label, values) in zip(axes, rows, strict=True):
        t = values[found.shown]
        good = np.isfinite(t)
        edges = _quantile_edges(t[good])
        one = means_in_bins(t[good], found.residual[good], found.weight[good], edges)
        scale = display_scale(r.unit, _reach([[one]]))
        what = label.partition(" ")[0]
        for axis, ax in enumerate(panels):
            ax.axhline(0.0, color=INK, lw=0.6, zorder=2)
            values_of = one.mean[:, axis] * scale.factor, one.error[:, axis] * scale.factor
            _errorbar(ax, 0, one.at, *values_of)
            ax.set_title(
                f"d{'uv'[axis]} against {what}: χ² {one.chi2[axis]:.0f} for {len(one.at)} bins"
            )
            ax.set_xlabel(label)
            ax.xaxis.set_major_locator(MaxNLocator(5))
            guide_lines(ax)
        panels[0].set_ylabel(f"mean residual\n[{scale.unit}]")
        worst.append(f"{number(float(np.abs(one.mean / one.error).max()), 2)} ({what})")
    listed = ", ".join(worst)
    return Plot(
        fig,
        f"Residuals against {_listed([label.partition(' ')[0] for label, _ in rows])}",
        "Weighted means in bins with equal numbers of stars, or by date, with their 1 σ errors. A"
        " slope is an error that goes with the brightness (charge transfer, PSF), with the colour"
        " (filter, refraction) or with time (drift, proper motions). The largest means in units of"
        f" their errors: {listed}.{_sample_words(r)}",
        f"Mean residuals with errors; the largest in units of their errors: {listed}.",
    )


def _listed(names: Sequence[str]) -> str:
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last
