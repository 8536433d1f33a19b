"""Errors of the parameters of a solution, split into parts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.terms.forms import (
    Image,
    PolynomialField,
    Polynomials,
    Pool,
    Row,
    TogetherField,
    polynomial_errors,
)
from bayesdist.assess.terms.parameters import CatalogueErrors
from bayesdist.infer.solution.solution import Solution
from bayesdist.utils.arrays import Float, Int

COEFFICIENTS = "coefficients"
TIME_DEPENDENCE = "time dependence"
EXPOSURE_FRAME = "exposure frame"


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
        """Draws of the solution, and of the rows that are only shown."""
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
