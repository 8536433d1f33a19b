"""Bring-up of a calibration: alternate matching and fitting until the corners are covered.

See WSDC D-T033, sections 2 and 3.  If the distortion is poorly known, matches are found only near
the centre; each fit extends the area in which they can be found.  Three rules prevent the iteration
from following false matches.  A bin of the detector counts as covered only if it has more matches
than expected by chance.  Matches in other bins are not used.  The order of the polynomial increases
as the covered area grows.
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

BINS = 12  # number of bins per axis for the coverage
FIRST_ORDER = 2  # polynomial order of the first fit; it increases by at most one per round
GROWS = 0.01  # smallest increase of the covered fraction that counts as growth
SETTLED = 0.005  # convergence: largest change of the model, relative to the radius in the centre


@dataclass(frozen=True, eq=False)
class Round:
    """Round of the bring-up: statistics of the matches and the fit."""

    order: int  # polynomial order of the fit
    acceptance: RadialLimit  # matching radius, from the centre to the corners
    n_pairs: int  # number of all matches
    n_believed: int  # number of matches in covered bins, which were fitted
    n_false: float  # expected number of false matches among those, from displaced detections
    coverage: float  # fraction of the bins with detections that are covered
    rms: float  # rms residual per axis of the matches that the fit used
    moved: float  # largest change of the model over the detector
    theta: Float  # (n_params,), parameters after the fit; terms above its order are zero


@dataclass(frozen=True, eq=False)
class BringUp:
    """Result of a bring-up.

    Parameters
    ----------
    rounds : tuple of Round
        Statistics of all rounds.
    fit : LinearFit
        Fit of the last round.
    matches : Matches
        Matches fitted in the last round; exposures are the frames.
    index, reference_index : ndarray of int, shape (n_believed,)
        Rows of these matches in the two lists.
    covered : ndarray of bool, shape (BINS, BINS)
        Bins [iy, ix] of the detector that are covered in the last round.
    settled : bool
        True if the iteration converged: the last fit did not change the model.
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
        """Convergence, coverage, number of matches and their rms as sentences for reports."""
        first, last = self.rounds[0], self.rounds[-1]
        end = "converged" if self.settled else "has NOT converged"
        out = (
            f"The calibration {end} in {len(self.rounds)} rounds: coverage rose from "
            f"{100 * first.coverage:.0f} % to {100 * last.coverage:.0f} % of the detector, "
            f"{last.n_believed} pairs with {last.rms:.3g} {self.fit.model.unit} rms, some "
            f"{last.n_false:.0f} of them false."
        )
        if last.coverage < 1.0:
            out += (
                f" {(~self.covered).sum()} of {self.covered.size} bins are not covered; "
                "there it is an extrapolation."
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
    """Match and fit alternately until the whole detector is covered and the model converges.

    While the coverage grows, matches are accepted within a radius that increases towards the
    corners, and the corners have extra weight in the fit.  Then the radius of the centre and equal
    weights are used everywhere.

    Parameters
    ----------
    detections : Detections
        Pixel positions on the detector, with errors; the exposures are the frames.
    reference : Detections
        Undistorted positions in the frames, with errors in the same unit.
    model : DistortionModel
        Model with one chip, without frames and time dependence.
    start : ndarray, shape (n_params,), optional
        Initial parameters; by default no distortion is assumed.
    acceptance : RadialLimit
        Matching radius of the first rounds.  In the centre it must exceed the initial offset.
    max_rounds : int
        Maximum number of rounds.

    Returns
    -------
    BringUp
        Check `settled`, which is False if `max_rounds` was not sufficient.

    Raises
    ------
    InputError
        If the model has several chips or frames, the initial parameters are invalid, stars have no
        errors, a detection is outside of the detector, or no bin of the detector has more matches
        than expected by chance.
    DegenerateError
        If too little of the detector is covered in the end (see `fit_linear`).
    """
    if len(model.chips) > 1 or model.n_frame or model.time is not None:
        raise InputError(
            "bring-up needs a model with one chip, without frames and time dependence",
            where="model",
            do="select one chip",
        )
    if start is not None and np.shape(start) != (model.n_params,):
        raise InputError(
            f"the start has shape {np.shape(start)}, but the model has {model.n_params} parameters",
            where="start",
            do="give the parameters of this model",
        )
    field = Field(detections, reference, model, BINS)
    theta = None if start is None else np.asarray(start, float)
    if not np.isfinite(field.positions(theta, field.grid)).all():
        raise InputError(
            "the initial positions are not finite over the detector",
            where="start",
            do="check the coefficients",
        )
    rounds: list[Round] = []
    rejection = (
        DEFAULT_REJECTION  # has extra weight in the corners, while the radius is larger there
    )
    rule, order, settled = acceptance, min(FIRST_ORDER, model.order), False
    while True:
        accepted = field.match(theta, rule, len(rounds) + 1)
        matches = field.table(accepted)
        # the last fit is of the complete model, and raises an error if the coverage is too low
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
                n_pairs=accepted.n_pairs,
                n_believed=len(accepted.index),
                n_false=accepted.n_false,
                coverage=accepted.coverage,
                rms=float(np.hypot(now.rms_u, now.rms_v) / np.sqrt(2)),
                moved=moved,
                theta=theta,
            )
        )
        unchanged = moved < SETTLED * acceptance.centre
        if fit is not None:
            covered = accepted.covered.reshape(BINS, BINS)
            return BringUp(
                tuple(rounds),
                fit,
                matches,
                accepted.index,
                accepted.partner,
                covered,
                settled and unchanged,
            )
        grew = len(rounds) < 2 or accepted.coverage > rounds[-2].coverage + GROWS
        if order == model.order and not grew:
            settled = rule.corner == rule.centre and unchanged
            rule = RadialLimit(acceptance.centre, acceptance.centre)
            rejection = replace(rejection, radial_weight=1.0)
        order = min(order + 1, model.order)


def _partial_fit(
    matches: Matches, model: DistortionModel, order: int, rejection: Rejection
) -> LinearFit:
    """Fit to the part of the detector that has matches, treated as a smaller detector."""
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
    """Parameters (n_params,) of the full model from a fit to a part of the detector."""
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
