"""Error budgets over the grid of a chip, or of all chips."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesdist.assess.budget.budget import ErrorBudget
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.error_model import error_model
from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms import ErrorTerm
from bayesdist.assess.units import pixel_scale_of
from bayesdist.infer.solution import Solution
from bayesdist.model.grid import DEFAULT_GRID

__all__ = ["detector_budget", "error_budget"]


def error_budget(
    solution: Solution,
    *,
    terms: Sequence[ErrorTerm] = (),
    aligned: bool = False,
    grid: tuple[int, int] = DEFAULT_GRID,
    epoch: float | None = None,
    chip: int | None = None,
    n_draws: int = 4000,
    rng: np.random.Generator,
    pixel_scale: float | None = None,
) -> ErrorBudget:
    """The error budget of a solution over a grid on a chip, at an epoch.

    The parts of the model are combined by joint draws, for they are correlated; other terms are
    independent and added in quadrature.

    Parameters
    ----------
    solution : LinearFit or Posterior
    terms : sequence of ErrorTerm
        Of the user, and others; each gives one row or more.
    aligned : bool
        Whether shift and rotation of the exposure are the observer's to fit, as of `ErrorModel`.
    grid : tuple of int
        Points on x and y.
    epoch : float, optional
        Decimal years; needed by a model with time dependence.
    chip : int, optional
        Chip number; the first chip by default.
    n_draws : int
    rng : numpy.random.Generator
    pixel_scale : float, optional
        Size of one pixel in mas; `pixel_scale_of` the solution by default.

    Returns
    -------
    ErrorBudget
        In the unit of u, v.

    Raises
    ------
    InputError
        For an unknown chip, a missing epoch, a bad grid, fewer than two draws, or a term whose unit
        needs a pixel scale that is not known.
    """
    return detector_budget(
        solution,
        terms=terms,
        aligned=aligned,
        grid=grid,
        epoch=epoch,
        chips=(place_of(solution.model, epoch=epoch, chip=chip).chip.number,),
        n_draws=n_draws,
        rng=rng,
        pixel_scale=pixel_scale,
    )


def detector_budget(
    solution: Solution,
    *,
    terms: Sequence[ErrorTerm] = (),
    aligned: bool = False,
    grid: tuple[int, int] = DEFAULT_GRID,
    epoch: float | None = None,
    chips: Sequence[int] | None = None,
    n_draws: int = 4000,
    rng: np.random.Generator,
    pixel_scale: float | None = None,
) -> ErrorBudget:
    """The error budget of a solution over its chips, the same grid on each.

    `chips`: chip numbers; all by default. `terms`, `aligned`, `grid`, `epoch`, `n_draws`, `rng`,
    `pixel_scale`: as in `error_budget`. The result is in the unit of u, v. InputError as
    `error_budget`.
    """
    if pixel_scale is None:
        pixel_scale = pixel_scale_of(solution, None if chips is None else chips[0])
    domain = EvaluationDomain.of_chips(solution.model, grid, chips=chips, epoch=epoch)
    errors = error_model(solution, terms=terms, aligned=aligned, pixel_scale=pixel_scale)
    return errors.at(domain, n=n_draws, rng=rng)
