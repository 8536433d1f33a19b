"""Errors that are shared by all stars near a position and vary over the detector."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms import LOCAL, MEASURED, Independent, Row
from bayesdist.diagnose.tables import BetweenNodes, MeanSquare
from bayesdist.errors import InputError
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import DistortionModel, LookupTable
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.utils.arrays import Float

INTERPOLATION = "look-up tables, between nodes"
SOURCE = f"{MEASURED}: neighbours in different exposures"


def table_of(chip: int, size: tuple[float, float], values: Float) -> LookupTable:
    """Look-up table of values (ny, nx, 2) on the grid of a chip."""
    ny, nx = values.shape[:2]
    x, y = grid_pixels(size, (nx, ny))
    step = (float(x[1] - x[0]), float(y[1] - y[0]))
    return LookupTable(chip, np.moveaxis(values, 2, 0), first=(float(x[0]), float(y[0])), step=step)


@dataclass(frozen=True, eq=False)
class LocalErrors:
    """A Gaussian error that is common to all stars at a position.

    An example is the error of a look-up table. Its nodes are closer than the positions at which
    errors are evaluated, so the errors at these positions are treated as independent.

    Parameters
    ----------
    name : str
        Name of the row of the budget.
    tables : mapping of int to LookupTable
        Standard deviations of u and v by chip number, in the unit of the solution.
    source : str
        Origin of the numbers.
    squares : mapping of int to MeanSquare
        Mean squares with their uncertainties by chip number, for chips where these are known.
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
        """Term from standard deviations (ny, nx, 2) on a grid of each chip, by chip number."""
        sizes = {chip.number: chip.size for chip in model.chips}
        tables = {chip: table_of(chip, sizes[chip], np.asarray(s)) for chip, s in sigma.items()}
        return cls(name, tables, source, squares or {})

    @property
    def rows(self) -> tuple[Row, ...]:
        """A single row."""
        return (Row(self.name, LOCAL, self.source),)

    def draw(self, n: int, rng: np.random.Generator) -> Independent:
        """Draw independent errors and their sizes.

        Sizes are drawn independently for each chip and axis.
        """
        relative_errors = {chip: square.relative_error for chip, square in self.squares.items()}
        sizes = {chip: square.relative_draws(n, rng) for chip, square in self.squares.items()}
        return Independent(self.rows[0], self.sigma, sizes, relative_errors)

    def sigma(self, domain: EvaluationDomain) -> Float:
        """Standard deviations (N, 2), interpolated between the nodes of the tables.

        Raises
        ------
        InputError
            If a chip has no table.
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
    """Budget term of interpolation between nodes; empty unless all chips have been measured.

    `between`: interpolation errors by chip number. `solution`: its derivatives convert pixels to u
    and v, along the axes of the polynomials. `grid`: number of points along x and y of each chip.
    `epoch`: decimal years.
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
        interpolation, squared_gradients = between[chip.number], np.mean(J**2, axis=0)
        variance = J**2 @ interpolation.left.mean
        sigma[chip.number] = np.sqrt(variance).reshape(grid[1], grid[0], 2)
        error = np.sqrt(squared_gradients**2 @ interpolation.error**2)
        squares[chip.number] = MeanSquare(squared_gradients @ interpolation.square, error)
    return (LocalErrors.on_grid(INTERPOLATION, sigma, solution.model, SOURCE, squares),)
