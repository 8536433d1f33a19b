"""Errors that are fields over the detector, beside those that a solution's own draws show.

Both kinds are errors of parameters: a draw is a vector theta, and its field on any chip at any
epoch follows from the model, so that one draw serves all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.solution import Solution, place_of
from bayesdist.assess.terms.given import GIVEN, MEASURED
from bayesdist.errors import InputError
from bayesdist.model import DistortionModel

__all__ = [
    "CATALOGUE",
    "EXPOSURE_SCATTER",
    "MOTIONS",
    "CatalogueTerm",
    "ExposureScatter",
    "FieldDraws",
    "FieldTerm",
    "part_of",
]

Float = NDArray[np.float64]

CATALOGUE = "reference catalogue (shared stars)"
MOTIONS = "proper motions (shared stars)"
EXPOSURE_SCATTER = "exposure scatter"


@dataclass(frozen=True, eq=False)
class FieldDraws:
    """Draws of an error of parameters.

    Parameters
    ----------
    model : DistortionModel
    mean : ndarray, shape (D,)
        Where there is no error.
    theta : ndarray, shape (n, D)
    exposure : int or ndarray of int, shape (n,), optional
        Code of the exposure, of all draws or of each, whose frame is among the parameters that err;
        None for errors of the polynomials and their drift alone.
    """

    model: DistortionModel
    mean: Float
    theta: Float
    exposure: int | NDArray[np.int64] | None = None

    def polynomials(self, *, epoch: float | None, chip: int) -> Float:
        """Legendre coefficients (n, 2, K) of the error, along the axes of the gauge.

        Parameters
        ----------
        epoch : float or None
            Decimal years.
        chip : int
            Chip number.
        """
        if isinstance(self.exposure, np.ndarray):
            out = np.empty((len(self.theta), 2, self.model.n_terms))
            for e in np.unique(self.exposure):
                rows = self.exposure == e
                here = FieldDraws(self.model, self.mean, self.theta[rows], int(e))
                out[rows] = here.polynomials(epoch=epoch, chip=chip)
            return out
        place = place_of(self.model, epoch=epoch, exposure=self.exposure, chip=chip)
        error = place.polynomial(self.theta) - place.polynomial(self.mean)
        if self.exposure is None:
            return error
        return np.linalg.solve(self.model.frame(self.mean, self.exposure)[0], error)


class FieldTerm(Protocol):
    """An error that is a field over the detector.

    A term is one of three things.  It may come in addition to a solution; `without` is None then.
    Or the solution's draws hold it already, and it is shown beside its other parts: then `without`
    is the solution that lacks it.  Or another term holds it, which it names (see `part_of`): it is
    shown then, and not added either.
    """

    @property
    def name(self) -> str: ...

    @property
    def source(self) -> str: ...

    @property
    def without(self) -> Solution | None: ...

    def draws(self, n: int, rng: np.random.Generator) -> FieldDraws: ...


def part_of(term: FieldTerm) -> str:
    """Name of the term that holds this one; empty for one that stands by itself."""
    return str(getattr(term, "part_of", ""))


@dataclass(frozen=True, eq=False)
class CatalogueTerm:
    """What the errors of the reference catalogue do to polynomials and drift.

    A star has one error in however many exposures it is matched.  The solution that is assessed
    has this error; the one without it took the catalogue's errors for independent from match to
    match, and shows the rows of the budget beside this one.  So what independent errors of the
    catalogue would do stands in those rows, and all of what the true ones do in this row: the
    squares of the rows add up to more than the total, which is drawn from the solution.

    Parameters
    ----------
    without : Posterior or LinearFit
        The solution that takes the catalogue's errors for independent.
    covariance : ndarray, shape (D, D)
        Of the error of its parameters that the catalogue causes: `total` of a `StarCovariance`, or
        its part for the positions, and the one for the motions in a term of its own.
    name : str
    source : str
        Where the errors of the catalogue come from.
    """

    without: Solution
    covariance: Float
    name: str = CATALOGUE
    source: str = GIVEN

    def draws(self, n: int, rng: np.random.Generator) -> FieldDraws:
        """Draws of the error from N(0, covariance)."""
        model, mean = self.without.model, np.asarray(self.without.mean, float)
        D = model.n_distortion
        # scales of units and sizes apart, a sum of squares: eigenvalues below 0 are rounding
        scale = np.sqrt(np.diag(self.covariance)[:D])
        scale = np.where(scale > 0, scale, 1.0)
        values, vectors = np.linalg.eigh(self.covariance[:D, :D] / np.outer(scale, scale))
        root = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
        theta = np.tile(mean, (n, 1))
        theta[:, :D] += rng.standard_normal((n, D)) @ root.T
        return FieldDraws(model, mean, theta)


@dataclass(frozen=True, eq=False)
class ExposureScatter:
    """How a new exposure deviates from the polynomials that all exposures have in common.

    Parameters
    ----------
    model : DistortionModel
        With frames in gauge 'held', in which exposures deviate from the polynomials.
    mean : ndarray, shape (D,)
        Of its parameters.
    kinds : tuple of str, length k
        Deviations that scatter, as an exposure's parameters are named: 'scale', 'shear_plus', ...
    tau : ndarray, shape (m, k)
        Draws of the scatter of each kind.
    name, source : str

    Raises
    ------
    InputError
        For a kind that is no parameter of an exposure, or another number of kinds in `tau`.
    """

    model: DistortionModel
    mean: Float
    kinds: tuple[str, ...]
    tau: Float
    name: str = EXPOSURE_SCATTER
    source: str = MEASURED
    without: None = None

    def __post_init__(self) -> None:
        known = self.model.free_frame_names(self._exposure)
        unknown = [kind for kind in self.kinds if kind not in known]
        if unknown:
            raise InputError(
                f"exposures have no deviation {unknown[0]!r}",
                where=f"budget term {self.name!r}",
                do=f"choose among {', '.join(known) or 'those of a model with frames'}",
            )
        if self.tau.shape[1:] != (len(self.kinds),):
            raise InputError(
                f"scatter has shape {self.tau.shape} for {len(self.kinds)} kinds of deviation",
                where=f"budget term {self.name!r}",
                do="give draws by kinds",
            )

    @property
    def _exposure(self) -> int:
        """The exposure whose place a new one takes: any, as its own deviations are put to zero."""
        return len(self.model.exposures) - 1

    def draws(self, n: int, rng: np.random.Generator) -> FieldDraws:
        """Draws of deviations, each from a normal distribution with a scatter of its own."""
        known = self.model.free_frame_names(self._exposure)
        first = self.model.frame_slice(self._exposure).start
        at = [first + known.index(kind) for kind in self.kinds]
        mean = np.array(self.mean, float)
        mean[at] = 0.0
        theta = np.tile(mean, (n, 1))
        tau = self.tau[rng.integers(len(self.tau), size=n)]
        theta[:, at] = tau * rng.standard_normal(tau.shape)
        return FieldDraws(self.model, mean, theta, self._exposure)
