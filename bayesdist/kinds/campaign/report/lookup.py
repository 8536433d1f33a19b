"""Look-up tables: residuals without and with them, and errors of their nodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize

from bayesdist.kinds.campaign.report.data import (
    TableResiduals,
    campaign_data,
    chip_name,
    summary_section,
)
from bayesdist.model import LookupTable
from bayesdist.report.contents import REPORT, Plot, needed
from bayesdist.report.figures.arrows import Arrows, magnification_of, spacing, vector_map
from bayesdist.report.figures.fields import Grid, scalar_map
from bayesdist.report.figures.panels import ChipPanels
from bayesdist.report.figures.style import OUTLINE, PALETTE, WIDTH, new_figure, nice_below
from bayesdist.report.run import ReportedRun, mosaic_of
from bayesdist.report.sections.residuals import residual_panels
from bayesdist.report.texttable import TextTable, listing, tabulated
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import count, display_scale, number, size_of

if TYPE_CHECKING:
    from bayesdist.diagnose.residuals.binned import BinnedResiduals

WITHOUT, WITH = PALETTE["vermilion"], PALETTE["blue"]
_REACH = 4.5  # limit of the axes, in robust standard deviations of the residuals without tables


@REPORT.table("campaign-tables")
def lookup_table(run: ReportedRun) -> TextTable:
    """Table that describes the look-up tables of each chip."""
    t = summary_section(run, "tables")
    if not t.get("chips"):
        return listing("Look-up tables", {"Method": "none: no tables were fitted"})
    words = {
        "field": "Gaussian random field",
        "binned": "binned and smoothed",
        "none": "not fitted",
    }
    rows = [
        {
            "Of": row.get("filter") or "detector",
            "Chip": chip_name(run, row["chip"]),
            "Nodes": "{1} × {0}".format(*row["nodes"]),
            "Rms of an axis [pix]": number(row["rms"]),
            "Largest [pix]": number(row["largest"]),
            "σ, median [pix]": number(row["sigma_median"]),
        }
        for row in t["chips"]
    ]
    caption, note = f"Look-up tables: {words.get(t['method'], t['method'])}", ""
    if "converged" in t:
        caption += ", converged" if t["converged"] else ", NOT converged"
        note = (
            f"Rms residual of an axis: {number(t['rms_before'])} pix before the tables of this run,"
            f" {number(t['rms_after'])} pix with them."
        )
    if t.get("detector"):
        note = f"The detector's are those of {t['detector']}. {note}".strip()
    return tabulated(caption, rows, words=(0, 1), note=note)


@REPORT.figure(
    "campaign-tables",
    needs=(
        "report_data.residuals",
        "tables.tables",
    ),
)
def table_residuals(run: ReportedRun) -> Plot:
    """Residuals of single stars on each chip, without the tables and with them.

    Figures 6 and 7 of Kozhurina-Platais et al. (2015).
    """
    data = campaign_data(run)
    places = mosaic_of(run).places
    order = sorted(range(len(data.residuals)), key=lambda k: places[k])
    chips = [data.residuals[k] for k in order]  # from top to bottom
    residuals = np.concatenate([c.without for c in chips])
    reach = _REACH * 1.4826 * float(np.median(np.abs(residuals)))
    scale = display_scale("pix", reach)
    fig = new_figure(WIDTH, 2.35 * len(chips) + 0.35)
    grid = fig.subplots(len(chips), 3, squeeze=False)
    for axes, chip in zip(grid, chips, strict=True):
        name = chip.chip.name or f"chip {chip.chip.number}"
        parts = (
            (chip.without, "without tables", WITHOUT),
            (needed(chip.with_tables), "with", WITH),
        )
        for ax, (residual, words, color) in zip(axes, parts, strict=False):
            _cloud(ax, residual * scale.factor, reach * scale.factor, color)
            ax.set_title(f"{name}, {words}")
            ax.set_xlabel(f"residual in x [{scale.unit}]")
        axes[0].set_ylabel(f"residual in y [{scale.unit}]")
        axes[1].tick_params(labelleft=False)
        edges = np.linspace(-reach, reach, 91) * scale.factor
        for residual, words, color in parts:
            for k, style in enumerate(("-", ":")):
                counts, _ = np.histogram(residual[:, k] * scale.factor, edges)
                label = f"{'xy'[k]}, {words.split()[0]}"
                axes[2].stairs(counts, edges, color=color, ls=style, lw=1.0, label=label)
        axes[2].set_xlim(edges[0], edges[-1])
        axes[2].set_title(f"{name}, histograms")
        axes[2].set_xlabel(f"residual [{scale.unit}]")
        axes[2].set_ylabel("stars drawn per bin")
    grid[0, 2].legend(loc="upper left", fontsize=6.5, handlelength=1.5, borderaxespad=0.2)
    t = summary_section(run, "tables")
    drawn = sum(len(c.without) for c in chips)
    text = (
        "Each point is a star in one exposure, after the best polynomial and a linear map of the"
        " exposure, along the axes of the detector. What is elongated or has corners on the left is"
        " structure that no polynomial follows."
    )
    if "rms_before" in t:
        before, after = (size_of(float(t[f"rms_{when}"])) for when in ("before", "after"))
        text += f" The tables bring the rms of an axis from {before} to {after}."
    text += (
        f" Histograms: full lines x, dotted y. {count(drawn)} stars are drawn, each with both"
        " residuals; the farthest may lie beyond the panels."
    )
    return Plot(
        fig,
        f"Residuals {_base(run)} and with all look-up tables",
        text,
        "Clouds of residuals of each chip, narrower with the tables than before, and histograms.",
    )


def _cloud(ax: Axes, residual: Float, reach: float, color: str) -> None:
    ax.axhline(0, color=OUTLINE, lw=0.5, zorder=0)
    ax.axvline(0, color=OUTLINE, lw=0.5, zorder=0)
    ax.plot(*residual.T, ".", ms=1.3, mec="none", alpha=0.55, color=color)
    ax.set_xlim(-reach, reach)
    ax.set_ylim(-reach, reach)
    ax.set_box_aspect(1)


def _base(run: ReportedRun) -> str:
    """Clause on the fit with which residuals with tables are compared."""
    return "with the detector's tables alone" if _has_filter(run) else "without"


def _has_filter(run: ReportedRun) -> bool:
    """True if the run fitted tables of a filter to those of the detector."""
    return any(table.filter for table in run.tables.tables)


@REPORT.figure(
    "campaign-tables",
    needs=("report_data.residuals",),
    each=lambda run: {
        f"residuals_{which}_tables": which
        for which in ("without", *(("with",) if run.tables.tables else ()))
    },
)
def residual_map(run: ReportedRun, which: str) -> Plot:
    """Mean residual of each cell, without the tables or with them, at one scale for both.

    Figure 10 of Kozhurina-Platais et al. (2015).
    """
    data = campaign_data(run)
    binned = binned_of(data.residuals, which)
    # common scale for both maps, chosen for the vectors without tables
    length = np.concatenate(
        [_lengths(chip_residuals.binned_without) for chip_residuals in data.residuals]
    )
    typical = float(np.quantile(length, 0.95)) if length.size else 1.0
    step = min(
        spacing(chip_residuals.binned_without.x, chip_residuals.binned_without.y)
        for chip_residuals in data.residuals
    )
    M = nice_below(1.6 * step / typical) if typical > 0 else 1.0
    key = nice_below(float(length.max(initial=0.0)) / 1.5)
    panels = residual_panels(binned, mosaic_of(run), unit="pix", magnification=M, key=key)
    mean, noise = rms_of_cells(*binned)
    cell = data.residuals[0].chip.size[0] / len(binned[0].x)
    largest = largest_cell(*binned)
    text = (
        f"Mean residual of each cell of {cell:.0f} pixels, along the axes of the detector; light"
        f" arrows differ from zero by less than 2 σ. The largest is {size_of(largest)}; the rms of"
        f" an axis over the cells is {size_of(mean)}, where the scatter inside the cells alone"
        f" would give {size_of(noise)}."
    )
    if which == "without":
        text += " What stands out repeats in all exposures."
        alone = _has_filter(run)
        title = f"Residuals over the detector, {_base(run)}{'' if alone else ' tables'}"
    else:
        if mean < noise:
            text += " It is less, because the tables follow these very stars."
        text += " The scale is that of the figure before."
        title = "Residuals over the detector, with the tables"
    return Plot(
        panels.figure, title, text, f"Map of residual vectors; the largest is {size_of(largest)}."
    )


def binned_of(chips: Sequence[TableResiduals], which: str) -> list[BinnedResiduals]:
    """Binned residuals of all chips, 'without' or 'with' the tables."""
    all_binned = [c.binned_without if which == "without" else c.binned_with for c in chips]
    return [binned for binned in all_binned if binned is not None]


def _lengths(binned: BinnedResiduals) -> Float:
    length = np.hypot(binned.mean_u, binned.mean_v)[np.asarray(binned.count) > 0]
    return np.asarray(length[np.isfinite(length)], float)


def largest_cell(*binned: BinnedResiduals) -> float:
    """Length of the longest mean vector."""
    return max((float(_lengths(b).max(initial=0.0)) for b in binned), default=0.0)


def rms_of_cells(*binned: BinnedResiduals) -> tuple[float, float]:
    """Rms per axis of the means of the cells, and the value expected from their scatter."""
    mean, noise = [], []
    for b in binned:
        full = np.isfinite(b.mean_u) & np.isfinite(b.sem_u) & np.isfinite(b.sem_v)
        mean += [b.mean_u[full], b.mean_v[full]]
        noise += [b.sem_u[full], b.sem_v[full]]
    square = (np.concatenate(a) ** 2 for a in (mean, noise))
    first, second = (float(np.sqrt(s.mean())) if s.size else np.nan for s in square)
    return first, second


def _figures_by_filter(run: ReportedRun, name: str, *, known: bool) -> Mapping[str, str]:
    """Names of figures by filter ('' for the detector); with `known`, only with known errors."""
    tables = [t for t in run.tables.tables if t.sigma is not None or not known]
    return {f"{name}_{t.filter}" if t.filter else name: t.filter for t in tables}


def _by_chip(run: ReportedRun, filter: str) -> list[LookupTable | None]:
    """Table of each chip; None for chips without a table."""
    of = {table.chip: table for table in run.tables.tables if table.filter == filter}
    return [of.get(chip.number) for chip in run.model.chips]


@REPORT.figure(
    "campaign-tables",
    needs=("tables.tables",),
    each=lambda run: _figures_by_filter(run, "table_nodes", known=False),
)
def table_nodes(run: ReportedRun, filter: str) -> Plot:
    """Shifts of the pixels by the tables of a filter, an arrow at each node."""
    chips = _by_chip(run, filter)
    tables = [t for t in run.tables.tables if t.filter == filter]
    length = np.concatenate([np.hypot(*t.values).ravel() for t in tables])
    panels = ChipPanels(mosaic_of(run))
    panels.frame(0.03 * mosaic_of(run).longest_side)
    arrows, titles = [], []
    for k, table in enumerate(chips):
        chip_arrows, text = None, "no table"
        if table is not None:
            x, y = (a.ravel() for a in np.meshgrid(*table.nodes()))
            du, dv = (a.ravel() for a in table.values)
            chip_arrows = Arrows(x, y, du, dv, min(table.step))
            text = f"largest shift {np.hypot(*table.values).max():.3g} pix"
        arrows.append(chip_arrows)
        titles.append(panels.title(k, text))
    vector_map(
        panels,
        arrows,
        titles,
        magnification=magnification_of(
            1.6 * min(min(t.step) for t in tables), float(np.quantile(length, 0.95))
        ),
        key=nice_below(length.max() / 1.5),
        pad=20.0,
    )
    parts = []
    for t in tables:
        ny, nx = t.shape
        rms = float(np.sqrt((t.values**2).mean()))
        parts.append(f"{chip_name(run, t.chip)}: {nx} × {ny}, rms of an axis {size_of(rms)}")
    whose = f"filter {filter}, applied second" if filter else "the detector, applied first"
    largest = max(float(np.hypot(*t.values).max()) for t in tables)
    return Plot(
        panels.figure,
        f"Look-up tables of {filter or 'the detector'}",
        f"What the tables of {whose}, add to the pixels of a star, at every node"
        f" ({'; '.join(parts)}). The largest shift is {size_of(largest)}.",
        f"Map of the shifts at the nodes; the largest is {size_of(largest)}.",
    )


@REPORT.figure(
    "campaign-tables",
    needs=("tables.tables",),
    each=lambda run: _figures_by_filter(run, "table_errors", known=True),
)
def table_errors(run: ReportedRun, filter: str) -> Plot:
    """Standard errors of the nodes along x and y, in one scale of colours."""
    chips = _by_chip(run, filter)
    tables = [t for t in run.tables.tables if t.filter == filter]
    errors = np.concatenate([t.sigma.ravel() for t in tables if t.sigma is not None])
    # a few nodes without stars must not dominate the colour scale
    low, high = float(errors.min()), float(np.quantile(errors, 0.995))
    scale = display_scale("pix", high)
    panels = ChipPanels(mosaic_of(run), 2, colorbar=True)
    panels.frame()
    grids: list[Grid | None] = []
    titles = []
    for k, table in enumerate(chips):
        for axis in (0, 1):
            if table is None or table.sigma is None:
                grids.append(None)
                titles.append(panels.title(k, "none"))
                continue
            sigma = table.sigma[axis] * scale.factor
            grids.append(Grid(*table.nodes(), sigma))
            titles.append(panels.title(k, f"σ of {'xy'[axis]}, median {np.median(sigma):.3g}"))
    scalar_map(
        panels,
        grids,
        titles,
        label=f"σ of a node [{scale.unit}]",
        norm=Normalize(low * scale.factor, high * scale.factor),
    )
    rows = summary_section(run, "tables").get("chips", ())
    row_by_chip_and_filter = {(row["chip"], row.get("filter") or ""): row for row in rows}
    parts, worst = [], 0.0
    for t in tables:
        if t.sigma is None:
            continue
        row = row_by_chip_and_filter.get((t.chip, filter), {})
        median = row.get("sigma_median") or float(np.median(t.sigma))
        parts.append(f"{chip_name(run, t.chip)} {size_of(median)}")
        worst = max(worst, float(t.sigma.max()))
    return Plot(
        panels.figure,
        f"Errors of the look-up tables{' of ' + filter if filter else ''}",
        f"Standard error of every node along x and along y; at the median {', '.join(parts)}, at"
        f" worst {size_of(worst)}.",
        f"Maps of the errors of the nodes; the median is {', '.join(parts)}.",
    )
