"""Errors of the parameters of a solution, part by part."""

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
    """Draws of a solution less its mean: of its coefficients, its drift, and a frame.

    The parts add up to the joint error (to first order) along the axes of the polynomials, however
    the field turned between exposures.  They are correlated.
    """

    solution: Solution
    # the solution that lacks the errors of the catalogue, and shows the rows of the parts
    without: Solution | None = None
    # what the errors of the catalogue do, which the solution's draws hold: shown beside
    catalogue: tuple[CatalogueErrors, ...] = ()

    @property
    def fitted_exposures(self) -> list[int]:
        """Codes of the exposures whose frame was fitted."""
        model = self.solution.model
        return [e for e in range(len(model.exposures)) if model.free_frame_names(e)]

    @property
    def rows(self) -> tuple[Row, ...]:
        """Coefficients, drift and frame as far as the model has them, and the catalogue's."""
        names = [COEFFICIENTS]
        if self.solution.model.time is not None:
            names.append(TIME_DEPENDENCE)
        if self.fitted_exposures:
            names.append(EXPOSURE_FRAME)
        return (*(Row(name) for name in names), *(r for c in self.catalogue for r in c.rows))

    def draw(self, n: int, rng: np.random.Generator) -> SolutionDraws:
        """Draws of the solution, and of what is shown beside them."""
        joint = shown = self.solution.drawn_rows(n, rng)
        (own,) = rng.spawn(1)  # what is shown beside changes nothing of what follows
        if self.without is not None:
            shown = self.without.drawn_rows(n, own)
        return SolutionDraws(self, joint, shown, tuple(c.draw(n, own) for c in self.catalogue))


@dataclass(frozen=True, eq=False)
class SolutionDraws:
    """Draws of the parameters, as of `drawn_rows`: of the joint error, and of its parts shown."""

    of: SolutionErrors
    joint: tuple[Float, Int]
    shown: tuple[Float, Int]
    catalogue: tuple[Polynomials, ...] = ()

    @property
    def pools(self) -> tuple[Pool, ...]:
        """The stored draws of a sampler; nothing for a fit, each draw of which is a new one.

        They are worth the smaller of the bulk and tail effective sample sizes, as a probability far
        from a half is a matter of the tails.
        """
        convergence = self.of.solution.convergence
        if convergence is None:
            return ()
        sizes = [convergence.ess_bulk_min, convergence.ess_tail_min]
        ess = 1.0 if any(math.isnan(size) for size in sizes) else max(min(sizes), 1.0)
        theta, rows = self.joint
        # draws that were transformed one by one do not say which of the sampler's they are
        anonymous = len(theta) == len(rows) and np.array_equal(rows, np.arange(len(rows)))
        return (Pool(None if anonymous else rows, ess),)

    def on(self, domain: EvaluationDomain, image: Image) -> TogetherField:
        """The errors at the positions of a domain."""
        exact, shown = self.of.without is None, self.of.without or self.of.solution
        parts = _parts(shown, *self.shown, domain.epoch, image.exposure)
        fields = [
            # rows of another solution cannot be taken off the draws of this one
            PolynomialField.of((Row(name, in_total=exact),), domain, image, of)
            for name, of in parts.items()
            if name
        ]
        model, mean = self.of.solution.model, np.asarray(self.of.solution.mean, float)
        theta, rows = self.joint

        def joint(chip: int) -> Float:
            at, e = domain.epoch, image.exposure
            return polynomial_errors(model, mean, theta, epoch=at, chip=chip, exposure=e, rows=rows)

        whole = PolynomialField.of((), domain, image, joint)
        fields += [c.on(domain, image) for c in self.catalogue]
        return TogetherField.of(domain, tuple(fields), whole)


def _parts(
    solution: Solution, theta: Float, rows: Int, epoch: float | None, exposure: Int | None
) -> dict[str, Callable[[int], Float]]:
    """By name of the part, its Legendre coefficients (n, 2, K) by chip number."""
    model, mean = solution.model, np.asarray(solution.mean, float)

    def static(chip: int) -> Float:
        slices = [model.coefficient_slice(chip, axis) for axis in (0, 1)]
        return np.stack([theta[rows, s] - mean[s] for s in slices], axis=1)

    def drift(chip: int) -> Float:
        whole = polynomial_errors(model, mean, theta, epoch=epoch, chip=chip, rows=rows)
        return whole - static(chip)

    def frame(exposure: Int, chip: int) -> Float:
        out = np.empty((len(rows), 2, model.n_terms))
        for e in np.unique(exposure):
            own, block = np.flatnonzero(exposure == e), model.frame_slice(int(e))
            only = np.tile(mean, (len(own), 1))
            only[:, block] = theta[rows[own], block]
            out[own] = polynomial_errors(model, mean, only, epoch=epoch, chip=chip, exposure=int(e))
        return out

    out: dict[str, Callable[[int], Float]] = {COEFFICIENTS: static}
    if model.time is not None:
        out[TIME_DEPENDENCE] = drift
    if exposure is not None:
        out[EXPOSURE_FRAME] = partial(frame, exposure)
    return out
