"""Tables of the uncertainty maps, the error budget and the margins."""

from __future__ import annotations

import numpy as np

from bayesdist.report.context import ReportInput
from bayesdist.report.numerals import MISSING, interval, number, rounded
from bayesdist.report.scales import with_mas
from bayesdist.report.tables.text import TextTable, marked

__all__ = ["budget_table", "map_table", "margin_table"]


def map_table(inputs: ReportInput) -> TextTable:
    """Extremes of the uncertainty maps."""
    rows = []
    for m in inputs.maps:
        cells = [
            with_mas(v, m.unit, inputs.scale_mas)
            for v in (m.sigma_u_max, m.sigma_v_max, m.radius_max, float(np.median(m.radius)))
        ]
        cells.append("({:.0f}, {:.0f})".format(*m.position_of_max))
        if m is inputs.posterior_map:
            cells = [marked(inputs, c) for c in cells]
        rows.append((m.kind, *cells))
    epoch = inputs.formal_map.epoch
    when = "" if epoch is None else f", epoch {epoch:.2f}"
    return TextTable(
        f"Uncertainty of the position, 1 σ, chip {inputs.formal_map.chip}{when}",
        ("Solution", "Largest σ u", "Largest σ v", "Max radius", "Median radius", "At pixel"),
        tuple(rows),
    )


def budget_table(inputs: ReportInput) -> TextTable | None:
    """The error budget, the total last."""
    if inputs.budget is None:
        return None
    rows = inputs.budget.rows()
    unit, mas = inputs.budget.unit, inputs.scale_mas
    out = [
        (
            str(r["name"]),
            str(r["kind"]),
            str(r["source"]) or MISSING,
            *(marked(inputs, with_mas(float(r[k]), unit, mas)) for k in ("u", "v", "radial")),
        )
        for r in rows
    ]
    epoch = inputs.budget.epoch
    when = "" if epoch is None else f" at epoch {epoch:.2f}"
    return TextTable(
        f"Error budget{when}: rms over the detector, 1 σ",
        ("Term", "Kind", "Source", "u", "v", "Radial"),
        tuple(out),
        words=(0, 1, 2),
        note="The parts of the model are correlated and enter the total jointly, by draws;"
        " independent terms are added in quadrature. The total therefore need not be the root of"
        " the sum of squares.",
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
            rounded(m.margin, spread),
            f"{number(m.probability_met)} ± {number(m.mc_error, 2)}",
        )
        epoch = "" if m.epoch is None else f" at {m.epoch:.2f}"
        out.append(
            (
                r.name,
                f"{r.statistic}{epoch} at most {r.limit:g} {r.unit},"
                f" with probability {r.probability:g}",
                *(marked(inputs, c) for c in cells),
                m.unit,
                f"{m.verdict}: {m.reason}" if m.reason else m.verdict,
            )
        )
    return TextTable(
        "Margins",
        ("Name", "Requirement", "Value", "95 % interval", "Margin", "P(met)", "Unit", "Verdict"),
        tuple(out),
        words=(0, 1, 6, 7),
        note="Margin: the limit minus the value that the statistic stays under with the probability"
        " asked for.",
    )
