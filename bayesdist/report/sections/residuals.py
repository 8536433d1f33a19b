"""Residuals: their distribution, over the detector, against other quantities, and if held out.

Residuals are compared with their distribution under the fitted mixture, and shown against position,
column and row, magnitude, colour, epoch and exposure.  Held-out stars are compared with their
prediction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from bayesdist.diagnose.holdout.validation import HoldoutValidation
from bayesdist.report.contents import REPORT, Plot, needed
from bayesdist.report.figures.arrows import CHANCE, Arrows, significant_cells, vector_map
from bayesdist.report.figures.panels import ChipPanels, FocalPlane, Panels, chip_axes
from bayesdist.report.figures.style import CYCLE, INK, WIDTH, legend_above, new_figure
from bayesdist.report.plots.residuals import (
    VECTOR_PAD,
    MixtureCurve,
    draw_histogram,
    histogram_reach,
    largest_count,
    mixture_curves,
    significant,
    vector_scale,
)
from bayesdist.report.plots.trends import (
    MAX_BINS,
    TrueResiduals,
    draw_pixel_means,
    draw_property_means,
    plot_exposures,
    properties_of,
)
from bayesdist.report.run import (
    Mosaic,
    ReportedRun,
    has_several_chips,
    mosaic_of,
    sample_words,
    shown_residuals,
)
from bayesdist.report.sections.maps import map_panels
from bayesdist.report.texttable import TextTable, tabulated
from bayesdist.utils.arrays import Float
from bayesdist.utils.distributions import binom_ppf
from bayesdist.utils.text import count, display_scale, number

if TYPE_CHECKING:
    from bayesdist.diagnose.holdout.validation import HeldTest
    from bayesdist.diagnose.residuals.binned import BinnedResiduals

_FINE_BINS = 100  # largest number of bins along an axis

_WHAT = ("u", "v, given u", "distance")
_LEAST_RANGE = 0.3  # least range of the error factor about 1, so that chance is not exaggerated
_FEWEST = 20  # stars in a region that is coloured
_MOST_TESTS = 12
_KEY = 3.0  # length of the arrow in the key, in sigma


@REPORT.figure("fit")
def residual_histogram(run: ReportedRun) -> Plot:
    """Histograms of the two axes: the core, and everything on a logarithmic scale of counts."""
    words = run.kind.words
    text = (
        f"The line is the fitted mixture summed over the {words.rows}' own errors"
        f"{words.leverage}, not a fit to the bars: it should follow them in the core (top)"
        " and in the wings (bottom, logarithmic)."
    )
    if run.posterior.mixture.model != "none":
        text += f" The dashed part is {words.false_rows}."
    if sample_words(run):
        text += f" Drawn from {sample_words(run)}."
    return Plot(
        _histograms(
            run.diagnostics.sample.residual,
            mixture_curves(run.diagnostics.sample, run.fit, run.posterior),
            unit=run.model.unit,
            sampled=run.diagnostics.sample.partial,
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
    """Figure with two rows of panels: the core, and all residuals."""
    core, tail = histogram_reach(residual, curves)
    everything = "whole sample" if sampled else f"all {rows}"
    fig = new_figure(WIDTH, 4.9)
    axes = fig.subplots(2, 2, sharey="row")
    for column, (axis, curve) in enumerate(zip("uv", curves, strict=True)):
        for ax, reach, tails in zip(axes[:, column], (core, tail), (False, True), strict=True):
            scale = display_scale(unit, reach)
            draw_histogram(ax, residual[:, column], curve, reach, scale, rows, tails=tails)
            ax.set_xlabel(f"residual in {axis} [{scale.unit}]")
        axes[0, column].set_title(f"{axis}: core")
        axes[1, column].set_title(f"{axis}: {everything}, logarithmic")
    axes[1, 0].set_ylim(0.5, 2.0 * largest_count(residual, tail))
    for ax in axes[:, 0]:
        ax.set_ylabel(f"{rows} of the sample per bin" if sampled else f"{rows} per bin")
    legend_above(fig, axes[0, 0])
    return fig


@REPORT.figure("fit", printed=lambda run: run.kind.words.prints_data)
def residual_vectors(run: ReportedRun) -> Plot:
    """Mean residual vector of each cell of the detector; pale ones are what noise would give."""
    binned = shown_residuals(run)
    plane = map_panels(run, colorbar=False)
    panels = (
        _in_plane(binned, plane, unit=run.model.unit)
        if isinstance(plane, FocalPlane)
        else residual_panels(binned, mosaic_of(run), unit=run.model.unit)
    )
    filled = sum(int((np.asarray(cells.count) > 0).sum()) for cells in binned)
    significant = sum(int(significant_cells(cells).sum()) for cells in binned)
    chance = CHANCE * filled
    axes, note, cannot = "", run.kind.words.residuals, "the polynomial cannot follow"
    if run.model.frames not in ("none", "shift"):  # they turn u and v
        axes = ", along the axes of the polynomials, before the exposures' frames turn them"
    if run.tables.tables:
        cannot = "neither tables nor polynomial follow"
        if significant < chance / 2:
            note += " They are fewer than by chance, as the tables follow these very stars."
    return Plot(
        panels.figure,
        "Binned residuals",
        f"Mean residual of each cell{axes}; dark arrows differ from zero by more than 2 σ."
        f" {significant} of {filled} cells do, and chance alone would give {chance:.0f}:"
        " neighbouring dark arrows that point the same way would be structure that"
        f" {cannot}.{note}",
        f"Map of binned residual vectors; {significant} of {filled} cells are significant.",
    )


def _in_plane(binned: Sequence[BinnedResiduals], plane: FocalPlane, *, unit: str) -> Panels:
    """Panel with the mean residual of each cell of all chips in a focal plane."""
    chips = []
    for arrows, frame in zip(map(Arrows.of_cells, binned), plane.frames, strict=True):
        x, y = frame(arrows.x, arrows.y)
        chips.append(replace(arrows, x=x, y=y))  # u and v are the same on all chips
    magnification, key = vector_scale(chips)
    clear, total = sum(arrows.n_clear for arrows in chips), sum(arrows.x.size for arrows in chips)
    title = f"{clear} of {total} significant, {CHANCE * total:.0f} by chance"
    vector_map(
        plane, chips, [title], magnification=magnification, key=key, unit=unit, pad=VECTOR_PAD
    )
    return plane


def residual_panels(
    binned: Sequence[BinnedResiduals],
    mosaic: Mosaic,
    *,
    unit: str,
    magnification: float | None = None,
    key: float | None = None,
) -> Panels:
    """Panels with the mean residual of each cell, at the same scale for all chips.

    `magnification`: pixels of the axes per `unit` of the vectors; a round number by default. `key`:
    length of the arrow that states the scale; that of a typical vector by default. Empty cells stay
    empty.
    """
    chips = [Arrows.of_cells(b) for b in binned]
    default_magnification, default_key = vector_scale(chips)
    panels = ChipPanels(mosaic)
    panels.frame(0.03 * mosaic.longest_side)
    titles = [panels.title(k, significant(c)) for k, c in enumerate(chips)]
    vector_map(
        panels,
        chips,
        titles,
        magnification=magnification or default_magnification,
        key=key or default_key,
        unit=unit,
        pad=VECTOR_PAD,
    )
    return panels


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


@REPORT.table("holdout", needs=("diagnostics.holdout.coverage",))
def holdout_coverage(run: ReportedRun) -> TextTable:
    """Table of the coverage of the held-out stars along each axis."""
    held_out = needed(run.diagnostics.holdout)
    rows = [
        {
            "Axis": c.axis,
            "Within": f"{c.level:g} σ",
            "Stars": count(c.n),
            "Fraction": f"{c.value:.3f}",
            "95 % interval": f"{c.interval[0]:.3f} to {c.interval[1]:.3f}",
            "Predicted": f"{c.expected:.3f}",
        }
        for c in held_out.coverage
    ]
    note = "False matches are part of the prediction; the interval is that of independent stars."
    return tabulated("Coverage of the held-out stars", rows, words=(0, 1), note=note)


@REPORT.table("holdout", needs=("diagnostics.holdout",))
def holdout_table(run: ReportedRun) -> TextTable:
    """Table of the most informative tests."""
    stars = needed(run.diagnostics.holdout)
    shown = stars.tests[:_MOST_TESTS]
    rows = [
        {
            "Test": _question(test, stars.unit),
            "Where": test.where,
            "Stars": count(test.n),
            "Found": number(test.value, 3),
            "Predicted": number(test.expected, 3),
            "p": number(test.p_value, 2),
            "p, corrected": number(test.p_corrected, 2),
        }
        for test in shown
    ]
    note = (
        f"The {len(shown)} most telling of {len(stars.tests)} tests, all in holdout.ecsv; corrected"
        " for their number after Holm (1979)."
    )
    return tabulated("Tests of the held-out stars", rows, words=(0, 1), note=note)


def _question(test: HeldTest, unit: str) -> str:
    return {
        "offset": f"offset, largest [{unit}]" if test.is_omnibus else f"offset [{unit}]",
        "spread": "residuals / predicted",
        "distribution": "largest difference of distributions",
        "tails": "fraction of stars",
        "deviation": "deviation from other exposures",
    }[test.name]


@REPORT.figure(
    "holdout", needs=("diagnostics.holdout",), printed=lambda run: run.kind.words.prints_data
)
def holdout(run: ReportedRun) -> Plot:
    """Predictive probabilities, and residuals by region in units of their prediction."""
    stars, mosaic = needed(run.diagnostics.holdout), mosaic_of(run)
    rows, columns = (max(place[k] for place in mosaic.places) + 1 for k in (0, 1))
    aspect = max(ny / nx for nx, ny in mosaic.sizes)
    panel = min(0.75 * WIDTH / columns, 4.4)
    height = 1.9 + rows * (panel * aspect + 0.7)
    fig = new_figure(WIDTH, height)
    parts = fig.subfigures(2, 1, height_ratios=[1.9, height - 1.9], squeeze=False)
    top, bottom = parts[:, 0]
    for k, ax in enumerate(top.subplots(1, 3, sharey=True)):
        _histogram(ax, stars, k)
    grid = bottom.subplots(rows, columns, squeeze=False)
    panels = [grid[place] for place in mosaic.places]
    limit = _limit(stars)
    norm = TwoSlopeNorm(1.0, 1.0 / limit, limit)
    for k, (size, name) in enumerate(zip(mosaic.sizes, mosaic.names, strict=True)):
        drawn = _regions(panels[k], stars, k, size, norm)
        panels[k].set_title(name or "Regions")
    for ax in grid.ravel():
        ax.set_visible(ax in panels)
    bar = bottom.colorbar(drawn, ax=panels, shrink=0.9, aspect=25)
    bar.set_label("residuals / predicted [no unit]")
    n_tests = len(stars.tests)
    clause = f", {len(stars.exposures)} whole exposures among them" if stars.exposures else ""
    return Plot(
        fig,
        "Held-out stars against their prediction",
        f"{count(stars.n)} stars that the fit has not seen{clause}. Top: where each lies in its"
        " predicted distribution, false matches and the posterior's own error included; level"
        " within the band (99 % of a bin) if the prediction is right. Bottom: the residuals of"
        " each region in units of those predicted (1: as predicted), and the mean offset in its"
        f" own sigma. Of {n_tests} tests the most telling, corrected for their number:"
        f" {stars.verdict}.",
        f"Histograms of predictive probabilities and a map of normalised residuals: "
        f"{stars.verdict}.",
    )


def _histogram(ax: Axes, found: HoldoutValidation, k: int) -> None:
    counts = found.pit[k]
    bins = len(counts)
    low, high = binom_ppf([0.005, 0.995], found.n, 1 / bins) * bins / found.n
    ax.axhspan(low, high, color=CYCLE[0], alpha=0.18, lw=0)
    ax.axhline(1.0, color=INK, lw=0.8)
    ax.stairs(counts * bins / found.n, np.linspace(0, 1, bins + 1), color=CYCLE[0], lw=1.3)
    ax.set_xlim(0, 1)
    ax.set_ylim(0, max(2.0, 1.1 * float(counts.max()) * bins / found.n))
    ax.set_xlabel("predicted probability of less")
    ax.set_title(_WHAT[k])
    if k == 0:
        ax.set_ylabel("stars / predicted")


def _limit(found: HoldoutValidation) -> float:
    """Largest factor on the colour scale."""
    good = found.region_scale[found.region_n >= _FEWEST]
    far = np.exp(np.abs(np.log(good)).max()) if good.size else 1.0
    return float(np.clip(far, 1 + _LEAST_RANGE, 4.0))


def _regions(
    ax: Axes, found: HoldoutValidation, k: int, size: tuple[float, float], norm: TwoSlopeNorm
) -> PatchCollection:
    """Draw the regions of one chip: colour shows the factor, arrows the offset in sigma."""
    chips = list(dict.fromkeys(bin_.chip for bin_ in found.regions))
    mine = [
        b
        for b, bin_ in enumerate(found.regions)
        if bin_.chip == chips[k] and found.region_n[b] >= _FEWEST
    ]
    boxes = []
    for b in mine:
        x0, x1, y0, y1 = found.regions[b].limits
        boxes.append(Rectangle((x0, y0), x1 - x0, y1 - y0))
    drawn = PatchCollection(boxes, cmap="RdBu_r", norm=norm, ec="white", lw=0.6)
    drawn.set_array(found.region_scale[mine])
    ax.add_collection(drawn)
    chip_axes(ax, size)
    ax.label_outer()
    if not mine:
        return drawn
    edges = np.array([found.regions[b].limits for b in mine])
    length = 0.28 * float(np.median(edges[:, 1] - edges[:, 0])) / _KEY  # pixels of one sigma
    arrows = ax.quiver(
        edges[:, :2].mean(axis=1),
        edges[:, 2:].mean(axis=1),
        *(found.region_offset[mine].T * length),
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=0.005,
        color=INK,
        ec="white",
        lw=0.4,
    )
    if k == 0:
        ax.quiverkey(
            arrows,
            0.9,
            1.05,
            _KEY * length,
            f"offset of {_KEY:g} σ",
            labelpos="W",
            coordinates="axes",
        )
    return drawn
