"""Tables of a campaign, as text."""

from __future__ import annotations

from collections.abc import Iterator

from bayesdist.report.campaign.context import CampaignResults
from bayesdist.report.campaign.timetables import time_tables
from bayesdist.report.numbers import MISSING, count, number, percent
from bayesdist.report.tables.text import TextTable, listing

__all__ = ["campaign_tables"]


def campaign_tables(r: CampaignResults) -> dict[str, tuple[TextTable, ...]]:
    """Tables by the part of the section that they belong to.

    Parameters
    ----------
    r : CampaignResults

    Returns
    -------
    dict of str to tuple of TextTable
    """
    return {
        "matching": (_matching(r),),
        "tables": (_lookup_tables(r),),
        "time": tuple(time_tables(r)),
        "release": tuple(_release(r)),
    }


# -- matching and tables --------------------------------------------------------------------------


def _matching(r: CampaignResults) -> TextTable:
    m = r.section("matching")
    left_out = {
        name: int(r.matching[name].sum())
        for name in ("too bright", "too faint", "saturated", "poor fit")
        if name in r.matching.colnames
    }
    low, high = m["radius"]
    pairs = {
        "Catalogue": f"{count(m['n_catalog'])} stars, {count(m['n_catalog_used'])} used",
        "Exposures": f"{count(m['n_exposures'])} in {r.filter}",
        "Detections": count(m["n_detections"]),
        **{f"Left out: {name}": count(n) for name, n in left_out.items()},
        "Pairs": count(m["n_pairs"]),
        "Completeness": f"{percent(m['completeness']['median'])} at the median,"
        f" {percent(m['completeness']['least'])} at least",
        "False pairs expected": percent(m["false_share"], 2),
        "Search radius": f"{number(low)} to {number(high)} {r.unit}",
    }
    return listing("Matching", pairs)


def _lookup_tables(r: CampaignResults) -> TextTable:
    t = r.section("tables")
    if not t.get("chips"):
        return listing("Look-up tables", {"Method": "none: no tables were fitted"})
    words = {
        "field": "Gaussian random field",
        "binned": "binned and smoothed",
        "none": "not fitted",
    }
    rows = tuple(
        (
            row.get("filter") or "detector",
            r.chip_name(row["chip"]),
            "{1} × {0}".format(*row["nodes"]),
            number(row["rms"]),
            number(row["largest"]),
            number(row["sigma_median"]),
        )
        for row in t["chips"]
    )
    caption, note = f"Look-up tables: {words.get(t['method'], t['method'])}", ""
    if "converged" in t:
        caption += ", converged" if t["converged"] else ", NOT converged"
        note = (
            f"Rms residual of an axis: {number(t['rms_before'])} pix before the tables of this run,"
            f" {number(t['rms_after'])} pix with them."
        )
    if t.get("detector"):
        note = f"The detector's are those of {t['detector']}. {note}".strip()
    return TextTable(
        caption,
        ("Of", "Chip", "Nodes", "Rms of an axis [pix]", "Largest [pix]", "σ, median [pix]"),
        rows,
        words=(0, 1),
        note=note,
    )


# -- release --------------------------------------------------------------------------------------


def _release(r: CampaignResults) -> Iterator[TextTable]:
    files = [p for p in r.summary.get("products") or () if p["kind"] in _KINDS]
    if not files:
        return
    release = r.config.get("products", {}).get("release") or {}
    years = {p["name"]: p["years"] for p in release.get("period", ())}
    rows = []
    for p in files:
        period = p.get("period")
        dates = "all" if period is None else "{:g} to {:g}".format(*years.get(period, (0, 0)))
        lost = max((abs(one["mas"]) for one in p.get("lost", ())), default=None)
        rows.append(
            (p["path"], _KINDS[p["kind"]], dates, MISSING if lost is None else number(lost, 2))
        )
    yield TextTable(
        "Released files",
        ("File", "What it is", "Dates", "Drift that it cannot hold, at most [mas]"),
        tuple(rows),
        words=(0, 1, 2),
    )


_KINDS = {
    "IDCTAB": "IDCTAB: polynomial and its drift",
    "D2IMFILE": "D2IMFILE: tables of the detector",
    "NPOLFILE": "NPOLFILE: tables of the filter",
}
