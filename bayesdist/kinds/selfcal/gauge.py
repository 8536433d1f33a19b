"""Gauge of a self-calibration: its directions and the constraints on them, in words."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from astropy.table import Table

from bayesdist.infer.equations.priors import Prior
from bayesdist.kinds.selfcal.infer.gauge import FAR, Gauge, NamedDirection, find_gauge
from bayesdist.kinds.selfcal.infer.mode import SelfCalibrationMode
from bayesdist.kinds.selfcal.known import GaugeConstraints
from bayesdist.model import DistortionModel

COLUMNS = ["name", "state", "sigma_detections", "sigma_fixed", "unit", "edge_pix", "fixed_by"]

CONVENTION, DETECTIONS, REFERENCES = "convention", "detections", "reference stars"


def fixed_by(
    gauge: Gauge, solution: SelfCalibrationMode, pieces: GaugeConstraints
) -> dict[str, str]:
    """Source of the constraint on each property of the solution, by name of the property."""
    problem, theta = solution.problem, solution.theta
    alone, with_priors = solution.curvatures
    priors = {name: piece(theta) for name, piece in pieces.pieces.items()}
    sigmas: dict[str, dict[str, float]] = {}
    none = Prior.none(theta)
    for name, information in priors.items():
        constrained = find_gauge(problem, theta, alone, information)
        sigmas[name] = {d.name: d.sigma_fixed for d in constrained.directions}
    if problem.priors.informed.any():
        constrained = find_gauge(problem, theta, alone, none, known=with_priors)
        sigmas[REFERENCES] = {d.name: d.sigma_fixed for d in constrained.directions}
    return {d.name: _fixed_by(d, sigmas) for d in gauge.directions}


def _fixed_by(direction: NamedDirection, sigmas: Mapping[str, Mapping[str, float]]) -> str:
    if not np.isfinite(direction.sigma_fixed):
        return CONVENTION
    limit = FAR * direction.sigma_fixed
    sources = [name for name, of in sigmas.items() if of[direction.name] < limit]
    if direction.by_detections:
        return DETECTIONS
    return " and ".join(sources) or "all together"


def gauge_table(gauge: Gauge, fixed: Mapping[str, str], model: DistortionModel) -> Table:
    """One row per property of the solution: free ones first, then nearly free combinations."""
    rows = [
        _row(d, fixed) | {"edge_pix": d.edge_pix}
        for d in sorted(gauge.directions, key=lambda d: (not d.free, not d.weak))
    ]
    blank = {"sigma_fixed": np.nan, "unit": "", "edge_pix": np.nan, "fixed_by": ""}
    for sigma, k in gauge.weakest:
        row = {"name": f"combination led by {model.names[int(k)]}", "state": "nearly free"}
        at_edge = {"sigma_detections": sigma, "unit": "pix at the edge", "edge_pix": 1.0}
        rows.append(blank | row | at_edge)
    for name in gauge.unnamed:
        row = {"name": f"combination with {name}", "state": "free"}
        rows.append(blank | row | {"sigma_detections": np.inf})
    return Table(rows)[COLUMNS]


def _row(d: NamedDirection, fixed: Mapping[str, str]) -> dict[str, object]:
    """Name of a property, its uncertainty, and its constraint."""
    return {
        "name": d.name,
        "state": "free" if d.free else "nearly free" if d.weak else "known",
        "sigma_detections": d.sigma,
        "sigma_fixed": d.sigma_fixed,
        "unit": d.unit,
        "fixed_by": fixed[d.name],
    }


def gauge_summary(
    gauge: Gauge, fixed: Mapping[str, str], model: DistortionModel
) -> dict[str, object]:
    """Entry 'gauge' of the section 'selfcal' of summary.json; infinite sigmas become null."""
    return {
        "n_free": int(gauge.null.shape[1]),
        "n_by_convention": int(gauge.open.shape[1]),
        "held": [model.names[k] for k in gauge.held],
        "directions": [_row(d, fixed) for d in gauge.directions],
        "unnamed": list(gauge.unnamed),
        "sentences": list(gauge.sentences),
    }


def gauge_words(
    gauge: Gauge,
    fixed: Mapping[str, str],
    model: DistortionModel,
    contact: tuple[float, float] | None = None,
) -> str:
    """Text that states the gauge of a product and where its tangent planes touch the sky.

    `contact` is the point (u, v) where the plane of the stars touches the sky; None if the sky is
    taken as flat.
    """
    by: dict[str, list[str]] = {}
    for d in gauge.directions:
        if d.free or d.weak:
            by.setdefault(fixed[d.name], []).append(d.name.replace("_", " "))
    parts = [f"{', '.join(names)} by {source}" for source, names in by.items()]
    held = ", ".join(model.names[k] for k in gauge.held)
    text = "Gauge of a self-calibration: " + ("; ".join(parts) or "all is known from detections")
    text += f"; held: {held}." if held else "."
    return text if contact is None else f"{text} {_contact_words(model, contact)}"


def _contact_words(model: DistortionModel, contact: tuple[float, float]) -> str:
    """Sentence on the points where the planes of exposures and stars touch the sky."""
    chip = model.chips[0]
    x, y = (f"{z:.10g}" for z in chip.reference_pixel)
    u, v = (f"{z:.10g}" for z in contact)
    return (
        f"The tangent plane of each exposure touches the sky at pixel ({x}, {y}) of chip "
        f"{chip.number}, that of the stars at u = {u}, v = {v} {model.unit}."
    )
