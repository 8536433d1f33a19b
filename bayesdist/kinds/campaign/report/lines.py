"""Tables of the linear terms against time, with published lines supplied by missions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from bayesdist.kinds.campaign.report.data import campaign_data, chip_name, summary_section
from bayesdist.kinds.campaign.report.series import name_of_scatter, name_of_term
from bayesdist.report.contents import REPORT
from bayesdist.report.run import ReportedRun
from bayesdist.report.texttable import TextTable, listing
from bayesdist.utils.numbers import MISSING, count, display_scale, interval, number, rounded

Row = tuple[str, ...]

TERMS = ("A_2", "B_3", "B_2", "B_1", "A_3")  # in the order of the tables
_SIGNIFICANT = 3.0  # sigmas
FIXED = 5e-3  # 10^-6, or 10^-3 of a length; a term with a smaller error is held fixed


@REPORT.table("campaign-time")
def time_tables(run: ReportedRun) -> Iterator[TextTable]:
    """Tables of the gauge, lines of each term, changes at the breaks, scatter and claims."""
    data = campaign_data(run)
    section, joint = summary_section(run, "time_dependence"), run.summary.get("lines") or []
    names = {chip.number: chip.name for chip in run.model.chips}
    published = published_terms(run.configuration, data.filter, tuple(names.values()))
    if summary_section(run, "gauge"):
        yield _gauge(run)
    terms = dict.fromkeys(row["term"] for row in joint)
    alone = {
        (row["term"], row["segment"]): row
        for row in section.get("lines", ())
        if row["alpha"] is not None
    }
    note = _why_errors_differ(run) if alone else ""
    for term in [t for t in TERMS if t in terms]:
        rows = [row for row in joint if row["term"] == term and _is_free(row, run.model.unit)]
        rows.sort(key=lambda row: (row["segment"], names[row["chip"]]))
        if rows:
            table = _line_table(term, rows, names, alone, published.get(term), run)
            yield replace(table, note=" ".join(text for text in (table.note, note) if text))
            note = ""  # shown once, under the first of them
    if section.get("breaks"):
        yield _changes(section["breaks"], run.model.unit)
    if summary_section(run, "scatter"):
        yield _scatter(run)
    if section.get("verdicts"):
        rows_of = tuple((v["term"], v["claim"], v["text"]) for v in section["verdicts"])
        yield TextTable(
            "Time dependence of each term, selected by held-out exposures",
            ("Term", "Claim", "Why"),
            rows_of,
            words=(0, 1, 2),
            detail=True,
        )


def _gauge(run: ReportedRun) -> TextTable:
    g = summary_section(run, "gauge")
    name = chip_name(run, g["chip"])
    scale = display_scale(run.model.unit, g["sigma_shift"])
    when = "" if g.get("epoch") is None else f" at {g['epoch']:g}"
    shift = ", ".join(
        f"{rounded(s * scale.factor, e * scale.factor)} ± {number(e * scale.factor, 2)}"
        for s, e in zip(g["shift"], g["sigma_shift"], strict=True)
    )
    rotation, sigma = 1e6 * g["rotation"], 1e6 * g["sigma_rotation"]
    fixed = ", ".join(g["fixed"])
    return listing(
        "Gauge of the linear terms against time",
        {
            "Fixed": f"{name} is the reference: {fixed} are zero at its zero point{when}. Other"
            " chips live in its system: gap and rotation between chips are in their coefficients.",
            "Where it holds": "in the tables and figures of this part. The tables of coefficients"
            " further down are in the fit's own gauge, and differ by the shift and rotation below.",
            "Shift by which it was fixed (u, v)": f"{shift} {scale.unit}",
            "Rotation": f"({rounded(rotation, sigma)} ± {number(sigma, 2)})\u202f×\u202f10⁻⁶ rad",
        },
        detail=True,
    )


def _line_table(
    term: str,
    joint: list[Mapping[str, Any]],
    names: Mapping[int, str],
    alone: Mapping[tuple[str, int], Mapping[str, Any]],
    published: Published | None,
    run: ReportedRun,
) -> TextTable:
    """Table of alpha and beta of a term: joint fit, single exposures, and published values."""
    factor, unit = _scale(term, run.model.unit)
    rows_of_term = [
        row for row in (*joint, *alone.values()) if row["term"].rpartition(".")[2] == term
    ]
    # all values of this run have the same digits for comparison; published ones are as printed
    digits = {
        key: min((row[key] for row in rows_of_term if row[key] * factor > FIXED), default=0.0)
        for key in ("sigma_alpha", "sigma_beta")
    }
    lines: tuple[PublishedLine, ...] = ()
    source = cited = ""
    if published is not None:
        lines, source = published.lines, published.source
        cited = f"; published: {source}, {published.where}"
    rows: list[Row] = []
    for row in joint:
        chip = names[row["chip"]]
        head = (chip, f"{row['epoch0']:.1f}")
        rows.append((*head, "joint fit", *_numbers(row, factor, digits)))
        label = f"{chip}.{term}" if len(run.model.chips) > 1 else term
        if (label, row["segment"]) in alone:
            numbers = _numbers(alone[label, row["segment"]], factor, digits)
            rows.append((*head, "exposures, then line", *numbers))
        rows += [
            (*head, source, *_numbers(vars(published_line), factor, vars(published_line)))
            for published_line in lines
            if published_line.chip == chip and abs(published_line.rdate - row["epoch0"]) < 1e-6
        ]
    system = ""
    if summary_section(run, "gauge"):
        system = f", in the system of {chip_name(run, summary_section(run, 'gauge')['chip'])}"
    return TextTable(
        f"{name_of_term(term)}: α + β (TIME − RDATE){system}{cited}",
        ("Chip", "RDATE", "From", "α", f"σ α [{unit}]", f"β [{unit}/yr]", f"σ β [{unit}/yr]"),
        tuple(rows),
        words=(0, 2),
        note=f"{MISSING}: no rate is fitted." if any(MISSING in row for row in rows) else "",
        detail=True,
    )


def _why_errors_differ(run: ReportedRun) -> str:
    """Note on why two fits of the same stars have different errors."""
    data = campaign_data(run)
    n = count(len(data.matching) if data.series is None else len(data.series.exposures))
    return (
        "The two σ of this run may differ, here and in the tables below. An exposure that is fitted"
        " alone frees all of its higher-order terms, and the scatter of a term is that of its"
        f" values in the {n} exposures. The joint fit has one set of higher-order terms for all"
        " exposures, and lets scale and shear scatter independently: X and Y scale then scatter"
        " alike."
    )


def _scale(term: str, unit: str) -> tuple[float, str]:
    """Unit for errors and rates of a term: constant terms are lengths."""
    return (1e3, f"10⁻³ {unit}") if term.endswith("_1") else (1e6, "10⁻⁶")


def _is_free(row: Mapping[str, Any], unit: str) -> bool:
    """True if the data constrain the term; the gauge fixes terms of the reference chip."""
    return bool(row["sigma_alpha"] * _scale(row["term"], unit)[0] > FIXED)


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
        detail=True,
    )


def _change(term: str, value: float, sigma: float) -> Row:
    factor, _ = _scale(term, "")
    v, s = factor * value, factor * sigma
    return rounded(v, s), number(s, 2), number(value / sigma, 2) if sigma > 0 else MISSING


def _scatter(run: ReportedRun) -> TextTable:
    rows: list[Row] = []
    for kind, tau in summary_section(run, "scatter").items():
        factor, unit = (1e3, f"10⁻³ {run.model.unit}") if ".shift_" in f".{kind}" else (1e6, "10⁻⁶")
        low, high = (factor * end for end in tau["interval_68"])
        span = interval(low, high, (high - low) / 2)
        rows.append((name_of_scatter(kind), "joint fit", unit, number(factor * tau["value"]), span))
    n_joint = len(rows)
    for label, value in summary_section(run, "time_dependence").get("scatter", {}).items():
        if value is not None:
            factor, unit = _scale(label, run.model.unit)
            rows.append((label, "exposures alone", unit, number(factor * value), MISSING))
    return TextTable(
        "Scatter of the exposures beyond their formal errors, 1 σ",
        ("Kind", "From", "Unit", "τ", "68 % interval"),
        tuple(rows),
        words=(0, 1, 2),
        leading=n_joint,
    )


@dataclass(frozen=True)
class PublishedLine:
    """A line alpha + beta (TIME - RDATE) with formal errors; beta is 0 for a constant term."""

    chip: str
    rdate: float
    alpha: float
    sigma_alpha: float
    beta: float = 0.0
    sigma_beta: float = 0.0


@dataclass(frozen=True)
class Published:
    """Published lines of one term."""

    source: str  # publication
    where: str  # location in the publication
    lines: tuple[PublishedLine, ...]


Source = Callable[[Mapping[str, Any], str, tuple[str, ...]], Mapping[str, Published]]
_SOURCES: list[Source] = []


def publishes(source: Source) -> Source:
    """Decorator that registers a source of published terms, called like `published_terms`."""
    _SOURCES.append(source)
    return source


def published_terms(
    config: Mapping[str, Any], filter: str, chips: tuple[str, ...]
) -> dict[str, Published]:
    """Published lines for the detector and filter of a run, by term.

    `config`: resolved configuration, which contains instrument and detector. `chips`: names of the
    chips.
    """
    return {k: v for source in _SOURCES for k, v in source(config, filter, chips).items()}
