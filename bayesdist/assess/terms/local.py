"""Errors that all stars near a position share, and that differ from place to place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms import LOCAL, MEASURED, Independent, Row
from bayesdist.diagnose.tables.between_nodes import BetweenNodes, MeanSquare
from bayesdist.errors import InputError
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import DistortionModel, LookupTable
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.utils.arrays import Float

INTERPOLATION = "look-up tables, between nodes"
SOURCE = f"{MEASURED}: neighbours in different exposures"


def table_of(chip: int, size: tuple[float, float], values: Float) -> LookupTable:
    """A table of values (ny, nx, 2) on the grid of a chip."""
    ny, nx = values.shape[:2]
    x, y = grid_pixels(size, (nx, ny))
    step = (float(x[1] - x[0]), float(y[1] - y[0]))
    return LookupTable(chip, np.moveaxis(values, 2, 0), first=(float(x[0]), float(y[0])), step=step)


@dataclass(frozen=True, eq=False)
class LocalErrors:
    """A Gaussian error that all stars at a position have in common.

    Such is the error of a look-up table: its nodes are closer than positions at which errors are
    evaluated, and there the errors count as independent.

    Parameters
    ----------
    name : str
    tables : mapping of int to LookupTable
        By chip number: standard deviations of u and v, in the unit of the solution.
    source : str
    squares : mapping of int to MeanSquare
        By chip number: how well their mean squares are known themselves, where that is known.
    """

    name: str
    tables: Mapping[int, LookupTable]
    source: str = MEASURED
    squares: Mapping[int, MeanSquare] = field(default_factory=dict)

    @classmethod
    def on_grid(
        cls,
        name: str,
        sigma: Mapping[int, Float],
        model: DistortionModel,
        source: str = MEASURED,
        squares: Mapping[int, MeanSquare] | None = None,
    ) -> LocalErrors:
        """Standard deviations (ny, nx, 2) on a grid of each chip, by its number."""
        sizes = {chip.number: chip.size for chip in model.chips}
        tables = {chip: table_of(chip, sizes[chip], np.asarray(s)) for chip, s in sigma.items()}
        return cls(name, tables, source, squares or {})

    @property
    def rows(self) -> tuple[Row, ...]:
        """One row."""
        return (Row(self.name, LOCAL, self.source),)

    def draw(self, n: int, rng: np.random.Generator) -> Independent:
        """Independent errors, each chip and axis as large as it may be.

        What is known of one chip or axis says nothing of the others.
        """
        known = {chip: one.relative_error for chip, one in self.squares.items()}
        sizes = {chip: one.relative_draws(n, rng) for chip, one in self.squares.items()}
        return Independent(self.rows[0], self.sigma, sizes, known)

    def sigma(self, domain: EvaluationDomain) -> Float:
        """Standard deviations (N, 2), interpolated between the nodes of the tables.

        Raises
        ------
        InputError
            For a chip without values.
        """
        parts = []
        for chip, rows in domain.by_chip():
            if chip not in self.tables:
                raise InputError(
                    f"is not known on chip {chip}",
                    where=f"budget term {self.name!r}",
                    do="name one of its chips",
                )
            parts.append(self.tables[chip].evaluate(domain.x[rows], domain.y[rows]))
        return np.concatenate(parts)


def interpolation_term(
    between: Mapping[int, BetweenNodes],
    solution: Solution,
    *,
    grid: tuple[int, int],
    epoch: float | None,
) -> tuple[LocalErrors, ...]:
    """The term of the budget; nothing where a chip has not been measured.

    `between`: by chip number. `solution`: its derivatives bring pixels to u and v, along the axes
    of the polynomials. `grid`: points on x and y of each chip. `epoch`: decimal years.
    """
    chips = solution.model.chips
    if not between or any(chip.number not in between for chip in chips):
        return ()
    sigma, squares = {}, {}
    for chip in chips:
        place = place_of(solution.model, epoch=epoch, chip=chip.number)
        P = place.polynomial(solution.mean)
        by_x, by_y = place.basis.gradient(*mesh(*grid_pixels(chip.size, grid)))
        J = np.stack([by_x @ P.T, by_y @ P.T], axis=-1)
        found, into = between[chip.number], np.mean(J**2, axis=0)
        variance = J**2 @ found.left.mean
        sigma[chip.number] = np.sqrt(variance).reshape(grid[1], grid[0], 2)
        error = np.sqrt(into**2 @ found.error**2)
        squares[chip.number] = MeanSquare(into @ found.square, error)
    return (LocalErrors.on_grid(INTERPOLATION, sigma, solution.model, SOURCE, squares),)
