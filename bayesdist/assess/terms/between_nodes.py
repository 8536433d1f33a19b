"""Term of the budget for what look-up tables leave between their nodes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms import MEASURED
from bayesdist.assess.terms.local import LocalErrors
from bayesdist.diagnose.tables.between_nodes import BetweenNodes
from bayesdist.diagnose.tables.mean_square import MeanSquare
from bayesdist.infer.solution import Solution
from bayesdist.model.grid import grid_pixels, mesh

__all__ = ["INTERPOLATION", "interpolation_term"]

INTERPOLATION = "look-up tables, between nodes"
SOURCE = f"{MEASURED}: neighbours in different exposures"


def interpolation_term(
    between: Mapping[int, BetweenNodes],
    solution: Solution,
    *,
    grid: tuple[int, int],
    epoch: float | None,
) -> tuple[LocalErrors, ...]:
    """The term of the budget; nothing where a chip has not been measured.

    Parameters
    ----------
    between : mapping of int to BetweenNodes
        By chip number.
    solution : Solution
        Its derivatives bring pixels to u and v, along the axes of the polynomials.
    grid : tuple of int
        Points on x and y of each chip.
    epoch : float or None
        Decimal years.
    """
    chips = solution.model.chips
    if not between or any(chip.number not in between for chip in chips):
        return ()
    sigma, squares = {}, {}
    for chip in chips:
        place = place_of(solution.model, epoch=epoch, chip=chip.number)
        P = place.polynomial(solution.mean)
        by_x, by_y = place.gradient(*mesh(*grid_pixels(chip.size, grid)))
        J = np.stack([by_x @ P.T, by_y @ P.T], axis=-1)
        found, into = between[chip.number], np.mean(J**2, axis=0)
        variance = J**2 @ found.left.mean
        sigma[chip.number] = np.sqrt(variance).reshape(grid[1], grid[0], 2)
        error = np.sqrt(into**2 @ found.error**2)
        squares[chip.number] = MeanSquare(into @ found.square, error)
    return (LocalErrors.on_grid(INTERPOLATION, sigma, solution.model, SOURCE, squares),)
