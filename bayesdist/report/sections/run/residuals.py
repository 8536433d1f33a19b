"""Residuals relative to their distribution under the fitted mixture, and over the detector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from bayesdist.report.contents import REPORT, Plot
from bayesdist.report.figures.arrows import CHANCE, Arrows, significant_cells, vector_map
from bayesdist.report.figures.mosaic import Mosaic
from bayesdist.report.figures.panels import ChipPanels, FocalPlane, Panels
from bayesdist.report.figures.style import WIDTH, legend_above, new_figure
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
from bayesdist.report.run import ReportedRun, mosaic_of, sample_words, shown_residuals
from bayesdist.report.sections.run.maps import map_panels
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import display_scale

if TYPE_CHECKING:
    from bayesdist.diagnose.residuals.binned import BinnedResiduals


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
