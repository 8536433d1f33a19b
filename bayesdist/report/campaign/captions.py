"""The words under the figures of matching and tables: what one sees, with which numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from bayesdist.report.campaign.context import CampaignResults
from bayesdist.report.campaign.residuals import binned_of, largest_cell, rms_of_cells
from bayesdist.report.caption import Caption
from bayesdist.report.numbers import count, number, percent, size_of

if TYPE_CHECKING:
    from bayesdist.model import LookupTable

__all__ = [
    "caption_of_catalogue",
    "caption_of_footprints",
    "caption_of_map",
    "caption_of_matching",
    "caption_of_node_errors",
    "caption_of_nodes",
    "caption_of_quality",
    "caption_of_residuals",
]

# -- catalogue and matching -----------------------------------------------------------------------


def caption_of_catalogue(r: CampaignResults) -> Caption:
    """Errors of catalogue and detections; `CampaignResults.catalog` must be there."""
    c, found = r.catalog, r.section("matching")
    assert c is not None
    n = int(found["n_catalog"])
    text = "Left: errors of the positions, both axes together."
    if c.sigma is not None:
        text += " Grey: those that the catalogue quotes."
    if r.centroids is not None:
        best = float(np.hypot(r.centroids.sigma_u, r.centroids.sigma_v).min())
        text += (
            " Blue: scatter of the residuals by magnitude; line: error of a single detection, which"
            " is that scatter with the catalogue's part taken out; at best"
            f" {size_of(best, r.unit)}."
        )
    if c.limit is not None:
        text += (
            " Right: errors of the proper motions; stars above the line are left out, and"
            f" {count(found['n_catalog_used'])} of {count(n)} are used."
        )
    elif c.sigma_motion is not None:
        text += f" Right: errors of the proper motions; all {count(n)} stars are used."
    if len(c.mag) < n:
        text += f" {count(len(c.mag))} stars are drawn."
    return Caption(
        "Errors of catalogue and detections against magnitude",
        text,
        "Errors of positions and of proper motions rise towards faint magnitudes.",
    )


def caption_of_quality(r: CampaignResults) -> Caption:
    """Quality of the fit and the cuts; `CampaignResults.detections` must be there."""
    d = r.detections
    assert d is not None
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
    return Caption(
        "Quality of the fit against magnitude",
        text,
        "Scatter of fit quality against magnitude with the cuts as dashed lines.",
    )


def caption_of_matching(r: CampaignResults) -> Caption:
    """Completeness, false pairs and number of pairs."""
    m = r.section("matching")
    completeness = m["completeness"]
    return Caption(
        "Matching by exposure",
        "Top: part of the catalogue's stars in the footprint and range of magnitudes that is"
        f" matched, {percent(completeness['median'])} at the median and"
        f" {percent(completeness['least'])} at least. Middle: share of the pairs that is expected"
        f" to be false, {number(m['false_share'], 2)} over all. Bottom: pairs,"
        f" {count(m['n_pairs'])} in {count(m['n_exposures'])} exposures. Search radii were"
        f" {number(m['radius'][0])} to {size_of(m['radius'][1], r.unit)}.",
        "Completeness, share of false pairs and number of pairs of each exposure against its date.",
    )


def caption_of_footprints(r: CampaignResults) -> Caption:
    """Where the exposures lie; `CampaignResults.footprints` must be there."""
    f = r.footprints
    assert f is not None
    n = len(f.outlines) // len(r.chips)
    rolls = np.ma.filled(np.ma.asarray(r.matching["pa_v3"], float), np.nan)
    text = (
        f"Outlines of the chips of {count(n)} exposures over the catalogue, coloured by date; the"
        " first, the middle and the last one are drawn strong."
    )
    if np.isfinite(rolls).any():
        text += f" PA_V3 runs from {np.nanmin(rolls):.0f}° to {np.nanmax(rolls):.0f}°."
    text += f" {count(len(f.u))} stars are drawn."
    return Caption("Footprints", text, "Outlines of all exposures over the stars of the catalogue.")


# -- look-up tables -------------------------------------------------------------------------------


def caption_of_residuals(r: CampaignResults) -> Caption:
    """Clouds of residuals without tables and with them."""
    t = r.section("tables")
    drawn = sum(len(c.without) for c in r.residuals)
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
    return Caption(
        f"Residuals {_base(r)} and with all look-up tables",
        text,
        "Clouds of residuals of each chip, narrower with the tables than before, and histograms.",
    )


def _base(r: CampaignResults) -> str:
    """What the residuals of a run are compared with: what its own tables were fitted over."""
    return "with the detector's tables alone" if any(r.table_filters) else "without"


def caption_of_map(r: CampaignResults, which: str) -> Caption:
    """Mean residuals of the cells, 'without' the tables or 'with' them."""
    binned = binned_of(r.residuals, which)
    mean, noise = rms_of_cells(*binned)
    cell = r.residuals[0].chip.size[0] / len(binned[0].x)
    largest = largest_cell(*binned)
    text = (
        f"Mean residual of each cell of {cell:.0f} pixels, along the axes of the detector; light"
        f" arrows differ from zero by less than 2 σ. The largest is {size_of(largest)}; the rms of"
        f" an axis over the cells is {size_of(mean)}, where the scatter inside the cells alone"
        f" would give {size_of(noise)}."
    )
    if which == "without":
        text += " What stands out repeats in all exposures."
        alone = any(r.table_filters)
        title = f"Residuals over the detector, {_base(r)}{'' if alone else ' tables'}"
    else:
        if mean < noise:
            text += " It is less, because the tables follow these very stars."
        text += " The scale is that of the figure before."
        title = "Residuals over the detector, with the tables"
    return Caption(title, text, f"Map of residual vectors; the largest is {size_of(largest)}.")


def caption_of_nodes(r: CampaignResults, tables: Sequence[LookupTable], filter: str) -> Caption:
    """Shifts at the nodes of the tables of a filter; '' is the detector."""
    parts = []
    for t in tables:
        ny, nx = t.shape
        rms = float(np.sqrt((t.values**2).mean()))
        parts.append(f"{r.chip_name(t.chip)}: {nx} × {ny}, rms of an axis {size_of(rms)}")
    whose = f"filter {filter}, applied second" if filter else "the detector, applied first"
    largest = max(float(np.hypot(*t.values).max()) for t in tables)
    return Caption(
        f"Look-up tables of {filter or 'the detector'}",
        f"What the tables of {whose}, add to the pixels of a star, at every node"
        f" ({'; '.join(parts)}). The largest shift is {size_of(largest)}.",
        f"Map of the shifts at the nodes; the largest is {size_of(largest)}.",
    )


def caption_of_node_errors(
    r: CampaignResults, tables: Sequence[LookupTable], filter: str
) -> Caption:
    """Errors of the nodes of the tables of a filter; '' is the detector."""
    rows = r.section("tables").get("chips", ())
    known = {(row["chip"], row.get("filter") or ""): row for row in rows}
    parts, worst = [], 0.0
    for t in tables:
        if t.sigma is None:
            continue
        row = known.get((t.chip, filter), {})
        median = row.get("sigma_median") or float(np.median(t.sigma))
        parts.append(f"{r.chip_name(t.chip)} {size_of(median)}")
        worst = max(worst, float(t.sigma.max()))
    return Caption(
        f"Errors of the look-up tables{' of ' + filter if filter else ''}",
        f"Standard error of every node along x and along y; at the median {', '.join(parts)}, at"
        f" worst {size_of(worst)}.",
        f"Maps of the errors of the nodes; the median is {', '.join(parts)}.",
    )
