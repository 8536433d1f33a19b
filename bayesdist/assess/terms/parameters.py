"""Errors of parameters: of a solution, of the catalogue, of a new exposure, of the scale."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms import (
    GIVEN,
    MEASURED,
    ErrorDraws,
    ErrorTerm,
    Image,
    Pool,
    Row,
    Together,
    TogetherField,
)
from bayesdist.assess.terms.functions import PolynomialField, Polynomials, polynomial_errors
from bayesdist.errors import InputError, require_known
from bayesdist.infer.catalogue.star_covariance import StarCovariance
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import DistortionModel
from bayesdist.plugin import mission_objects
from bayesdist.utils.arrays import Float, Int

CATALOGUE = "reference catalogue (shared stars)"
MOTIONS = "proper motions (shared stars)"
EXPOSURE_SCATTER = "exposure-to-exposure variation"
ABERRATION = "velocity aberration"
COEFFICIENTS = "coefficients"
TIME_DEPENDENCE = "time dependence"
EXPOSURE_FRAME = "exposure frame"


@dataclass(frozen=True, eq=False)
class CatalogueErrors:
    """Effect of the errors of the reference catalogue on polynomials and drift.

    A star has the same catalogue error in all exposures in which it is matched. The assessed
    solution includes these correlated errors. The rows of the budget are those of a solution that
    takes catalogue errors as independent between matches. Those rows thus contain the effect of
    independent errors and this row the full effect of correlated errors. The sum of squares of all
    rows therefore exceeds the total, which is drawn from the assessed solution.
    """

    model: DistortionModel
    mean: Float  # mean parameters, (D,)
    # covariance (D, D) that the catalogue errors contribute to the parameters: `total` of a
    # `StarCovariance`, or separate terms for its part from positions and its part from proper
    # motions
    covariance: Float
    name: str = CATALOGUE
    source: str = GIVEN  # origin of the errors of the catalogue

    @property
    def rows(self) -> tuple[Row, ...]:
        """A row that is not in the total, because the solution already includes it."""
        return (Row(self.name, source=self.source, in_total=False),)

    def draw(self, n: int, rng: np.random.Generator) -> Polynomials:
        """Draws of the error from N(0, covariance)."""
        mean, D = np.asarray(self.mean, float), self.model.n_distortion
        # the covariance is positive semidefinite; after scaling, negative eigenvalues are rounding
        scale = np.sqrt(np.diag(self.covariance)[:D])
        scale = np.where(scale > 0, scale, 1.0)
        values, vectors = np.linalg.eigh(self.covariance[:D, :D] / np.outer(scale, scale))
        # symmetric square root: draws do not depend on signs and order of eigenvectors
        root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
        theta = np.tile(mean[: self.model.n_global], (n, 1))
        theta[:, :D] += scale * (rng.standard_normal((n, D)) @ root)
        return Polynomials(self.rows[0], self.model, mean, theta)


def catalogue_terms(
    solution: Solution, stars: StarCovariance, catalogue: str
) -> tuple[CatalogueErrors, ...]:
    """Terms for the errors of catalogue positions and, if any, of proper motions.

    `solution`: solution that takes these errors as independent. `catalogue`: name of the file that
    states the errors.
    """
    source = f"{GIVEN}: errors of {{}} in {catalogue}"
    model, mean = solution.model, np.asarray(solution.mean, float)
    moved = 0.0 if stars.motions is None else stars.motions
    of_positions = source.format("positions")
    positions = CatalogueErrors(model, mean, stars.total - moved, source=of_positions)
    if stars.motions is None:
        return (positions,)
    of_motions = source.format("proper motions")
    return positions, CatalogueErrors(model, mean, stars.motions, MOTIONS, of_motions)


@dataclass(frozen=True, eq=False)
class ScaleError:
    """A Gaussian error of scale or orientation about the reference pixel of the first chip.

    An example is velocity aberration that was not corrected, or that was corrected with an
    inaccurate spacecraft velocity. It changes the scale by up to 1e-4.

    Raises InputError if the kind is unknown, or if sigma is negative or not finite.
    """

    name: str
    kind: str  # 'scale' or 'rotation'
    sigma: float  # standard deviation, relative for a scale and in radians for a rotation
    solution: Solution  # solution with the positions that the error moves
    source: str = GIVEN
    in_total: bool = True  # False if another row includes this error

    def __post_init__(self) -> None:
        location = f"budget term {self.name!r}"
        require_known(self.kind, ("scale", "rotation"), "kind", where=location)
        if not (math.isfinite(self.sigma) and self.sigma >= 0):
            raise InputError(
                f"sigma is {self.sigma}", where=location, do="give a number that is not negative"
            )

    @property
    def rows(self) -> tuple[Row, ...]:
        """Row of the scale or orientation error."""
        return (Row(self.name, source=self.source, in_total=self.in_total),)

    def draw(self, n: int, rng: np.random.Generator) -> Polynomials:
        """Draws of the error, one number per draw for the whole image."""
        model, mean = self.solution.model, np.asarray(self.solution.mean, float)
        epoch = None if model.time is None else model.time.epoch0[0]
        first = place_of(model, epoch=epoch)
        phi = first.basis.evaluate(*np.array(first.chip.reference_pixel)[:, None])[0]
        origin = first.polynomial(mean) @ phi
        moved = np.zeros_like(mean)
        for chip in model.chips:
            slices = [model.coefficient_slice(chip.number, axis) for axis in (0, 1)]
            position = np.stack([mean[s] for s in slices])
            position[:, 0] -= origin  # the first basis function is 1
            if self.kind == "rotation":
                position = np.stack([-position[1], position[0]])
            for s, change in zip(slices, position, strict=True):
                moved[s] = change
        sizes, moving = self.sigma * rng.standard_normal((n, 1)), slice(model.n_global)
        return Polynomials(self.rows[0], model, mean, mean[moving] + sizes * moved[moving])


# error terms that a `[[budget]]` row with a single sigma can create, by kind; the unit of sigma is
# defined by the term, since such rows have no unit
ONE_SIZE: dict[str, Callable[..., ErrorTerm]] = {"scale": ScaleError, "rotation": ScaleError}


def one_size_kinds() -> tuple[str, ...]:
    """Kinds of error terms with a single size, including those that missions add."""
    return (*ONE_SIZE, *mission_objects(lambda mission: mission.error_terms))


def one_size_term(name: str, kind: str, sigma: float, solution: Solution, source: str) -> ErrorTerm:
    """Error term of a kind from `one_size_kinds`.

    See `ScaleError` for the arguments.
    """
    make = (ONE_SIZE | mission_objects(lambda mission: mission.error_terms))[kind]
    return make(name, kind, sigma, solution, source)


@dataclass(frozen=True, eq=False)
class ExposureVariation:
    """Deviation of a new exposure from the polynomials that are common to all exposures."""

    # frames must have gauge 'held', in which exposures deviate from the polynomials
    model: DistortionModel
    mean: Float  # mean parameters, (D,)
    # (k,), kinds of deviation, named like parameters of an exposure: 'scale', 'shear_plus', ...
    kinds: tuple[str, ...]
    tau: Float  # (m, k), draws of the standard deviation of each kind over the exposures
    # part of the variation that is known to be velocity aberration; shown but not added, because
    # the variation already includes it
    aberration: ScaleError | None = None
    name: str = EXPOSURE_SCATTER
    source: str = MEASURED

    @property
    def _exposure(self) -> int:
        """The exposure that represents a new one: any, since its deviations are set to zero."""
        return len(self.model.exposures) - 1

    @property
    def rows(self) -> tuple[Row, ...]:
        """Rows of the variation and, if known, of its part that is velocity aberration."""
        row = Row(self.name, source=self.source)
        return (row,) if self.aberration is None else (row, *self.aberration.rows)

    def draw(self, n: int, rng: np.random.Generator) -> ErrorDraws:
        """Draws of deviations from normal distributions; each uses a draw of the scatter."""
        return self.of_rows(rng.integers(len(self.tau), size=n), rng)

    def of_rows(self, rows: Int, rng: np.random.Generator) -> ErrorDraws:
        """Draws of deviations with the given draws of the scatter, numbers `rows` of shape (n,)."""
        names = self.model.free_frame_names(self._exposure)
        first = self.model.frame_slice(self._exposure).start
        at = [first + names.index(kind) for kind in self.kinds]
        mean = np.array(self.mean, float)
        mean[at] = 0.0
        theta = np.tile(mean, (len(rows), 1))
        tau = self.tau[rows]
        theta[:, at] = tau * rng.standard_normal(tau.shape)
        pools = (Pool(rows, len(self.tau)),)
        variation = Polynomials(self.rows[0], self.model, mean, theta, self._exposure, pools=pools)
        if self.aberration is None:
            return variation
        return Together((variation, self.aberration.draw(len(rows), rng)))


@dataclass(frozen=True, eq=False)
class SolutionErrors:
    """Draws of a solution minus its mean, split into coefficients, drift and exposure frame.

    The parts are correlated. To first order, they sum to the joint error along the axes of the
    polynomials, even if the field was rotated between exposures.
    """

    solution: Solution
    # solution without the errors of the catalogue, from which the rows of the parts are computed
    without: Solution | None = None
    # effects of the catalogue errors: shown but not added, because the draws already include them
    catalogue: tuple[CatalogueErrors, ...] = ()

    @property
    def fitted_exposures(self) -> list[int]:
        """Codes of the exposures with a fitted frame."""
        model = self.solution.model
        return [e for e in range(len(model.exposures)) if model.free_frame_names(e)]

    @property
    def rows(self) -> tuple[Row, ...]:
        """Rows of the coefficients, of drift and frame if the model has them, and the catalogue."""
        names = [COEFFICIENTS]
        if self.solution.model.time is not None:
            names.append(TIME_DEPENDENCE)
        if self.fitted_exposures:
            names.append(EXPOSURE_FRAME)
        return (*(Row(name) for name in names), *(r for c in self.catalogue for r in c.rows))

    def draw(self, n: int, rng: np.random.Generator) -> SolutionDraws:
        """Draws of the solution, and draws of the rows that the budget shows but does not add."""
        joint = shown = self.solution.drawn_rows(n, rng)
        (spawned,) = rng.spawn(1)  # rows that are only shown must not change later random numbers
        if self.without is not None:
            shown = self.without.drawn_rows(n, spawned)
        return SolutionDraws(self, joint, shown, tuple(c.draw(n, spawned) for c in self.catalogue))


@dataclass(frozen=True, eq=False)
class SolutionDraws:
    """Draws of the parameters from `drawn_rows`: for the joint error, and for the rows shown."""

    of: SolutionErrors
    joint: tuple[Float, Int]
    shown: tuple[Float, Int]
    catalogue: tuple[Polynomials, ...] = ()

    @property
    def pools(self) -> tuple[Pool, ...]:
        """The stored draws of a sampler; empty for a linear fit, which has independent draws.

        The effective number of draws is the smaller of the bulk and tail effective sample sizes,
        because a probability far from one half depends on the tails.
        """
        convergence = self.of.solution.convergence
        if convergence is None:
            return ()
        sizes = [convergence.ess_bulk_min, convergence.ess_tail_min]
        ess = 1.0 if any(math.isnan(size) for size in sizes) else max(min(sizes), 1.0)
        theta, rows = self.joint
        # draws that were transformed individually do not tell which draw of the sampler they are
        anonymous = len(theta) == len(rows) and np.array_equal(rows, np.arange(len(rows)))
        return (Pool(None if anonymous else rows, ess),)

    def on(self, domain: EvaluationDomain, image: Image) -> TogetherField:
        """Errors at the positions of a domain."""
        exact, shown = self.of.without is None, self.of.without or self.of.solution
        parts = _parts(shown, *self.shown, domain.epoch, image.exposure)
        fields = [
            # rows computed from another solution are not part of the draws of this one
            PolynomialField.of((Row(name, in_total=exact),), domain, image, of)
            for name, of in parts.items()
            if name
        ]
        model, mean = self.of.solution.model, np.asarray(self.of.solution.mean, float)
        theta, rows = self.joint

        def joint(chip: int) -> Float:
            at, e = domain.epoch, image.exposure
            return polynomial_errors(model, mean, theta, epoch=at, chip=chip, exposure=e, rows=rows)

        joint_field = PolynomialField.of((), domain, image, joint)
        fields += [c.on(domain, image) for c in self.catalogue]
        return TogetherField.of(domain, tuple(fields), joint_field)


def _parts(
    solution: Solution, theta: Float, rows: Int, epoch: float | None, exposure: Int | None
) -> dict[str, Callable[[int], Float]]:
    """Functions of the chip number that return Legendre coefficients (n, 2, K), by part name."""
    model, mean = solution.model, np.asarray(solution.mean, float)

    def static(chip: int) -> Float:
        slices = [model.coefficient_slice(chip, axis) for axis in (0, 1)]
        return np.stack([theta[rows, s] - mean[s] for s in slices], axis=1)

    def drift(chip: int) -> Float:
        with_drift = polynomial_errors(model, mean, theta, epoch=epoch, chip=chip, rows=rows)
        return with_drift - static(chip)

    def frame(exposure: Int, chip: int) -> Float:
        out = np.empty((len(rows), 2, model.n_terms))
        for e in np.unique(exposure):
            draws, block = np.flatnonzero(exposure == e), model.frame_slice(int(e))
            only = np.tile(mean, (len(draws), 1))
            only[:, block] = theta[rows[draws], block]
            out[draws] = polynomial_errors(
                model, mean, only, epoch=epoch, chip=chip, exposure=int(e)
            )
        return out

    out: dict[str, Callable[[int], Float]] = {COEFFICIENTS: static}
    if model.time is not None:
        out[TIME_DEPENDENCE] = drift
    if exposure is not None:
        out[EXPOSURE_FRAME] = partial(frame, exposure)
    return out
