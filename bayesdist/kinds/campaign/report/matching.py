"""Catalogue and matching: errors against magnitude, cuts, and footprints of the exposures."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.ticker import ScalarFormatter

from bayesdist.kinds.campaign.report.data import CatalogStars, campaign_data, summary_section
from bayesdist.report.contents import REPORT, Plot, needed
from bayesdist.report.figures.style import (
    GUIDE,
    INK,
    PALETTE,
    SEQUENTIAL,
    WIDTH,
    guide_lines,
    new_figure,
)
from bayesdist.report.run import ReportedRun
from bayesdist.report.texttable import TextTable, listing
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import count, number, percent, size_of

_DOT = "#8FA3B5"
_LEFT_OUT = PALETTE["vermilion"]


@REPORT.table("campaign-matching")
def matching_table(run: ReportedRun) -> TextTable:
    """Table of matched detections, and of those that were left out."""
    data = campaign_data(run)
    m = summary_section(run, "matching")
    left_out = {
        name: int(data.matching[name].sum())
        for name in ("too bright", "too faint", "saturated", "poor fit")
        if name in data.matching.colnames
    }
    low, high = m["radius"]
    pairs = {
        "Catalogue": f"{count(m['n_catalog'])} stars, {count(m['n_catalog_used'])} used",
        "Exposures": f"{count(m['n_exposures'])} in {data.filter}",
        "Detections": count(m["n_detections"]),
        **{f"Left out: {name}": count(n) for name, n in left_out.items()},
        "Pairs": count(m["n_pairs"]),
        "Completeness": f"{percent(m['completeness']['median'])} at the median,"
        f" {percent(m['completeness']['least'])} at least",
        "False pairs expected": percent(m["false_fraction"], 2),
        "Search radius": f"{number(low)} to {number(high)} {run.model.unit}",
    }
    return listing("Matching", pairs)


@REPORT.figure("campaign-matching", needs=("report_data.catalog",))
def catalogue_errors(run: ReportedRun) -> Plot:
    """Errors of positions, and of proper motions with the limit of their selection.

    Figure 3 of Kozhurina-Platais et al. (2015).
    """
    data = campaign_data(run)
    catalog, centroids = needed(data.catalog), run.errors.by_magnitude
    section = summary_section(run, "matching")
    fig = new_figure(WIDTH, 3.3)
    position_axes, right = fig.subplots(1, 2)
    if catalog.sigma is not None:
        position_axes.plot(
            catalog.mag, catalog.sigma, ".", ms=1.2, color=_DOT, label="catalogue, quoted"
        )
    if centroids is not None:
        points = np.hypot(centroids.scatter_u, centroids.scatter_v)
        line = np.hypot(centroids.sigma_u, centroids.sigma_v)
        position_axes.plot(
            centroids.mag,
            points,
            "o",
            ms=2.8,
            color=PALETTE["blue"],
            label="residuals, scatter",
        )
        position_axes.plot(centroids.mag, line, color=INK, label="one detection, fitted")
    position_axes.set_ylabel(rf"error of the position, $\sigma_{{uv}}$ [{catalog.unit}]")
    position_axes.set_title("Positions")
    if catalog.sigma_motion is not None:
        _motions(right, catalog, catalog.sigma_motion)
    else:
        right.remove()
    for ax in fig.axes:
        ax.set_yscale("log")
        ax.set_xlabel("instrumental magnitude [mag]")
        ax.grid(True, which="major", lw=0.4, color=GUIDE, zorder=0)
        legend = ax.legend(loc="upper center", markerscale=2.2, handlelength=1.6)
        legend.set_zorder(6)
    n = int(section["n_catalog"])
    text = "Left: errors of the positions, both axes together."
    if catalog.sigma is not None:
        text += " Grey: those that the catalogue quotes."
    if centroids is not None:
        best = float(np.hypot(centroids.sigma_u, centroids.sigma_v).min())
        text += (
            " Blue: scatter of the residuals by magnitude; line: error of a single detection, which"
            " is that scatter with the catalogue's part taken out; at best"
            f" {size_of(best, run.model.unit)}."
        )
    if catalog.limit is not None:
        text += (
            " Right: errors of the proper motions; stars above the line are left out, and"
            f" {count(section['n_catalog_used'])} of {count(n)} are used."
        )
    elif catalog.sigma_motion is not None:
        text += f" Right: errors of the proper motions; all {count(n)} stars are used."
    if len(catalog.mag) < n:
        text += f" {count(len(catalog.mag))} stars are drawn."
    return Plot(
        fig,
        "Errors of catalogue and detections against magnitude",
        text,
        "Errors of positions and of proper motions rise towards faint magnitudes.",
    )


def _motions(ax: Axes, catalog: CatalogStars, error: Float) -> None:
    good = np.ones(len(catalog.mag), bool)
    if catalog.limit is not None:
        mag, sigma = catalog.limit
        good = error <= np.exp(np.interp(catalog.mag, mag, np.log(sigma)))
    ax.plot(catalog.mag[good], error[good], ".", ms=1.2, color=_DOT, label="used")
    if catalog.limit is not None:
        bad = ~good
        ax.plot(
            catalog.mag[bad],
            error[bad],
            ".",
            ms=1.2,
            color=PALETTE["orange"],
            label="left out",
        )
        ax.plot(*catalog.limit, color=_LEFT_OUT, label="limit")
    ax.set_ylabel(f"error of the proper motion [{catalog.unit}/yr]")
    ax.set_title("Proper motions, larger axis")


@REPORT.figure("campaign-matching", needs=("report_data.detections",))
def fit_quality(run: ReportedRun) -> Plot:
    """Quality of the PSF fit against magnitude, with the cuts."""
    d = needed(campaign_data(run).detections)
    faintest, brightest = np.quantile(d.mag, (0.9995, 0.001))
    low, high = np.quantile(d.q[d.q > 0], (0.0005, 0.9995))
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
    ax.set_xlabel("instrumental magnitude [mag]")
    ax.set_ylabel("quality of the fit q")
    legend = ax.legend(loc="upper center", ncols=3, markerscale=4)
    legend.set_zorder(6)
    text = (
        "Detections of all exposures; those between the cuts are kept,"
        f" {count(d.n_kept)} of {count(d.n_total)} ({percent(d.n_kept / d.n_total)})."
    )
    if d.mag_cuts:
        text += f" Cuts at magnitudes {', '.join(f'{m:g}'.replace('-', '−') for m in d.mag_cuts)}"
        text += "." if d.q_max is None else f" and q = {d.q_max:g}."
    elif d.q_max is not None:
        text += f" Cut at q = {d.q_max:g}."
    text += (
        " Bright stars with a poor fit are saturated; faint ones have little signal."
        f" {count(len(d.mag))} detections are drawn."
    )
    return Plot(
        fig,
        "Quality of the fit against magnitude",
        text,
        "Scatter of fit quality against magnitude with the cuts as dashed lines.",
    )


@REPORT.figure("campaign-matching")
def matching(run: ReportedRun) -> Plot:
    """Completeness and fraction of false pairs of each exposure, against its date."""
    data = campaign_data(run)
    epoch = np.asarray(data.matching["epoch"], float)
    rows = (
        ("completeness [%]", 100 * np.asarray(data.matching["completeness"], float), "blue"),
        (
            "false pairs [10⁻⁶]",
            1e6 * np.asarray(data.matching["false_fraction"], float),
            "vermilion",
        ),
        ("pairs", np.asarray(data.matching["matched"], float), "green"),
    )
    fig = new_figure(WIDTH, 4.2)
    axes = fig.subplots(len(rows), 1, sharex=True)
    for ax, (label, values, color) in zip(axes, rows, strict=True):
        ax.plot(epoch, values, "o", ms=3.2, mec="none", color=PALETTE[color])
        ax.set_ylabel(label)
        ax.margins(y=0.15)
        guide_lines(ax)
    axes[1].set_ylim(bottom=-0.05 * max(axes[1].get_ylim()[1], 1.0))
    axes[2].set_ylim(bottom=0)
    axes[2].set_xlabel("epoch [yr]")
    fig.align_ylabels(axes)
    m = summary_section(run, "matching")
    completeness = m["completeness"]
    return Plot(
        fig,
        "Matching by exposure",
        "Top: part of the catalogue's stars in the footprint and range of magnitudes that is"
        f" matched, {percent(completeness['median'])} at the median and"
        f" {percent(completeness['least'])} at least. Middle: fraction of pairs that is expected"
        f" to be false, {number(m['false_fraction'], 2)} over all. Bottom: pairs,"
        f" {count(m['n_pairs'])} in {count(m['n_exposures'])} exposures. Search radii were"
        f" {number(m['radius'][0])} to {size_of(m['radius'][1], run.model.unit)}.",
        "Completeness, fraction of false pairs and number of pairs of each exposure against date.",
    )


@REPORT.figure("campaign-matching", needs=("report_data.footprints",))
def footprints(run: ReportedRun) -> Plot:
    """Outlines of the chips of every exposure over the catalogue."""
    data = campaign_data(run)
    field = needed(data.footprints)
    fig = new_figure(0.85 * WIDTH, 0.78 * WIDTH, layout="compressed")
    ax = fig.subplots()
    ax.plot(field.u, field.v, ".", ms=1.3, color="#9AA7B4", mec="none", zorder=1)
    # many outlines would obscure each other, so only three of them are bold
    dates = np.unique(field.epoch)
    strong = np.isin(field.epoch, dates[[0, len(dates) // 2, -1]])
    for selected, style in (
        (~strong, {"lw": 0.4, "alpha": 0.35, "zorder": 2}),
        (strong, {"lw": 1.6, "alpha": 1.0, "zorder": 3}),
    ):
        rows = np.flatnonzero(selected)
        shown = [field.outlines[k] for k in rows]
        lines = LineCollection(shown, array=field.epoch[rows], cmap=SEQUENTIAL, **style)
        lines.set_clim(dates[0], dates[-1])
        ax.add_collection(lines)
    ax.set_aspect("equal")
    ax.autoscale_view()
    ax.set_xlabel(f"u [{field.unit}]")
    ax.set_ylabel(f"v [{field.unit}]")
    bar = fig.colorbar(lines, ax=ax, fraction=0.045, pad=0.02, label="epoch [yr]")
    bar.ax.yaxis.set_major_formatter(ScalarFormatter(useOffset=False))
    ax.tick_params(colors=INK)
    n = len(field.outlines) // len(run.model.chips)
    rolls: Float = np.ma.filled(np.ma.asarray(data.matching["pa_v3"], float), np.nan)
    text = (
        f"Outlines of the chips of {count(n)} exposures over the catalogue, coloured by date; the"
        " first, the middle and the last one are drawn strong."
    )
    if np.isfinite(rolls).any():
        text += f" PA_V3 runs from {np.nanmin(rolls):.0f}° to {np.nanmax(rolls):.0f}°."
    text += f" {count(len(field.u))} stars are drawn."
    return Plot(
        fig, "Footprints", text, "Outlines of all exposures over the stars of the catalogue."
    )
