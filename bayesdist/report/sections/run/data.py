"""Input data, with errors by magnitude."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from bayesdist.report.contents import REPORT, Plot, needed
from bayesdist.report.figures.fields import Grid, scalar_map
from bayesdist.report.figures.style import WIDTH, new_figure
from bayesdist.report.plots.residuals import draw_density
from bayesdist.report.run import ReportedRun, marked, sample_words, setting, shown_residuals
from bayesdist.report.sections.run.maps import map_panels, map_titles
from bayesdist.report.texttable import (
    MAX_ROWS,
    TextTable,
    further,
    listing,
    short_paths,
    tabulated,
)
from bayesdist.utils.arrays import Bool, Float
from bayesdist.utils.text import MISSING, count, display_scale, number

if TYPE_CHECKING:
    from bayesdist.data import MagnitudeErrors


@REPORT.table("data")
def data_tables(run: ReportedRun) -> tuple[TextTable, ...]:
    """Tables of rows read and rejected, errors by magnitude, and exposures."""
    m, fit, words = run.diagnostics.sample.table, run.fit, run.kind.words
    partial = ", of the sample" if run.diagnostics.sample.partial else ""
    pairs = {
        "Sources": ", ".join(short_paths(m.sources)),
        "Rows read": count(m.n_rows),
        words.all_rows.capitalize(): count(run.diagnostics.sample.n_total),
        f"Used by the {words.rejection}": count(fit.n_used),
        "Unit of u, v": m.unit,
        "Exposures": count(np.count_nonzero(run.diagnostics.sums.exposures.n)),
    }
    if any(m.filter_names):
        pairs["Filters"] = ", ".join(f for f in m.filter_names if f)
    if m.epoch is not None:
        first, last = f"{np.min(m.epoch):.2f}", f"{np.max(m.epoch):.2f}"
        pairs[f"Epochs [yr]{partial}"] = first if first == last else f"{first} to {last}"
    if m.mag is not None and np.isfinite(m.mag).any():
        pairs[f"Magnitudes{partial}"] = f"{np.nanmin(m.mag):.2f} to {np.nanmax(m.mag):.2f}"
    sigma_setting = setting(run, "data", "sigma", "as given")
    pairs[f"Errors of the {words.rows}"] = (
        "by magnitude, see below"
        if run.errors.by_magnitude is not None
        else (
            str(sigma_setting)
            if isinstance(sigma_setting, str)
            else f"{sigma_setting:g} {m.unit} on each axis"
        )
    )
    reasons = [(f"{k} (reading)", count(v)) for k, v in m.rejected.items()]
    reasons += [(f"{k} ({words.rejection})", count(v)) for k, v in fit.rejected.items()]
    rejected = TextTable(
        "Rows left out, by reason",
        ("Reason", "Rows"),
        tuple(reasons) or (("none", "0"),),
        note=f"The posterior uses all {words.all_rows}: the mixture replaces rejection.",
    )
    note = f"Figures and tables of single {words.rows} show {sample_words(run)}." if partial else ""
    out = [listing("Input", pairs, note), rejected]
    if run.errors.by_magnitude is not None:
        out.append(_magnitude_table(run))
    if len(m.exposure_names) > 1:
        out.append(_exposure_table(run))
    return tuple(out)


def _magnitude_table(run: ReportedRun) -> TextTable:
    e = needed(run.errors.by_magnitude)
    scale = display_scale(run.model.unit, np.concatenate([e.sigma_u, e.sigma_v]))
    rows = [
        {
            "Magnitude": f"{mag:.2f}".replace("-", "−"),
            run.kind.words.rows.capitalize(): count(n),
            f"σ u [{scale.unit}]": number(su * scale.factor),
            f"σ v [{scale.unit}]": number(sv * scale.factor),
        }
        for mag, n, su, sv in zip(e.mag, e.n, e.sigma_u, e.sigma_v, strict=True)
    ]
    caption = "Errors by magnitude, estimated from the residuals"
    return tabulated(caption, rows, words=(), detail=True)


def _exposure_table(run: ReportedRun) -> TextTable:
    names, fit, sums = (
        run.diagnostics.sample.table.exposure_names,
        run.fit,
        run.diagnostics.sums.exposures,
    )
    scale = display_scale(run.model.unit, [fit.rms_u, fit.rms_v])
    flagged = run.diagnostics.flagged
    rows = [
        {
            "Exposure": names[k],
            run.kind.words.rows.capitalize(): count(sums.n[k]),
            "Used": count(sums.n_used[k]),
            f"rms u [{scale.unit}]": number(sums.rms[0][k] * scale.factor),
            f"rms v [{scale.unit}]": number(sums.rms[1][k] * scale.factor),
            "Outliers (P > 0.5)": MISSING if flagged is None else marked(run, count(flagged[k])),
        }
        for k in np.flatnonzero(sums.n)
    ]
    return tabulated("Exposures", rows[:MAX_ROWS], note=further(len(rows)), detail=True)


@REPORT.figure("data", when=lambda run: bool(_magnitudes(run).any()))
def residuals_by_magnitude(run: ReportedRun) -> Plot:
    """Density of the residuals against magnitude, with the errors assigned to each magnitude."""
    words, has_magnitude = run.kind.words, _magnitudes(run)
    text = f"Residuals grow towards faint stars; colour counts {words.rows}."
    if run.errors.by_magnitude is not None:
        addition = (
            ", or somewhat more, because the stars were fitted to them" if words.leverage else ""
        )
        text += " The lines are ±1 σ as assigned to each magnitude: about two thirds of the"
        text += f" {words.rows} lie between them{addition}."
    if sample_words(run):
        text += f" Drawn from {sample_words(run)}."
    return Plot(
        _density(
            needed(run.diagnostics.sample.table.mag)[has_magnitude],
            run.diagnostics.sample.residual[has_magnitude],
            unit=run.model.unit,
            errors=run.errors.by_magnitude,
            shown=f"sampled {words.rows}" if run.diagnostics.sample.partial else words.rows,
        ),
        "Residuals against magnitude",
        text,
        "Two density plots of the residuals in u and v against magnitude, widening to faint stars.",
    )


@REPORT.figure("data", printed=lambda run: run.kind.words.prints_data)
def coverage(run: ReportedRun) -> Plot:
    """Map of the number of stars in each cell of the detector."""
    grids = [
        Grid(cells.x, cells.y, np.asarray(cells.count, float)) for cells in shown_residuals(run)
    ]
    panels = map_panels(run)
    counts = np.concatenate([g.values.ravel() for g in grids])
    rows, false_rows = run.kind.words.rows, run.kind.words.false_rows
    scalar_map(
        panels,
        grids,
        map_titles(panels, grids, [lambda low, high: f"{low:.0f} to {high:.0f} a cell"]),
        norm=Normalize(0.0, max(float(counts.max()), 1.0)),
        label=f"{rows} per cell [count]",
    )
    empty = int((counts == 0).sum())
    return Plot(
        panels.figure,
        "Coverage of the detector",
        f"Number of {rows} in each cell, without likely {false_rows}: {count(empty)} of"
        f" {count(counts.size)} cells are empty, and the median is {np.median(counts):.0f}. Where"
        f" there are no {rows}, the solution is an extrapolation of the polynomial.",
        f"Map of the number of {rows} per cell; {empty} of {counts.size} cells are empty.",
    )


def _magnitudes(run: ReportedRun) -> Bool:
    """Boolean mask (N,) that is True for stars with a known magnitude."""
    mag = run.diagnostics.sample.table.mag
    return np.zeros(len(run.diagnostics.sample.table), bool) if mag is None else np.isfinite(mag)


def _density(
    mag: Float, residual: Float, *, unit: str, errors: MagnitudeErrors | None, shown: str
) -> Figure:
    """Figure with hexagons that count residuals, with a panel for each axis."""
    fig = new_figure(WIDTH, 3.2)
    axes = fig.subplots(1, 2, sharey=True)
    for ax, axis in zip(axes, "uv", strict=True):
        hexagons, scale, outside = draw_density(ax, mag, residual, axis, unit=unit, errors=errors)
        ax.set_title(f"{axis}: {outside} {shown} lie outside")
        ax.set_xlabel("magnitude [mag]")
    axes[0].set_ylabel(f"residual [{scale.unit}]")
    fig.colorbar(hexagons, ax=axes, label=f"{shown} per hexagon", fraction=0.04, pad=0.01)
    return fig
