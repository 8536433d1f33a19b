"""Tables of the uncertainty maps, the error budget and the margins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesdist.assess import Margin
from bayesdist.assess.product_terms import PRODUCT
from bayesdist.report.context import ReportInput
from bayesdist.report.gauge import gauge_mark, gauge_of_maps, gauge_of_new_exposure
from bayesdist.report.numbers import MISSING, interval, number, percent, rounded, with_mas
from bayesdist.report.tables.text import TextTable, marked

AS_ABOVE = "as above"  # of the rows of single chips

__all__ = ["budget_table", "map_table", "margin_table", "rests_on_table"]


def map_table(inputs: ReportInput) -> TextTable:
    """Extremes of the uncertainty maps."""
    rows = []
    for c in inputs.chips:
        for m in c.maps:
            cells = [
                with_mas(v, m.unit, inputs.scale_mas)
                for v in (m.sigma_u_max, m.sigma_v_max, m.radius_max, float(np.median(m.radius)))
            ]
            cells.append("({:.0f}, {:.0f})".format(*m.position_of_max))
            if m is not c.formal_map:
                cells = [marked(inputs, text) for text in cells]
            name = f"{c.chip.name}, {m.kind}" if inputs.several else m.kind
            rows.append((name, *cells))
    first = inputs.chips[0].formal_map
    when = "" if first.epoch is None else f", epoch {first.epoch:.2f}"
    which = "each chip" if inputs.several else f"chip {first.chip}"
    return TextTable(
        f"Uncertainty of the position, 1 σ, {which}{when}{gauge_mark(inputs)}",
        (
            "Chip, solution" if inputs.several else "Solution",
            "Largest σ u",
            "Largest σ v",
            "Max radius",
            "Median radius",
            "At pixel",
        ),
        tuple(rows),
        note=gauge_of_maps(inputs),
    )


def budget_table(inputs: ReportInput) -> TextTable | None:
    """The error budget, the total last."""
    if inputs.budget is None:
        return None
    unit, mas = inputs.budget.unit, inputs.scale_mas
    names = {str(c.chip.number): c.chip.name for c in inputs.chips} | {"all": "all"}
    rows = inputs.budget.rows_by_chip() if inputs.several else inputs.budget.rows()
    out = [
        (
            str(r["name"]),
            *((names[str(r["chip"])],) if inputs.several else ()),
            str(r["kind"]),
            AS_ABOVE if str(r.get("chip", "all")) != "all" else str(r["source"]) or MISSING,
            *(marked(inputs, with_mas(float(r[k]), unit, mas)) for k in ("u", "v", "radial")),
            _known_to(r),
        )
        for r in rows
    ]
    of_chip = ("Chip",) if inputs.several else ()
    heads = ("Term", *of_chip, "Kind", "Source", "u", "v", "Radial", "Known to")
    epoch = inputs.budget.epoch
    when = "" if epoch is None else f" at epoch {epoch:.2f}"
    return TextTable(
        f"Error budget{when}: rms over the detector, 1 σ",
        heads,
        tuple(out),
        words=tuple(range(len(heads) - 4)),
        leading=len(inputs.budget.rows()),  # those of all chips together
        stacked=(heads.index("Radial"),),
        note="The parts of the model are correlated and enter the total jointly, by draws;"
        " independent terms are added in quadrature. The total therefore need not be the root of"
        f" the sum of squares.{_of_products(rows)} {gauge_of_new_exposure(inputs)}".rstrip(),
    )


def _known_to(row: Mapping[str, Any]) -> str:
    """How well a term is known itself."""
    error, size = row["radial_error"], float(row["radial"])
    if error is None or not size > 0:
        return MISSING
    return "exact" if error == 0 else percent(error / size, 2)


def _of_products(rows: Sequence[Mapping[str, Any]]) -> str:
    if all(r["kind"] != PRODUCT for r in rows):
        return ""
    return (
        " Rows of kind product say what a file differs by from the solution, the same in every"
        " draw: they come on top, in quadrature, for whoever uses that file, and are in no total."
    )


def margin_table(inputs: ReportInput) -> TextTable | None:
    """Requirements and how they are met."""
    if not inputs.margins:
        return None
    out = []
    for m in inputs.margins:
        r = m.requirement
        spread = (m.interval[1] - m.interval[0]) / 4
        cells = (
            rounded(m.value, spread),
            interval(*m.interval, spread),
            f"{rounded(m.margin, spread)} ({percent(m.percent / 100, 2)})",
            f"{number(m.probability_met)} ± {number(m.mc_error, 2)}",
        )
        epoch = "" if m.epoch is None else f" at {m.epoch:.2f}"
        if r.epochs is not None:
            epoch = f" from {r.epochs[0]:.2f} to {r.epochs[1]:.2f}, worst{epoch}"
        chip = next((c.chip.name for c in inputs.chips if c.chip.number == r.chip), "")
        on = f" on {chip}" if chip and inputs.several else ""
        scope = f" {r.scope}" if r.scope else ""
        out.append(
            (
                r.name,
                f"{r.statistic}{scope}{on}{epoch} at most {r.limit:g} {r.unit},"
                f" with probability {r.probability:g}",
                *(marked(inputs, c) for c in cells),
                m.unit,
                _judgement(m, inputs.several),
            )
        )
    return TextTable(
        "Margins",
        ("Name", "Requirement", "Value", "95 % interval", "Margin", "P(met)", "Unit", "Verdict"),
        tuple(out),
        words=(0, 1, 6, 7),
        stacked=(7,),
        note="Margin: the limit minus the value that the statistic stays under with the probability"
        f" asked for. {gauge_of_new_exposure(inputs)}".rstrip(),
    )


def rests_on_table(inputs: ReportInput) -> TextTable | None:
    """What the verdicts take for granted or have measured."""
    clauses: dict[str, list[str]] = {}
    for m in inputs.margins:
        for clause in m.rests_on:
            clauses.setdefault(clause, []).append(m.requirement.name)
    if not clauses:
        return None
    every = len(inputs.margins)
    rows = tuple(
        (clause, "all" if len(of) == every else ", ".join(of)) for clause, of in clauses.items()
    )
    return TextTable("What the verdicts rest on", ("", "Requirements"), rows, words=(0, 1))


def _judgement(m: Margin, several: bool) -> str:
    """Verdict, reason, where the error is largest, and what would help."""
    on = f" of chip {m.worst.chip}" if several else ""
    out = [
        f"{m.verdict}: {m.reason}" if m.reason else m.verdict,
        f"largest at ({m.worst.x:.0f}, {m.worst.y:.0f}){on}: {number(m.worst.rms, 2)} {m.unit} rms",
    ]
    return "; ".join(out + ([] if m.remedy is None else [m.remedy.sentence]))
