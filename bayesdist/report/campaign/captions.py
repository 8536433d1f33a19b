"""The words under each figure of a campaign: what one sees, and with which numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from bayesdist.report.campaign.alignment import IN_CELL, largest_vector
from bayesdist.report.campaign.context import CampaignResults
from bayesdist.report.campaign.residuals import binned_of, largest_cell, rms_of_cells
from bayesdist.report.campaign.series import TermCourse
from bayesdist.report.campaign.words import name_of_term
from bayesdist.report.caption import Caption
from bayesdist.report.numerals import count, number, percent
from bayesdist.report.scales import display_scale

if TYPE_CHECKING:
    from bayesdist.model import LookupTable

__all__ = [
    "caption_of_catalogue",
    "caption_of_footprints",
    "caption_of_map",
    "caption_of_matching",
    "caption_of_node_errors",
    "caption_of_nodes",
    "caption_of_overlap",
    "caption_of_quality",
    "caption_of_residuals",
    "caption_of_series",
]

FALLS = 1.2  # scatter before VAFACTOR over that after it, above which the aberration is seen


def _pix(value: float, unit: str = "pix", digits: int = 3) -> str:
    return display_scale(unit, value).text(value, digits)


# -- catalogue and matching -----------------------------------------------------------------------


def caption_of_catalogue(r: CampaignResults) -> Caption:
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
            f" is that scatter with the catalogue's part taken out; at best {_pix(best, r.unit)}."
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
    m = r.section("matching")
    completeness = m["completeness"]
    return Caption(
        "Matching by exposure",
        "Top: part of the catalogue's stars in the footprint and range of magnitudes that is"
        f" matched, {percent(completeness['median'])} at the median and"
        f" {percent(completeness['least'])} at least. Middle: share of the pairs that is expected"
        f" to be false, {number(m['false_share'], 2)} over all. Bottom: pairs,"
        f" {count(m['n_pairs'])} in {count(m['n_exposures'])} exposures. Search radii were"
        f" {number(m['radius'][0])} to {_pix(m['radius'][1], r.unit)}.",
        "Completeness, share of false pairs and number of pairs of each exposure against its date.",
    )


def caption_of_footprints(r: CampaignResults) -> Caption:
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
    t = r.section("tables")
    drawn = sum(len(c.without) for c in r.residuals)
    text = (
        "Each point is a star in one exposure, after the best polynomial and a linear map of the"
        " exposure, along the axes of the detector. What is elongated or has corners on the left is"
        " structure that no polynomial follows."
    )
    if "rms_before" in t:
        before, after = (_pix(float(t[f"rms_{when}"])) for when in ("before", "after"))
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
    binned = binned_of(r.residuals, which)
    mean, noise = rms_of_cells(*binned)
    cell = r.residuals[0].chip.size[0] / len(binned[0].x)
    largest = largest_cell(*binned)
    text = (
        f"Mean residual of each cell of {cell:.0f} pixels, along the axes of the detector; light"
        f" arrows differ from zero by less than 2 σ. The largest is {_pix(largest)}; the rms of an"
        f" axis over the cells is {_pix(mean)}, where the scatter inside the cells alone would give"
        f" {_pix(noise)}."
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
    return Caption(title, text, f"Map of residual vectors; the largest is {_pix(largest)}.")


def caption_of_nodes(r: CampaignResults, tables: Sequence[LookupTable], filter: str) -> Caption:
    parts = []
    for t in tables:
        ny, nx = t.shape
        rms = float(np.sqrt((t.values**2).mean()))
        parts.append(f"{r.chip_name(t.chip)}: {nx} × {ny}, rms of an axis {_pix(rms)}")
    whose = f"filter {filter}, applied second" if filter else "the detector, applied first"
    largest = max(float(np.hypot(*t.values).max()) for t in tables)
    return Caption(
        f"Look-up tables of {filter or 'the detector'}",
        f"What the tables of {whose}, add to the pixels of a star, at every node"
        f" ({'; '.join(parts)}). The largest shift is {_pix(largest)}.",
        f"Map of the shifts at the nodes; the largest is {_pix(largest)}.",
    )


def caption_of_node_errors(
    r: CampaignResults, tables: Sequence[LookupTable], filter: str
) -> Caption:
    rows = r.section("tables").get("chips", ())
    known = {(row["chip"], row.get("filter") or ""): row for row in rows}
    parts, worst = [], 0.0
    for t in tables:
        if t.sigma is None:
            continue
        row = known.get((t.chip, filter), {})
        median = row.get("sigma_median") or float(np.median(t.sigma))
        parts.append(f"{r.chip_name(t.chip)} {_pix(median)}")
        worst = max(worst, float(t.sigma.max()))
    return Caption(
        f"Errors of the look-up tables{' of ' + filter if filter else ''}",
        f"Standard error of every node along x and along y; at the median {', '.join(parts)}, at"
        f" worst {_pix(worst)}, where stars are few or the edge leaves a node without neighbours.",
        f"Maps of the errors of the nodes; the median is {', '.join(parts)}.",
    )


# -- time -----------------------------------------------------------------------------------------


def caption_of_series(
    r: CampaignResults, term: str, courses: Sequence[TermCourse], *, first: bool
) -> Caption:
    series, found = r.series, r.section("time_dependence")
    assert series is not None
    unit = r.unit if courses[0].is_constant else ""

    def size(value: float | None) -> str:
        if value is None or not np.isfinite(value):
            return "unknown"
        return _pix(value, unit) if unit else number(value, 2)

    def each(texts: Sequence[str]) -> str:
        one = zip(courses, texts, strict=True)
        return "; ".join(f"{c.chip} {text}" if c.chip else text for c, text in one)

    rms = each([f"from {size(c.rms_raw)} to {size(c.rms)}" for c in courses])
    own = each([size(found.get("scatter", {}).get(c.label)) for c in courses])
    verdicts = {row["term"]: row["claim"] for row in found.get("verdicts", ())}
    falls = all(c.rms_raw > FALLS * c.rms for c in courses)
    text = _how_to_read(np.isfinite(series.pa_v3).any()) if first else "As the figure before."
    text += (
        f" With VAFACTOR the scatter about the lines {'falls' if falls else 'hardly changes'}:"
        f" {rms}. Beyond the formal errors the exposures scatter by {own}."
    )
    if all(c.label in verdicts for c in courses):
        text += f" What held-out exposures support: {each([verdicts[c.label] for c in courses])}."
    off = int(series.outlying.sum())
    text += f" Crosses mark {count(off)} outlying exposures." if off else " No exposure lies off."
    if not found.get("converged", True):
        text += " The sampler of the lines did not reach its targets: bands are provisional."
    return Caption(
        f"{name_of_term(term)} against time",
        text,
        f"{name_of_term(term)} against time and roll angle; scatter about the lines {rms}.",
    )


def _how_to_read(with_roll: bool) -> str:
    places = ", left against time and right against PA_V3" if with_roll else ""
    return (
        f"Each exposure fitted by itself, with formal errors{places}. Top: as measured. Middle:"
        " VAFACTOR applied, with the line of each segment, its 68 % band and the wider one of a"
        " new exposure. Bottom: rate times time since the reference date taken out; steps between"
        " segments stay."
    )


# -- release --------------------------------------------------------------------------------------


def caption_of_overlap(r: CampaignResults) -> Caption:
    t = r.overlap
    assert t is not None
    a, b = t.names
    days = abs(t.epochs[1] - t.epochs[0])
    rolls = ""
    if np.isfinite(t.pa_v3).all():
        rolls = f" and PA_V3 {t.pa_v3[0]:.0f}° and {t.pa_v3[1]:.0f}°"
    old, new = (float(np.sqrt(np.mean(x.rms**2))) for x in (t.old, t.new))
    text = (
        f"{a} and {b} ({t.epochs[0]:.2f} and {t.epochs[1]:.2f}, {days:.1f} years apart{rolls}):"
        f" {count(t.n_stars)} shared stars, corrected for distortion and brought onto each other by"
        " shift, rotation and scale; mean of what is left in each cell of"
        f" {IN_CELL} stars or more. Left: through the known distortion that the matching started"
        " from; right: through tables, polynomial and drift of this run, without anything fitted"
        f" to these two exposures. Largest cell {_pix(largest_vector(t.binned_old))} and"
        f" {_pix(largest_vector(t.binned_new))}; rms of an axis over the stars"
        f" {_pix(old)} and {_pix(new)}."
    )
    if t.with_motions:
        text += " The catalogue's proper motions between the two dates are taken out."
    text += f" Pixels of {t.pixel_mas:g} mas; both panels have one scale."
    return Caption(
        "Two exposures laid on each other",
        text,
        "Residual vectors between two exposures, with a pattern on the left and little on the"
        f" right: rms {_pix(old)} and {_pix(new)}.",
    )
