"""The error budget of a detector of one or many chips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.budget.budget import ErrorBudget, budget_rows, error_budgets
from bayesdist.assess.solution import Solution
from bayesdist.assess.terms.field_terms import FieldTerm
from bayesdist.assess.terms.given import LocalTerm, UserTerm
from bayesdist.assess.terms.product_terms import ProductTerm
from bayesdist.model.grid import DEFAULT_GRID

__all__ = ["DetectorBudget", "detector_budget"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DetectorBudget:
    """The error budgets of all chips of a detector, from the same draws.

    Parameters
    ----------
    chips : tuple of ErrorBudget
        One for each chip, all with the same terms and the same number of grid points.
    """

    chips: tuple[ErrorBudget, ...]

    @property
    def unit(self) -> str:
        """Unit of all standard deviations."""
        return self.chips[0].unit

    @property
    def epoch(self) -> float | None:
        """Decimal years."""
        return self.chips[0].epoch

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the terms."""
        return tuple(t.name for t in self.chips[0].terms)

    @property
    def share(self) -> Float:
        """Fraction of the grid points of all chips at which each term is the largest."""
        dominant = np.concatenate([b.dominant.ravel() for b in self.chips])
        return np.bincount(dominant, minlength=len(self.names)) / dominant.size

    def rows(self) -> list[dict[str, Any]]:
        """The budget as a table: root mean squares over the grid points of all chips.

        Returns
        -------
        list of dict
            As those of an `ErrorBudget`; one for each term and product, the total last.
        """
        by_term = zip(*((*b.terms, *b.products, b.total) for b in self.chips), strict=True)
        return budget_rows(
            [
                replace(
                    terms[0],
                    u=np.stack([t.u for t in terms]),
                    v=np.stack([t.v for t in terms]),
                )
                for terms in by_term
            ]
        )

    def rows_by_chip(self) -> list[dict[str, Any]]:
        """As `rows`, followed by those of each chip alone; column chip is 'all' or its number."""
        parts = [("all", self.rows()), *((str(b.chip), b.rows()) for b in self.chips)]
        return [{"chip": chip} | row for chip, rows in parts for row in rows]


def detector_budget(
    solution: Solution,
    *,
    terms: Sequence[UserTerm] = (),
    fields: Sequence[FieldTerm] = (),
    aligned: bool = False,
    local: Sequence[LocalTerm] = (),
    products: Sequence[ProductTerm] = (),
    grid: tuple[int, int] = DEFAULT_GRID,
    epoch: float | None = None,
    n_draws: int = 4000,
    rng: np.random.Generator,
    pixel_scale: float | None = None,
) -> DetectorBudget:
    """The error budget of a solution over all of its chips, the same grid on each.

    Parameters
    ----------
    solution : LinearFit or Posterior
    terms : sequence of UserTerm
    fields : sequence of FieldTerm
    aligned : bool
        Whether shift and rotation of the exposure are the observer's to fit, as in `error_fields`.
    local : sequence of LocalTerm
        Measured beside the solution, on this grid.
    products : sequence of ProductTerm
        Shown beside the others, and in no total.
    grid : tuple of int
        Points on x and y of each chip.
    epoch : float, optional
        Decimal years; needed by a model with time dependence.
    n_draws : int
    rng : numpy.random.Generator
    pixel_scale : float, optional
        Size of one pixel in mas; `pixel_scale_of` the solution by default.

    Returns
    -------
    DetectorBudget
        In the unit of u, v.

    Raises
    ------
    InputError
        As `error_budget`.
    """
    return DetectorBudget(
        error_budgets(
            solution,
            tuple(c.number for c in solution.model.chips),
            terms=terms,
            fields=fields,
            aligned=aligned,
            local=local,
            products=products,
            grid=grid,
            epoch=epoch,
            n_draws=n_draws,
            rng=rng,
            pixel_scale=pixel_scale,
        )
    )
