"""Gauge and linear terms of a campaign, as Tables 1 to 3 of ACS ISR 2015-06."""

from __future__ import annotations

from bayesdist.infer.solution import ReferenceGauge, Solution, TransformedSolution
from bayesdist.infer.transforms import LinearTerms, lines, reference_gauge, without_frames

__all__ = ["FIXED", "line_sections"]

FIXED = ("A_1", "B_1", "A_3")  # by the gauge, on the reference chip


def line_sections(solution: Solution, chip: int) -> dict[str, object]:
    """Sections 'gauge' and 'lines' of summary.json: alpha and beta of each term."""
    view = reference_gauge(without_frames(solution), chip)
    return {"gauge": _gauge(view.gauge), "lines": _lines(view)}


def _gauge(gauge: ReferenceGauge) -> dict[str, object]:
    """Section 'gauge'."""
    return {
        "chip": gauge.chip,
        "fixed": list(FIXED),
        "epoch": gauge.epoch,
        "rotation": gauge.rotation,
        "sigma_rotation": gauge.sigma_rotation,
        "shift": list(gauge.shift),
        "sigma_shift": list(gauge.sigma_shift),
    }


def _lines(view: TransformedSolution) -> list[dict[str, object]]:
    """alpha and beta of the joint fit in the reference gauge, as Tables 1 to 3 of the report."""
    time = view.model.time
    if time is None:
        return []
    return [
        {"segment": s, "chip": chip.number, "epoch0": time.epoch0[s]} | row
        for s in range(time.n_segments)
        for chip in view.model.chips
        for row in _rows(lines(view, s, chip=chip.number))
    ]


def _rows(found: LinearTerms) -> list[dict[str, object]]:
    values = dict(zip(found.labels, zip(found.values, found.sigma, strict=True), strict=True))
    names = dict.fromkeys(label.split(".")[0] for label in found.labels)
    return [
        {
            "term": name,
            "alpha": float(values[f"{name}.alpha"][0]),
            "sigma_alpha": float(values[f"{name}.alpha"][1]),
            "beta": float(values[f"{name}.beta"][0]),
            "sigma_beta": float(values[f"{name}.beta"][1]),
        }
        for name in names
    ]
