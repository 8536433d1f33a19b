"""The distance between the chips: it may step where the drift has a break, and does not drift.

ACS ISR 2015-06, Section 4.4.1, adopts a mean B_1 of WFC1 before SM4 and another one after it.  The
drift of a model has a rate, and a step at each break, for every term and chip; what is not meant is
held at zero by a prior that is narrow against all that can be measured.
"""

from __future__ import annotations

from dataclasses import replace

from bayesdist.infer import GaussianPriors
from bayesdist.model import DistortionModel, TimeDependence

__all__ = ["gap_priors", "with_gap"]

CONSTANTS = (("u", 0, 0), ("v", 0, 0))
SIGMA_HELD = 1e-6  # pixels, and pixels per year


def with_gap(model: DistortionModel) -> DistortionModel:
    """The model with steps of the constant terms, where it has several chips and breaks."""
    time = model.time
    if time is None or not time.breaks or len(model.chips) == 1:
        return model
    terms = (*time.terms, *(t for t in CONSTANTS if t not in time.terms))
    return replace(model, time=replace(time, terms=terms))


def gap_priors(
    model: DistortionModel, asked: TimeDependence | None, pixel: float
) -> GaussianPriors:
    """Priors that leave of the constant terms' drift the steps of all chips but the first.

    Parameters
    ----------
    model : DistortionModel
        The reference chip comes first: its constant terms are where the exposures point.
    asked : TimeDependence or None
        The configured drift: constant terms that it names have rates as well.
    pixel : float
        Size of a pixel in the unit of u, v.
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
