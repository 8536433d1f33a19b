"""Errors of parameters: of the catalogue, of a new exposure, of scale and orientation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms import (
    GIVEN,
    MEASURED,
    ErrorDraws,
    ErrorTerm,
    Polynomials,
    Pool,
    Row,
    Together,
)
from bayesdist.errors import InputError, require_known
from bayesdist.infer.catalogue.star_errors import StarCovariance
from bayesdist.infer.solution.solution import Solution
from bayesdist.mission import load_object, missions
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int

CATALOGUE = "reference catalogue (shared stars)"
MOTIONS = "proper motions (shared stars)"
EXPOSURE_SCATTER = "exposure-to-exposure variation"
ABERRATION = "velocity aberration"


@dataclass(frozen=True, eq=False)
class CatalogueErrors:
    """Effect of the errors of the reference catalogue on polynomials and drift.

    A star has one error in however many exposures it is matched.  The solution that is assessed
    has this error; the one without it took the catalogue's errors for independent from match to
    match, and shows the rows of the budget beside this one.  So what independent errors of the
    catalogue would do stands in those rows, and all of what the true ones do in this row: the
    squares of the rows add up to more than the total, which is drawn from the solution.
    """

    model: DistortionModel
    mean: Float  # (D,), of its parameters
    # (D, D), of the error of its parameters that the catalogue causes: `total` of a
    # `StarCovariance`, or its part for the positions, and the one for the motions in a term of its
    # own
    covariance: Float
    name: str = CATALOGUE
    source: str = GIVEN  # where the errors of the catalogue come from

    @property
    def rows(self) -> tuple[Row, ...]:
        """A row that the solution holds already."""
        return (Row(self.name, source=self.source, in_total=False),)

    def draw(self, n: int, rng: np.random.Generator) -> Polynomials:
        """Draws of the error from N(0, covariance)."""
        mean, D = np.asarray(self.mean, float), self.model.n_distortion
        # scales of units and sizes apart, a sum of squares: eigenvalues below 0 are rounding
        scale = np.sqrt(np.diag(self.covariance)[:D])
        scale = np.where(scale > 0, scale, 1.0)
        values, vectors = np.linalg.eigh(self.covariance[:D, :D] / np.outer(scale, scale))
        # the symmetric root: signs and order of eigenvectors do not change the draws
        root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
        theta = np.tile(mean[: self.model.n_global], (n, 1))
        theta[:, :D] += scale * (rng.standard_normal((n, D)) @ root)
        return Polynomials(self.rows[0], self.model, mean, theta)


def catalogue_terms(
    solution: Solution, stars: StarCovariance, catalogue: str
) -> tuple[CatalogueErrors, ...]:
    """Terms of the errors of a catalogue: of its positions, and of its motions where it has some.

    `solution`: that takes them for independent. `catalogue`: name of the file that states the
    errors.
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

    Velocity aberration that is left out, or known only as far as the header knows the spacecraft's
    velocity, is an error of the scale: VAFACTOR differs from 1 by up to 1e-4.

    InputError for an unknown kind, or a sigma that is negative or not finite.
    """

    name: str
    kind: str  # 'scale' or 'rotation'
    sigma: float  # standard deviation: relative, or in radians
    solution: Solution  # whose positions it moves
    source: str = GIVEN
    in_total: bool = True  # False where another row holds this error

    def __post_init__(self) -> None:
        where = f"budget term {self.name!r}"
        require_known(self.kind, ("scale", "rotation"), "kind", where=where)
        if not (math.isfinite(self.sigma) and self.sigma >= 0):
            raise InputError(
                f"sigma is {self.sigma}", where=where, do="give a number that is not negative"
            )

    @property
    def rows(self) -> tuple[Row, ...]:
        """One row."""
        return (Row(self.name, source=self.source, in_total=self.in_total),)

    def draw(self, n: int, rng: np.random.Generator) -> Polynomials:
        """Draws of the error: one number for the whole image."""
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
        sizes, known = self.sigma * rng.standard_normal((n, 1)), slice(model.n_global)
        return Polynomials(self.rows[0], model, mean, mean[known] + sizes * moved[known])


# terms that a row of the configuration with one sigma makes, by its kind
ONE_SIZE: dict[str, Callable[..., ErrorTerm]] = {"scale": ScaleError, "rotation": ScaleError}


def one_size_kinds() -> tuple[str, ...]:
    """Kinds of error terms that have one size, those that missions add among them."""
    return (*ONE_SIZE, *(kind for one in missions().values() for kind in one.error_terms))


def one_size_term(name: str, kind: str, sigma: float, solution: Solution, source: str) -> ErrorTerm:
    """Error term of a kind; parameters as of `ScaleError`."""
    added = {kind: path for one in missions().values() for kind, path in one.error_terms.items()}
    make = ONE_SIZE[kind] if kind in ONE_SIZE else load_object(added[kind])
    return make(name, kind, sigma, solution, source)


@dataclass(frozen=True, eq=False)
class ExposureVariation:
    """Deviation of a new exposure from the polynomials that all exposures have in common."""

    # with frames in gauge 'held', in which exposures deviate from the polynomials
    model: DistortionModel
    mean: Float  # (D,), of its parameters
    # (k,), deviations that scatter, named as an exposure's parameters: 'scale', 'shear_plus', ...
    kinds: tuple[str, ...]
    tau: Float  # (m, k), draws of the scatter of each kind
    # what of it is known to be velocity aberration: shown beside, as this scatter holds it
    aberration: ScaleError | None = None
    name: str = EXPOSURE_SCATTER
    source: str = MEASURED

    @property
    def _exposure(self) -> int:
        """The exposure whose place a new one takes: any, as its own deviations are put to zero."""
        return len(self.model.exposures) - 1

    @property
    def rows(self) -> tuple[Row, ...]:
        """The scatter, and what of it is aberration."""
        own = Row(self.name, source=self.source)
        return (own,) if self.aberration is None else (own, *self.aberration.rows)

    def draw(self, n: int, rng: np.random.Generator) -> ErrorDraws:
        """Draws of deviations, each from a normal distribution with a scatter of its own."""
        return self.of_rows(rng.integers(len(self.tau), size=n), rng)

    def of_rows(self, rows: Int, rng: np.random.Generator) -> ErrorDraws:
        """Draws (n,) of deviations, whose scatters are draws by their numbers."""
        known = self.model.free_frame_names(self._exposure)
        first = self.model.frame_slice(self._exposure).start
        at = [first + known.index(kind) for kind in self.kinds]
        mean = np.array(self.mean, float)
        mean[at] = 0.0
        theta = np.tile(mean, (len(rows), 1))
        tau = self.tau[rows]
        theta[:, at] = tau * rng.standard_normal(tau.shape)
        pools = (Pool(rows, len(self.tau)),)
        own = Polynomials(self.rows[0], self.model, mean, theta, self._exposure, pools=pools)
        if self.aberration is None:
            return own
        return Together((own, self.aberration.draw(len(rows), rng)))
