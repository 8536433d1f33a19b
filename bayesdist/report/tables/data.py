"""Tables of what came in."""

from __future__ import annotations

import numpy as np

from bayesdist.report.context import ReportInput
from bayesdist.report.numbers import MISSING, count, display_scale, number
from bayesdist.report.tables.text import MOST_ROWS, TextTable, further, listing, marked, short_paths

__all__ = ["data_tables"]


def data_tables(inputs: ReportInput) -> tuple[TextTable, ...]:
    """What was read, what was rejected, errors by magnitude, exposures."""
    m, fit, words = inputs.stars.table, inputs.fit, inputs.words
    partial = ", of the sample" if inputs.stars.partial else ""
    pairs = {
        "Sources": ", ".join(short_paths(m.sources)),
        "Rows read": count(m.n_rows),
        words.all_things.capitalize(): count(inputs.stars.n_total),
        f"Used by the {words.chooser}": count(fit.n_used),
        "Unit of u, v": m.unit,
        "Exposures": count(np.count_nonzero(inputs.exposures.n)),
        "Filters": ", ".join(f for f in m.filter_names if f) or MISSING,
    }
    if m.epoch is not None:
        pairs[f"Epochs [yr]{partial}"] = f"{np.min(m.epoch):.2f} to {np.max(m.epoch):.2f}"
    if m.mag is not None and np.isfinite(m.mag).any():
        pairs[f"Magnitudes{partial}"] = f"{np.nanmin(m.mag):.2f} to {np.nanmax(m.mag):.2f}"
    pairs[f"Errors of the {words.things}"] = (
        "by magnitude, see below"
        if inputs.magnitude_errors is not None
        else str(inputs.setting("data", "sigma", "as given"))
    )
    reasons = [(f"{k} (reading)", count(v)) for k, v in m.rejected.items()]
    reasons += [(f"{k} ({words.chooser})", count(v)) for k, v in fit.rejected.items()]
    rejected = TextTable(
        "Rows left out, by reason",
        ("Reason", "Rows"),
        tuple(reasons) or (("none", "0"),),
        note=f"The posterior uses all {words.all_things}: the mixture takes the place of rejection."
        if inputs.posterior is not None
        else "",
    )
    note = f"Figures and tables of single {words.things} show {inputs.sample}." if partial else ""
    out = [listing("Input", pairs, note), rejected]
    if inputs.magnitude_errors is not None:
        out.append(_magnitude_table(inputs))
    if len(m.exposure_names) > 1:
        out.append(_exposure_table(inputs))
    return tuple(out)


def _magnitude_table(inputs: ReportInput) -> TextTable:
    e = inputs.magnitude_errors
    assert e is not None
    scale = display_scale(inputs.unit, np.concatenate([e.sigma_u, e.sigma_v]))
    rows = tuple(
        (f"{mag:.2f}", count(n), number(su * scale.factor), number(sv * scale.factor))
        for mag, n, su, sv in zip(e.mag, e.n, e.sigma_u, e.sigma_v, strict=True)
    )
    return TextTable(
        "Errors by magnitude, estimated from the residuals",
        (
            "Magnitude",
            inputs.words.things.capitalize(),
            f"σ u [{scale.unit}]",
            f"σ v [{scale.unit}]",
        ),
        rows,
        words=(),
        detail=True,
    )


def _exposure_table(inputs: ReportInput) -> TextTable:
    names, fit, sums = inputs.stars.table.exposure_names, inputs.fit, inputs.exposures
    scale = display_scale(inputs.unit, [fit.rms_u, fit.rms_v])
    flagged = inputs.flagged
    rows = tuple(
        (
            names[k],
            count(sums.n[k]),
            count(sums.n_used[k]),
            *(number(r[k] * scale.factor) for r in sums.rms),
            MISSING if flagged is None else marked(inputs, count(flagged[k])),
        )
        for k in np.flatnonzero(sums.n)
    )
    return TextTable(
        "Exposures",
        (
            "Exposure",
            inputs.words.things.capitalize(),
            "Used",
            f"rms u [{scale.unit}]",
            f"rms v [{scale.unit}]",
            "Outliers (P > 0.5)",
        ),
        rows[:MOST_ROWS],
        note=further(len(rows)),
        detail=True,
    )
