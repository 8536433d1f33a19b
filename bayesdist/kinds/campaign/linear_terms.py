"""Linear terms of a campaign, and the shift between its chips, as in ACS ISR 2015-06.

ACS ISR 2015-06, Section 4.4.1, adopts one mean B_1 of WFC1 before SM4 and another after it.  A
drift in the model has a rate, and a step at each break, for every term and chip.  Those that are
not wanted are held at zero by a prior much narrower than any measurement error.
"""

from __future__ import annotations

from dataclasses import replace

from bayesdist.app.store.keys import attributes
from bayesdist.infer import GaussianPriors
from bayesdist.infer.solution.solution import Solution, TransformedSolution
from bayesdist.infer.solution.transforms import lines, reference_gauge, without_frames
from bayesdist.model import DistortionModel, TimeDependence

CONSTANTS = (("u", 0, 0), ("v", 0, 0))
SIGMA_HELD = 1e-6  # pixels, and pixels per year


def with_gap(model: DistortionModel) -> DistortionModel:
    """Model with steps of the constant terms, if it has several chips and breaks."""
    time = model.time
    if time is None or not time.breaks or len(model.chips) == 1:
        return model
    terms = (*time.terms, *(t for t in CONSTANTS if t not in time.terms))
    return replace(model, time=replace(time, terms=terms))


def gap_priors(
    model: DistortionModel, asked: TimeDependence | None, pixel: float
) -> GaussianPriors:
    """Priors that restrict the drift of constant terms to steps of all chips except the first.

    The first chip is the reference chip: its constant terms are the pointing of the exposures.

    Parameters
    ----------
    model : DistortionModel
    asked : TimeDependence or None
        Configured drift.  Constant terms among its terms keep their rates.
    pixel : float
        Pixel size in the unit of u, v.
    """
    reference, named = model.chips[0].number, () if asked is None else asked.terms
    held = {
        p.name: (0.0, SIGMA_HELD * pixel)
        for p in model.parameters
        if p.kind == "tdd"
        and (p.axis, p.i, p.j) in CONSTANTS
        and (p.chip == reference or (".rate" in p.name and (p.axis, p.i, p.j) not in named))
    }
    return GaussianPriors.of(model, held)


FIXED = ("A_1", "B_1", "A_3")  # fixed by the gauge, on the reference chip


def line_sections(solution: Solution, chip: int) -> dict[str, object]:
    """Sections 'gauge' and 'lines' of summary.json: alpha and beta of each term."""
    view = reference_gauge(without_frames(solution), chip)
    gauge = attributes(view.gauge, "chip epoch rotation sigma_rotation shift sigma_shift")
    return {"gauge": gauge | {"fixed": FIXED}, "lines": _lines(view)}


def _lines(view: TransformedSolution) -> list[dict[str, object]]:
    """alpha and beta of the joint fit in the reference gauge, as in Tables 1 to 3 of the ISR."""
    time, out = view.model.time, []
    for s, epoch0 in enumerate(() if time is None else time.epoch0):
        for chip in view.model.chips:
            drift = lines(view, s, chip=chip.number)
            for term in dict.fromkeys(label.split(".")[0] for label in drift.labels):
                row: dict[str, object] = {"segment": s, "chip": chip.number, "epoch0": epoch0}
                row["term"] = term
                for part in ("alpha", "beta"):
                    line = drift.select(f"{term}.{part}")
                    row |= {part: float(line.values[0]), f"sigma_{part}": float(line.sigma[0])}
                out.append(row)
    return out
