"""Residuals against position, column and row, magnitude, colour, epoch and exposure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from bayesdist.report.contents import REPORT, Plot, needed
from bayesdist.report.figures.style import WIDTH, legend_above, new_figure
from bayesdist.report.plots.trends import (
    MAX_BINS,
    TrueResiduals,
    draw_pixel_means,
    draw_property_means,
    plot_exposures,
    properties_of,
)
from bayesdist.report.run import ReportedRun, has_several_chips, sample_words
from bayesdist.utils.text import count, display_scale, number

_FINE_BINS = 100  # largest number of bins along an axis


def _against_pixels(run: ReportedRun, most: int, *, points: bool) -> tuple[Figure, float]:
    """Figure of u and v against x and y, and the largest mean in units of its error."""
    residuals = TrueResiduals.of(run.diagnostics.sample, run.posterior)
    means = {pixel_axis: residuals.by_pixel(pixel_axis, most) for pixel_axis in "xy"}
    all_means = [mean for by_chip in means.values() for mean in by_chip.values()]
    largest = max((mean.reach for mean in all_means), default=0.0) or 1.0
    reach = 4.0 * residuals.scatter if points else 1.1 * largest
    scale = display_scale(run.model.unit, reach)
    fig = new_figure(WIDTH, 2.4)
    axes = fig.subplots(2, 2, sharey=True, sharex="col")
    for column, which in enumerate("xy"):
        for row, axis in enumerate("uv"):
            ax = axes[row, column]
            of_chips = means[which]
            title = draw_pixel_means(ax, residuals, of_chips, which, axis, scale, points=points)
            ax.set_title(title)
        axes[1, column].set_xlabel(f"{which} [pix]")
    for row, axis in enumerate("uv"):
        axes[row, 0].set_ylabel(f"residual d{axis}\n[{scale.unit}]")
    axes[0, 0].set_ylim(-reach * scale.factor, reach * scale.factor)
    if has_several_chips(run):
        legend_above(fig, axes[0, 0])
    return fig, max((mean.largest_pull for mean in all_means), default=0.0)


def _sample_words(run: ReportedRun) -> str:
    words = f" Likely {run.kind.words.false_rows} are left out."
    return f"{words} Drawn from {sample_words(run)}." if sample_words(run) else words


@REPORT.figure(
    "residuals", when=lambda run: run.diagnostics.sample.by_exposure is not None, printed=True
)
def chi_square_by_exposure(run: ReportedRun) -> Plot:
    """Chi-square per degree of freedom of each exposure, with the range that chance gives."""
    sums = needed(run.diagnostics.sample.by_exposure)
    n, mean = len(sums.names), sums.of_all
    width = 2 * mean * sums.chance
    fig = new_figure(WIDTH, 1.5)
    plot_exposures(sums, fig.subplots())
    away = np.abs(sums.ratio - mean) / width
    worst, beyond = int(np.argmax(away)), int((away > 1).sum())
    return Plot(
        fig,
        "Chi-square by exposure",
        "Chi-square per degree of freedom with the errors that the posterior uses, jitter"
        f" included. The line is that of all exposures, {number(mean)}: below 1 where many"
        f" parameters were fitted to few {run.kind.words.rows}. The band about it holds 95 % by"
        " chance;"
        f" {count(beyond)} of {count(n)} exposures lie outside it, and the farthest is"
        f" {sums.names[worst]}, with {number(float(sums.ratio[worst]))}. Exposures above the band"
        " have larger errors than the others (guiding, focus, breathing); the status says whether"
        f" that is more than a trifle.{_sample_words(run)}",
        f"Chi-square per degree of freedom of {n} exposures; {beyond} lie outside the band of"
        " chance.",
    )


@REPORT.figure("residuals", printed=True)
def residuals_by_position(run: ReportedRun) -> Plot:
    """Residuals du and dv against x and y, with means in bins and their errors."""
    figure, worst = _against_pixels(run, MAX_BINS, points=True)
    return Plot(
        figure,
        "Residuals against position",
        f"Points are single {run.kind.words.rows}, markers the weighted means in bins with their"
        " 1 σ errors. Means scatter about zero, with a χ² near the number of bins, where the"
        f" polynomial follows the distortion; the largest is {worst:.1f} times its"
        f" error.{_sample_words(run)}",
        "Four panels of residuals du and dv against x and y, with binned means; the largest mean"
        f" is {worst:.1f} times its error.",
    )


@REPORT.figure("residuals", printed=True)
def residuals_by_column_and_row(run: ReportedRun) -> Plot:
    """Mean residuals of narrow strips of columns and of rows, with their errors."""
    figure, worst = _against_pixels(run, _FINE_BINS, points=False)
    return Plot(
        figure,
        "Mean residuals by column and row",
        "Weighted means over narrow strips of columns (left) and of rows (right), with 1 σ errors."
        " Steps or saw teeth are errors of the pixel grid, as at the edges of stitched blocks, that"
        f" no polynomial follows. The largest mean is {worst:.1f} times its error."
        f"{_sample_words(run)}",
        "Four panels of mean residuals by column and by row; the largest mean is"
        f" {worst:.1f} times its error.",
    )


@REPORT.figure(
    "residuals", when=lambda run: bool(properties_of(run.diagnostics.sample)), printed=True
)
def residuals_by_property(run: ReportedRun) -> Plot:
    """Mean residuals against magnitude, colour and epoch, with their errors."""
    residuals, rows = (
        TrueResiduals.of(run.diagnostics.sample, run.posterior),
        properties_of(run.diagnostics.sample),
    )
    fig = new_figure(WIDTH, 0.4 + 1.25 * len(rows))
    axes = fig.subplots(len(rows), 2, sharex="row", sharey="row", squeeze=False)
    worst = []
    for panels, (name, (label, values)) in zip(axes, rows.items(), strict=True):
        mean = residuals.by_property(values)
        scale = display_scale(run.model.unit, mean.reach or 1.0)
        for axis, ax in zip("uv", panels, strict=True):
            ax.set_title(draw_property_means(ax, mean, axis, name, scale))
            ax.set_xlabel(label)
        panels[0].set_ylabel(f"mean residual\n[{scale.unit}]")
        worst.append(f"{number(mean.largest_pull, 2)} ({name})")
    listed = ", ".join(worst)
    return Plot(
        fig,
        f"Residuals against {_listed(list(rows))}",
        "Weighted means in bins with equal numbers of stars, or by date, with their 1 σ errors. A"
        " slope is an error that goes with the brightness (charge transfer, PSF), with the colour"
        " (filter, refraction) or with time (drift, proper motions). The largest means in units of"
        f" their errors: {listed}.{_sample_words(run)}",
        f"Mean residuals with errors; the largest in units of their errors: {listed}.",
    )


def _listed(names: Sequence[str]) -> str:
    *first_names, last = names
    return f"{', '.join(first_names)} and {last}" if first_names else last
