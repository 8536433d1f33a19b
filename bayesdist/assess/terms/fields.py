"""Position errors of a solution as fields over the detector, part by part, by draws.

Every error field is a polynomial of the pixel position, so a draw is kept as 2 K coefficients and
evaluated where and when it is wanted: memory does not grow with draws times grid points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.assess.solution import Solution, place_of
from bayesdist.assess.terms.field_terms import FieldDraws, FieldTerm, part_of
from bayesdist.assess.terms.rigid import without_rigid
from bayesdist.calibration.chip_map import position_moments
from bayesdist.errors import InputError
from bayesdist.model import DistortionModel, PolynomialBasis
from bayesdist.model.basis import point_blocks

__all__ = [
    "COEFFICIENTS",
    "EXPOSURE_FRAME",
    "MODEL",
    "TIME_DEPENDENCE",
    "ErrorDraws",
    "ErrorFields",
    "draw_errors",
    "error_fields",
]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

COEFFICIENTS = "coefficients"
TIME_DEPENDENCE = "time dependence"
EXPOSURE_FRAME = "exposure frame"
MODEL = "model"

NO_FRAME = -1  # where a draw's star lies in no exposure


@dataclass(frozen=True, eq=False)
class ErrorFields:
    """Draws of the position error over the detector.

    Parameters
    ----------
    x, y : ndarray, shape (N,)
        FITS 1-based pixels.
    polynomials : dict of str to ndarray, shape (n, 2, K)
        For each part, the Legendre coefficients of the error of each draw: "coefficients" and,
        where the model has them, "time dependence" and "exposure frame"; the field terms by their
        names; "model" is the joint error of all.
    basis : PolynomialBasis
    unit : str
    chip : int
    epoch : float or None
    """

    x: Float
    y: Float
    polynomials: dict[str, Float]
    basis: PolynomialBasis
    unit: str
    chip: int
    epoch: float | None

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts; "model", the joint error, is the last one."""
        return tuple(self.polynomials)

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return len(self.polynomials[MODEL])

    def field(self, part: str, draws: slice = slice(None)) -> Float:
        """The error of some draws at all points, shape (n, N, 2), in `unit`."""
        e = self.polynomials[part][draws]
        out = np.empty((len(e), self.x.size, 2))
        for rows in point_blocks(self.x.size):
            phi = self.basis.evaluate(self.x[rows], self.y[rows])
            out[:, rows] = np.swapaxes(e @ phi.T, -1, -2)
        return out

    def sigma(self, part: str) -> tuple[Float, Float]:
        """Root mean square over the draws at each point, (N,) for u and for v."""
        e = self.polynomials[part]
        flat = e.reshape(len(e), -1)
        second = (flat.T @ flat / len(e)).reshape(*e.shape[1:], *e.shape[1:])
        uu, vv, _ = position_moments(second, self.basis, self.x, self.y)
        return np.sqrt(uu), np.sqrt(vv)


