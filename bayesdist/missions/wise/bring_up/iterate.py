"""Bring-up of a calibration: match, fit and match again, until the corners are covered too.

WSDC D-T033, sections 2 and 3: with a distortion that is hardly known, matches are found near the
centre only; each fit brings more of the detector within reach. Three rules stop the loop from
following false matches: a part of the detector counts only where there are more matches than chance
gives, matches elsewhere are left out, and the polynomial's order rises as that part does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.data.detections import Detections
from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.solution.linear import DEFAULT_REJECTION, LinearFit, Rejection, fit_linear
from bayesdist.missions.wise.bring_up.pairs import Field
from bayesdist.missions.wise.pairs.radial_limit import RadialLimit
from bayesdist.model import Chip, DistortionModel
from bayesdist.utils.arrays import Bool, Float, Int

__all__ = ["BringUp", "bring_up"]

BINS = 12  # of the coverage, on each axis
FIRST_ORDER = 2  # polynomial order of the first fit; each round may take one order more
GROWS = 0.01  # fraction of the bins by which the coverage must rise to count as growing
SETTLED = 0.005  # fraction of the radius in the centre by which the model may still change


@dataclass(frozen=True, eq=False)
class Round:
    """One round of the bring-up: the matches and the fit to them."""

    order: int  # polynomial order of the fit
    acceptance: RadialLimit  # matching radius, centre to corners
    n_pairs: int  # all matches
    n_believed: int  # matches in covered bins, which were fitted
    # expected number of false matches among those fitted, from what displaced detections find
    n_false: float
    # fraction of the detector's bins with detections that have enough more matches than chance
    coverage: float
    rms: float  # rms residual of the matches that the fit used, one axis
    moved: float  # largest change of the model over the detector
    theta: Float  # (n_params,), the model after the fit; terms beyond its order are zero


@dataclass(frozen=True, eq=False)
class BringUp:
    """Result of a bring-up: its rounds, the last fit and the matches of that fit.

    Parameters
    ----------
    rounds : tuple of Round
    fit : LinearFit
        Of the last round.
    matches : Matches
        Matches fitted in the last round; exposures are the frames.
    index, reference_index : ndarray of int, shape (n_believed,)
        Rows of these matches in the two lists.
    covered : ndarray of bool, shape (BINS, BINS)
        Bins [iy, ix] of the detector that are covered in the last round.
    settled : bool
        True if the last fit changed the model no more.
    """

    rounds: tuple[Round, ...]
    fit: LinearFit
    matches: Matches
    index: Int
    reference_index: Int
    covered: Bool
    settled: bool

    @property
    def sentence(self) -> str:
        """Sentence for reports: convergence, coverage, number of matches and their rms."""
        first, last = self.rounds[0], self.rounds[-1]
        end = "settled" if self.settled else "has NOT settled"
        out = (
            f"The calibration {end} in {len(self.rounds)} rounds: coverage went from "
            f"{100 * first.coverage:.0f} % to {100 * last.coverage:.0f} % of the detector, "
            f"{last.n_believed} pairs with {last.rms:.3g} {self.fit.model.unit} rms, some "
            f"{last.n_false:.0f} of them false."
        )
        if last.coverage < 1.0:
            out += (
                f" {(~self.covered).sum()} of {self.covered.size} bins are not covered: "
                "there it is a guess."
            )
        return out


def bring_up(
    detections: Detections,
    reference: Detections,
    model: DistortionModel,
    start: Float | None = None,
    *,
    acceptance: RadialLimit,
    max_rounds: int = 30,
) -> BringUp:
    """Match and fit in turn until the whole detector is covered and the model changes no more.

    As long as the coverage grows, matches are accepted within a radius that is larger in the
    corners; then within the radius of the centre everywhere, with even weights.

    Parameters
    ----------
    detections : Detections
        Pixel positions on the detector, with errors; the exposures are the frames.
    reference : Detections
        Undistorted positions in the frames, with errors in their unit.
    model : DistortionModel
        One chip, without frames and time dependence.
    start : ndarray, shape (n_params,), optional
        First guess; without one, the detections' pixels are taken as undistorted positions.
    acceptance : RadialLimit
        Of the first rounds.  The radius in the centre must allow for the offset there.
    max_rounds : int

    Returns
    -------
    BringUp
        Look at `settled`: False where `max_rounds` did not suffice.

    Raises
    ------
    InputError
        For a model of several chips or with frames, a start of another length or of positions that
        are not finite, stars without errors, a detection outside the detector, or when nowhere on
        the detector more matches are found than chance gives.
    DegenerateError
        As `fit_linear`, when in the end too little of the detector is covered.
    """
    if len(model.chips) > 1 or model.n_frame or model.time is not None:
        raise InputError(
            "a calibration is brought up on one chip, without frames and time dependence",
            where="model",
            do="select one chip",
        )
    if start is not None and np.shape(start) != (model.n_params,):
        raise InputError(
            f"the start has shape {np.shape(start)}, and the model {model.n_params} parameters",
            where="start",
            do="give the parameters of this model",
        )
    field = Field(detections, reference, model, BINS)
    theta = None if start is None else np.asarray(start, float)
    if not np.isfinite(field.positions(theta, field.grid)).all():
        raise InputError(
            "the positions that it begins with are not finite over the detector",
            where="start",
            do="check the coefficients",
        )
    rounds: list[Round] = []
    rejection = DEFAULT_REJECTION  # with extra weight in the corners, as long as the radius has
    rule, order, settled = acceptance, min(FIRST_ORDER, model.order), False
    while True:
        found = field.match(theta, rule, len(rounds) + 1)
        matches = field.table(found)
        # the last fit is that of the model itself, which refuses matches that cover too little
        last = settled or len(rounds) + 1 >= max_rounds
        order = model.order if last else order
        fit = fit_linear(matches, model, rejection=rejection) if last else None
        now = _partial_fit(matches, model, order, rejection) if fit is None else fit
        moved = field.distance(theta, _in_model(now, model))
        theta = _in_model(now, model)
        rounds.append(
            Round(
                order=order,
                acceptance=rule,
                n_pairs=found.n_pairs,
                n_believed=len(found.index),
                n_false=found.n_false,
                coverage=found.coverage,
                rms=float(np.hypot(now.rms_u, now.rms_v) / np.sqrt(2)),
                moved=moved,
                theta=theta,
            )
        )
        still = moved < SETTLED * acceptance.centre
        if fit is not None:
            covered = found.covered.reshape(BINS, BINS)
            return BringUp(
                tuple(rounds), fit, matches, found.index, found.partner, covered, settled and still
            )
        grew = len(rounds) < 2 or found.coverage > rounds[-2].coverage + GROWS
        if order == model.order and not grew:
            settled = rule.corner == rule.centre and still
            rule = RadialLimit(acceptance.centre, acceptance.centre)
            rejection = replace(rejection, radial_weight=1.0)
        order = min(order + 1, model.order)


def _partial_fit(
    matches: Matches, model: DistortionModel, order: int, rejection: Rejection
) -> LinearFit:
    """Fit of the part of the detector that has matches, as if it were a detector of its own."""
    low = [max(0.0, np.floor(z.min() - 0.5)) for z in (matches.x, matches.y)]
    high = [np.ceil(z.max() + 0.5) - 1.0 for z in (matches.x, matches.y)]
    chip = model.chips[0]
    part = Chip(
        chip.number,
        chip.name,
        (float(high[0] - low[0]), float(high[1] - low[1])),
        (chip.reference_pixel[0] - low[0], chip.reference_pixel[1] - low[1]),
    )
    moved = matches.with_columns(x=matches.x - low[0], y=matches.y - low[1])
    return fit_linear(moved, replace(model, order=order, chips=(part,)), rejection=rejection)


def _in_model(fit: LinearFit, model: DistortionModel) -> Float:
    """Parameters (n_params,) of the full model for a fit of part of the detector."""
    if fit.model == model:
        return fit.mean
    basis, part = model.basis(), fit.model.basis()
    theta = np.zeros(model.n_params)
    for axis in (0, 1):
        monomial = np.zeros(basis.n_terms)
        monomial[: part.n_terms] = part.to_monomials(
            fit.mean[fit.model.coefficient_slice(None, axis)]
        )
        theta[model.coefficient_slice(None, axis)] = basis.from_monomials(monomial)
    return theta
