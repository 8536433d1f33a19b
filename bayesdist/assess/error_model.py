"""Everything that moves a position: a solution, and terms that are independent of each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesdist.assess.budget.budget import ErrorBudget, budget_of
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.solution import Solution
from bayesdist.assess.terms.forms import ErrorTerm, Image
from bayesdist.assess.terms.given import Centroids, UserTerm
from bayesdist.assess.terms.seeds import generators
from bayesdist.assess.terms.solution import SolutionErrors
from bayesdist.assess.units import pixel_scale_of
from bayesdist.errors import InputError

__all__ = ["ErrorModel", "error_model"]


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """What the error of a position is made of.

    Parameters
    ----------
    solution : SolutionErrors
        Errors of the parameters, from draws of a solution.
    terms : tuple of ErrorTerm
        Independent of the solution and of each other, in its unit.
    aligned : bool
        Whether the star lies in a new exposure whose shift and rotation the observer fits: no frame
        of the solution is in the error then, and what a shift and a rotation of all chips together
        take up is no error.  Terms that are no polynomials stay as they are.
    """

    solution: SolutionErrors
    terms: tuple[ErrorTerm, ...] = ()
    aligned: bool = False

    def drawn(self, n: int, rng: np.random.Generator) -> DrawnErrors:
        """Draws of all errors.

        A star is taken to lie in an exposure chosen at random, for each draw, among those whose
        frame was fitted, and its error is given along the axes of the polynomials.

        Parameters
        ----------
        n : int
        rng : numpy.random.Generator

        Raises
        ------
        InputError
            For fewer than two draws.
        """
        if n < 2:
            raise InputError(f"the number of draws is {n}", do="ask for at least 2")
        one = self.solution.draw(n, rng)
        solution, fitted = self.solution.solution, self.solution.fitted_exposures
        image = Image()
        if self.aligned:
            image = Image(aligned_by=np.asarray(solution.mean, float))
        elif fitted:
            image = Image(rng.integers(fitted[0], len(solution.model.exposures), size=n))
        seed = int(rng.integers(2**63))
        draws = [
            term.draw(n, own)
            for term, own in zip(self.terms, generators(self.terms, seed), strict=True)
        ]
        return DrawnErrors(solution, (self.solution, *self.terms), (one, *draws), image, n, seed)

    def at(
        self, domain: EvaluationDomain, *, n: int = 4000, rng: np.random.Generator
    ) -> ErrorBudget:
        """The error budget of positions, or of their differences.

        Parameters
        ----------
        domain : EvaluationDomain
        n : int
            Draws.
        rng : numpy.random.Generator
        """
        return budget_of(self.drawn(n, rng), domain)


def error_model(
    solution: Solution,
    terms: Sequence[ErrorTerm] = (),
    *,
    aligned: bool = False,
    pixel_scale: float | None = None,
) -> ErrorModel:
    """The error model of a solution.

    Parameters
    ----------
    solution : LinearFit or Posterior
    terms : sequence of ErrorTerm
        A `SolutionErrors` among them says what of the solution's errors is shown by itself.
    aligned : bool
        As of `ErrorModel`.
    pixel_scale : float, optional
        Size of one pixel in mas; `pixel_scale_of` the solution by default.

    Returns
    -------
    ErrorModel

    Raises
    ------
    InputError
        For a term whose unit needs a pixel scale that is not known.
    """
    if pixel_scale is None:
        pixel_scale = pixel_scale_of(solution)
    of_solution, others = SolutionErrors(solution), list[ErrorTerm]()
    for term in terms:
        if isinstance(term, SolutionErrors):
            of_solution = replace(term, solution=solution)
        elif isinstance(term, UserTerm):
            others.append(term.in_unit(solution.model.unit, pixel_scale))
        else:
            others.append(term)
    if not any(isinstance(term, Centroids) for term in others):
        others.append(Centroids(None))  # a domain that names a magnitude asks for it
    return ErrorModel(of_solution, tuple(others), aligned)