def error_fields(
    solution: Solution,
    x: ArrayLike,
    y: ArrayLike,
    *,
    fields: Sequence[FieldTerm] = (),
    aligned: bool = False,
    epoch: float | None = None,
    chip: int | None = None,
    n_draws: int = 1000,
    rng: np.random.Generator,
) -> ErrorFields:
    """Draws of the position error, by part and jointly.

    Each error is a draw minus the solution's mean.  A star is taken to lie in an exposure chosen at
    random, for each draw, among those whose frame was fitted (all but the first, in gauge 'held'
    all), and its error is given along the axes of the polynomials: so the parts add up to "model"
    (to first order) however the field turned between exposures.  They are correlated, hence the
    sigma of "model" is not their quadrature sum.

    Parameters
    ----------
    solution : LinearFit or Posterior
    x, y : array_like, shape (N,)
        FITS 1-based pixels.
    fields : sequence of FieldTerm
        Errors that are fields, beside the solution or shown beside its other parts.
    aligned : bool
        Whether the star lies in a new exposure whose shift and rotation the observer fits: no frame
        of the solution is in the error then, and what a shift and a rotation of all chips together
        take up is no error.
    epoch : float, optional
        Decimal years; needed by a model with time dependence.
    chip : int, optional
        Chip number; the first chip by default.
    n_draws : int
    rng : numpy.random.Generator

    Returns
    -------
    ErrorFields

    Raises
    ------
    InputError
        For an unknown chip, a missing epoch, or fewer than two draws.
    """
    number = place_of(solution.model, epoch=epoch, chip=chip).chip.number
    points = np.atleast_1d(np.asarray(x, float)), np.atleast_1d(np.asarray(y, float))
    draws = draw_errors(solution, n_draws, rng, fields=fields, aligned=aligned)
    (found,) = draws.at({number: points}, epoch=epoch)
    return found


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Draws of a solution, each in an exposure."""

    solution: Solution
    theta: Float
    exposures: Int

    def parts(self, epoch: float | None, chip: int) -> dict[str, Float]:
        """Legendre coefficients (n, 2, K) of each part and of all jointly."""
        theta, model = self.theta, self.solution.model
        mean = np.asarray(self.solution.mean, float)
        gauge = place_of(model, epoch=epoch, chip=chip)
        joint = gauge.polynomial(theta) - gauge.polynomial(mean)
        static = _static(model, theta - mean, chip)
        parts = {COEFFICIENTS: static}
        if model.time is not None:
            parts[TIME_DEPENDENCE] = joint - static
        if np.any(self.exposures != NO_FRAME):
            frame = np.zeros_like(joint)
            for e in np.unique(self.exposures):
                rows = np.flatnonzero(self.exposures == e)
                only_frame = np.tile(mean, (rows.size, 1))
                block = model.frame_slice(int(e))
                only_frame[:, block] = theta[rows, block]
                for out, drawn in ((joint, theta[rows]), (frame, only_frame)):
                    error = FieldDraws(model, mean, drawn, int(e))
                    out[rows] = error.polynomials(epoch=epoch, chip=chip)
            parts[EXPOSURE_FRAME] = frame
        parts[MODEL] = joint
        return parts


@dataclass(frozen=True, eq=False)
class ErrorDraws:
    """Draws of all errors that are fields: the same draws serve all chips and epochs.

    Parameters
    ----------
    whole : draws of the solution
    shown : draws of the one whose parts are shown
        The same, but where field terms are among the solution's errors.
    terms : dict of str to FieldDraws
    added : frozenset of str
        Names of those that come in addition to the solution.
    aligned : bool
        Whether shift and rotation are taken out of every field.
    """

    whole: _Drawn
    shown: _Drawn
    terms: dict[str, FieldDraws]
    added: frozenset[str]
    aligned: bool

    def at(
        self, points: Mapping[int, tuple[Float, Float]], *, epoch: float | None = None
    ) -> tuple[ErrorFields, ...]:
        """Error fields of some chips at an epoch.

        Parameters
        ----------
        points : mapping of int to (x, y), shape (N,) each
            By chip number: FITS 1-based pixels.
        epoch : float, optional
            Decimal years; needed by a model with time dependence.

        Returns
        -------
        tuple of ErrorFields
            One for each chip, in that order.

        Raises
        ------
        InputError
            For an unknown chip, or a missing epoch.
        """
        model = self.whole.solution.model
        places = {number: place_of(model, epoch=epoch, chip=number) for number in points}
        numbers = [chip.number for chip in model.chips] if self.aligned else list(points)
        polynomials = {number: self._polynomials(epoch, number) for number in numbers}
        if self.aligned:
            mean = np.asarray(self.whole.solution.mean, float)
            positions = {
                number: place_of(model, epoch=epoch, chip=number).polynomial(mean)
                for number in numbers
            }
            for part in polynomials[numbers[0]]:
                errors = {number: polynomials[number][part] for number in numbers}
                for number, rest in without_rigid(errors, positions, model).items():
                    polynomials[number][part] = rest
        return tuple(
            ErrorFields(
                *xy,
                polynomials=polynomials[number],
                basis=places[number].basis,
                unit=model.unit,
                chip=number,
                epoch=places[number].epoch,
            )
            for number, xy in points.items()
        )

    def _polynomials(self, epoch: float | None, chip: int) -> dict[str, Float]:
        """Coefficients of all parts on a chip, the joint error last."""
        out = self.shown.parts(epoch, chip)
        joint = out.pop(MODEL)
        if self.whole is not self.shown:
            joint = self.whole.parts(epoch, chip)[MODEL]
        for name, term in self.terms.items():
            out[name] = term.polynomials(epoch=epoch, chip=chip)
            if name in self.added:
                joint = joint + out[name]
        return out | {MODEL: joint}


def draw_errors(
    solution: Solution,
    n_draws: int,
    rng: np.random.Generator,
    *,
    fields: Sequence[FieldTerm] = (),
    aligned: bool = False,
) -> ErrorDraws:
    """Draw the errors of a solution and of field terms.

    Parameters
    ----------
    solution, n_draws, rng, fields, aligned
        As in `error_fields`.

    Returns
    -------
    ErrorDraws

    Raises
    ------
    InputError
        For fewer than two draws, or field terms that the solution holds already and that name
        different solutions without them.
    """
    if n_draws < 2:
        raise InputError(f"the number of draws is {n_draws}", do="ask for at least 2")
    held = [term.without for term in fields if term.without is not None]
    if any(one is not held[0] for one in held):
        raise InputError(
            f"{len(held)} field terms are among the errors of the solution, and they name "
            "different solutions that lack them",
            where="fields",
            do="name the solution that lacks all of them",
        )
    whole = _drawn(solution, n_draws, rng, aligned)
    shown = _drawn(held[0], n_draws, rng, aligned) if held else whole
    terms = {term.name: term.draws(n_draws, rng) for term in fields}
    added = frozenset(t.name for t in fields if t.without is None and not part_of(t))
    return ErrorDraws(whole, shown, terms, added, aligned)


def _drawn(solution: Solution, n: int, rng: np.random.Generator, aligned: bool) -> _Drawn:
    theta = np.asarray(solution.draws(n, rng), float)
    model = solution.model
    fitted = [e for e in range(len(model.exposures)) if model.free_frame_names(e)]
    if aligned or not fitted:
        return _Drawn(solution, theta, np.full(len(theta), NO_FRAME))
    return _Drawn(solution, theta, rng.integers(fitted[0], len(model.exposures), size=len(theta)))


def _static(model: DistortionModel, theta: Float, chip: int) -> Float:
    """Legendre coefficients (..., 2, K) of a chip without drift."""
    return np.stack([theta[..., model.coefficient_slice(chip, axis)] for axis in (0, 1)], axis=-2)
