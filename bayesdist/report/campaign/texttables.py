"""Tables of a campaign, as text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from bayesdist.report.campaign.context import CampaignResults
from bayesdist.report.campaign.published import (
    SOURCE,
    WHERE,
    PublishedLine,
    published_lines,
)
from bayesdist.report.campaign.words import name_of_scatter, name_of_term
from bayesdist.report.numerals import MISSING, count, interval, number, percent, rounded
from bayesdist.report.scales import display_scale
from bayesdist.report.tables.text import TextTable, listing

__all__ = ["campaign_tables"]

Row = tuple[str, ...]

_SIGNIFICANT = 3.0  # sigmas
FIXED = 5e-3  # 10^-6, or 10^-3 of a length: errors below it say that a term is held


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
        "time": tuple(_time(r)),
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


# -- time -----------------------------------------------------------------------------------------


def _time(r: CampaignResults) -> Iterator[TextTable]:
    found, joint = r.section("time_dependence"), r.summary.get("lines") or []
    names = {chip.number: chip.name for chip in r.chips}
    published = published_lines(r.config, r.filter, tuple(names.values()))
    if r.section("gauge"):
        yield _gauge(r)
    terms = dict.fromkeys(row["term"] for row in joint)
    alone = {
        (row["term"], row["segment"]): row
        for row in found.get("lines", ())
        if row["alpha"] is not None
    }
    for term in [t for t in (*WHERE, "A_3") if t in terms]:
        rows = [row for row in joint if row["term"] == term and _is_free(row, r.unit)]
        rows.sort(key=lambda row: (row["segment"], names[row["chip"]]))
        if rows:
            yield _line_table(term, rows, names, alone, published.get(term, ()), r)
    if found.get("breaks"):
        yield _changes(found["breaks"], r.unit)
    if r.section("scatter"):
        yield _scatter(r)
    if found.get("verdicts"):
        rows_of = tuple((v["term"], v["claim"], v["text"]) for v in found["verdicts"])
        yield TextTable(
            "Which course each term takes, by held-out exposures",
            ("Term", "Claim", "Why"),
            rows_of,
            words=(0, 1, 2),
        )


def _gauge(r: CampaignResults) -> TextTable:
    g = r.section("gauge")
    name = r.chip_name(g["chip"])
    scale = display_scale(r.unit, g["sigma_shift"])
    when = "" if g.get("epoch") is None else f" at {g['epoch']:g}"
    shift = ", ".join(
        f"{rounded(s * scale.factor, e * scale.factor)} ± {number(e * scale.factor, 2)}"
        for s, e in zip(g["shift"], g["sigma_shift"], strict=True)
    )
    rotation, sigma = 1e6 * g["rotation"], 1e6 * g["sigma_rotation"]
    fixed = ", ".join(g["fixed"])
    return listing(
        "Gauge",
        {
            "Fixed": f"{name} is the reference: {fixed} are zero at its zero point{when}. Other"
            " chips live in its system: gap and rotation between chips are in their coefficients.",
            "Shift that did it (u, v)": f"{shift} {scale.unit}",
            "Rotation that did it": f"{rounded(rotation, sigma)} ± {number(sigma, 2)} 10⁻⁶ rad",
        },
    )


def _line_table(
    term: str,
    joint: list[Mapping[str, Any]],
    names: Mapping[int, str],
    alone: Mapping[tuple[str, int], Mapping[str, Any]],
    published: tuple[PublishedLine, ...],
    r: CampaignResults,
) -> TextTable:
    """alpha and beta of a term: joint, exposure by exposure, and published."""
    factor, unit = _scale(term, r.unit)
    own = [row for row in (*joint, *alone.values()) if _is_of(row, term)]
    # as many digits for all of this run's, so that they can be compared; others as printed
    digits = {
        key: min((row[key] for row in own if row[key] * factor > FIXED), default=0.0)
        for key in ("sigma_alpha", "sigma_beta")
    }
    rows: list[Row] = []
    for row in joint:
        chip = names[row["chip"]]
        head = (chip, f"{row['epoch0']:.1f}")
        rows.append((*head, "joint fit", *_numbers(row, factor, digits)))
        label = f"{chip}.{term}" if len(r.chips) > 1 else term
        if (label, row["segment"]) in alone:
            numbers = _numbers(alone[label, row["segment"]], factor, digits)
            rows.append((*head, "exposures, then line", *numbers))
        for one in published:
            if one.chip == chip and abs(one.rdate - row["epoch0"]) < 1e-6:
                rows.append((*head, SOURCE, *_numbers(vars(one), factor, vars(one))))
    source = f"; published: {SOURCE}, {WHERE[term]}" if published else ""
    return TextTable(
        f"{name_of_term(term)}: α + β (TIME − RDATE){source}",
        ("Chip", "RDATE", "From", "α", f"σ α [{unit}]", f"β [{unit}/yr]", f"σ β [{unit}/yr]"),
        tuple(rows),
        words=(0, 2),
    )


def _scale(term: str, unit: str) -> tuple[float, str]:
    """Unit in which errors and rates of a term are read: constants are lengths."""
    return (1e3, f"10⁻³ {unit}") if term.endswith("_1") else (1e6, "10⁻⁶")


def _is_free(row: Mapping[str, Any], unit: str) -> bool:
    """Whether the data have a say: the gauge fixes terms of the reference chip."""
    return bool(row["sigma_alpha"] * _scale(row["term"], unit)[0] > FIXED)


def _is_of(row: Mapping[str, Any], term: str) -> bool:
    return str(row["term"]).rpartition(".")[2] == term


def _numbers(row: Mapping[str, Any], factor: float, digits: Mapping[str, Any]) -> Row:
    beta, sigma = factor * row["beta"], factor * row["sigma_beta"]
    moves = sigma > FIXED
    return (
        rounded(row["alpha"], digits["sigma_alpha"]),
        number(factor * row["sigma_alpha"], 3),
        rounded(beta, factor * digits["sigma_beta"]) if moves else MISSING,
        number(sigma, 3) if moves else MISSING,
    )


def _changes(breaks: list[Mapping[str, Any]], unit: str) -> TextTable:
    rows = tuple(
        (
            f"{row['break']:.2f}",
            str(row["term"]),
            _scale(row["term"], unit)[1],
            *_change(row["term"], row["step"], row["sigma_step"]),
            *_change(row["term"], row["slope_change"], row["sigma_slope_change"]),
        )
        for row in breaks
        if row["step"] is not None
    )
    return TextTable(
        "Changes at the breaks, from the exposures alone",
        ("Break", "Term", "Unit", "Step", "σ", "Step / σ", "Rate, per year", "σ", "Rate / σ"),
        rows,
        words=(1, 2),
        note=f"Beyond {_SIGNIFICANT:g} σ a change is hardly chance.",
    )


def _change(term: str, value: float, sigma: float) -> Row:
    factor, _ = _scale(term, "")
    v, s = factor * value, factor * sigma
    return rounded(v, s), number(s, 2), number(value / sigma, 2) if sigma > 0 else MISSING


def _scatter(r: CampaignResults) -> TextTable:
    rows: list[Row] = []
    for kind, tau in r.section("scatter").items():
        factor, unit = (1e3, f"10⁻³ {r.unit}") if ".shift_" in f".{kind}" else (1e6, "10⁻⁶")
        low, high = (factor * end for end in tau["interval_68"])
        span = interval(low, high, (high - low) / 2)
        rows.append((name_of_scatter(kind), "joint fit", unit, number(factor * tau["value"]), span))
    for label, value in r.section("time_dependence").get("scatter", {}).items():
        if value is not None:
            factor, unit = _scale(label, r.unit)
            rows.append((label, "exposures alone", unit, number(factor * value), MISSING))
    return TextTable(
        "Scatter of the exposures beyond their formal errors, 1 σ",
        ("Kind", "From", "Unit", "τ", "68 % interval"),
        tuple(rows),
        words=(0, 1, 2),
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
