"""Error terms for correlated errors that remain after a calibration.

Structure that the model omits, deviations of exposures, and curvature of a drift displace many
stars together, so that they do not average out. Local errors, such as those of a look-up table, are
shared by all stars near a position and vary over the detector.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms import (
    LOCAL,
    MEASURED,
    ErrorDraws,
    Image,
    Independent,
    Pool,
    Row,
    Together,
)
from bayesdist.assess.terms.functions import Functions, Polynomials
from bayesdist.diagnose.correlated import Discrepancy
from bayesdist.diagnose.correlated.deviations import LinearDeviations
from bayesdist.diagnose.tables import BetweenNodes, MeanSquare
from bayesdist.errors import InputError, required
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import DistortionModel, LookupTable
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.utils.arrays import Float, Int

STRUCTURE = "unmodelled structure"
STRUCTURE_IN_FIT = "unmodelled structure in coefficients"
DEVIATIONS = "unmodelled exposure-to-exposure variation"
FIELDS = "unmodelled fields of exposures"
FIELDS_IN_FIT = "unmodelled fields of exposures in coefficients"
SOURCE = f"{MEASURED}, with a prior on its size"
INTERPOLATION = "look-up tables, between nodes"
MEASURED_BY_NEIGHBOURS = f"{MEASURED}: neighbours in different exposures"


@dataclass(frozen=True, eq=False)
class StructureErrors:
    """Structure that the model omits, and the error of the parameters that were biased by it.

    The fit was drawn towards the structure, so the two errors are correlated: row k of both is draw
    k of the posterior. The row of the omitted structure is the excess of their joint error over the
    error of the parameters.
    """

    discrepancy: Discrepancy
    frames: bool = False  # True to include errors of the exposure frames
    # True to include structure omitted at a position; False if look-up table errors represent it
    left: bool = True
    # True if the residuals do not tell whether structure is the detector's or the catalogue's
    ambiguous: bool = False
    of_catalogue: bool = False  # True for a structure of the catalogue, which the parameters follow

    @property
    def rows(self) -> tuple[Row, ...]:
        """Rows of the part in the parameters and, with `left`, of the omitted structure."""
        in_fit = Row(STRUCTURE_IN_FIT, source=SOURCE)
        return (in_fit, Row(STRUCTURE, LOCAL, SOURCE)) if self.left else (in_fit,)

    @property
    def alternative(self) -> StructureErrors | None:
        """The same structure as an error of the catalogue; None unless its origin is ambiguous."""
        if not self.ambiguous:
            return None
        return replace(self, left=False, ambiguous=False, of_catalogue=True)

    def draw(self, n: int, rng: np.random.Generator) -> ErrorDraws:
        """First n draws of the posterior, repeated if n is larger."""
        discrepancy, shift = self.discrepancy, self.discrepancy.structure_theta
        if self.of_catalogue:
            shift = discrepancy.structure_of_catalogue()
        rows = np.arange(n) % len(shift)
        theta, pool = _moved(discrepancy, shift[rows], self.frames), Pool(rows, len(shift))
        fit = Polynomials(
            self.rows[0],
            discrepancy.model,
            discrepancy.mean,
            theta,
            frames=self.frames,
            pools=(pool,),
        )
        if not self.left:
            return fit
        coefficients: dict[int | None, NDArray[np.floating]] = {
            chip: structure.coefficients for chip, structure in discrepancy.structure.items()
        }
        omitted = Functions(self.rows[1], coefficients, partial(_functions, discrepancy), n)
        return Together((fit, omitted), remainder=True)

    def sigma(self, domain: EvaluationDomain) -> Float:
        """Standard deviations (N, 2) of the omitted structure, in the unit of u and v."""
        draws = self.draw(self.discrepancy.n_draws, np.random.default_rng(0))
        exposure = None
        if self.frames:
            fitted = [e for e, _ in enumerate(domain.model.exposures)]
            fitted = [e for e in fitted if domain.model.free_frame_names(e)]
            # draws are in random order, so an exposure can be assigned by the draw number
            if fitted:
                exposure = np.array(fitted)[np.arange(self.discrepancy.n_draws) % len(fitted)]
        return np.sqrt(draws.on(domain, Image(exposure)).squares()[STRUCTURE])


@dataclass(frozen=True, eq=False)
class Deviations:
    """Error due to deviations of single exposures and to curvature of the drift."""

    discrepancy: Discrepancy  # must have `linear`
    # True for a position in a single future exposure, with the deviation of that exposure; False
    # for a position in the mean of the exposures
    single: bool = False
    frames: bool = False  # see `StructureErrors`

    @property
    def rows(self) -> tuple[Row, ...]:
        """Row of the deviations."""
        return (Row(DEVIATIONS, source=SOURCE),)

    def draw(self, n: int, rng: np.random.Generator) -> Polynomials:
        """Draws in random order, because they are independent of other terms."""
        linear = required(self.discrepancy.linear, "no deviations of exposures were estimated")
        rows = rng.integers(len(linear.theta), size=n)
        return self.of_rows(rows, int(rng.integers(2**63)) if self.single else None)

    def of_rows(self, rows: Int, seed: int | None) -> Polynomials:
        """Draws of the posterior with the given numbers, shape (n,), and new exposure deviations.

        `seed`: seed of the deviations of single exposures; None to omit them.
        """
        discrepancy = self.discrepancy
        linear = required(discrepancy.linear, "no deviations of exposures were estimated")
        theta = _moved(discrepancy, linear.theta[rows], self.frames)
        bending = partial(_bending, linear, np.asarray(discrepancy.mean, float), rows, seed)
        pools = [Pool(rows, len(linear.theta))]
        if seed is not None:  # the deviations are new in each set of draws
            pools.append(Pool(rows, len(linear.theta), renewed=True))
        return Polynomials(
            self.rows[0],
            discrepancy.model,
            discrepancy.mean,
            theta,
            frames=self.frames,
            more=bending,
            pools=tuple(pools),
        )


@dataclass(frozen=True, eq=False)
class FieldsOfExposures:
    """Error due to second-order terms and smooth fields that vary between exposures.

    The parameters follow the mean of these fields over the exposures. A position in a single
    future exposure has the error of the field of that exposure in addition.
    """

    discrepancy: Discrepancy  # must have `fields`
    single: bool = False  # see `Deviations`
    frames: bool = False  # see `StructureErrors`

    @property
    def rows(self) -> tuple[Row, ...]:
        """Rows of the part in the parameters and, with `single`, of the field of the exposure."""
        in_fit = Row(FIELDS_IN_FIT, source=SOURCE)
        return (in_fit, Row(FIELDS, source=SOURCE)) if self.single else (in_fit,)

    def draw(self, n: int, rng: np.random.Generator) -> ErrorDraws:
        """Draws in random order, because they are independent of other terms."""
        fields = required(self.discrepancy.fields, "no fields of exposures were estimated")
        return self.of_rows(rng.integers(len(fields.theta), size=n), rng)

    def of_rows(self, rows: Int, rng: np.random.Generator) -> ErrorDraws:
        """Effect on the parameters, for the posterior draws with the given numbers, shape (n,).

        With `self.single`, fields of single exposures are added, for the posterior draws in order.
        """
        discrepancy, n = self.discrepancy, len(rows)
        fields = required(discrepancy.fields, "no fields of exposures were estimated")
        theta = _moved(discrepancy, fields.theta[rows], self.frames)
        fit = Polynomials(
            self.rows[0], discrepancy.model, discrepancy.mean, theta, frames=self.frames
        )
        if not self.single:
            return fit
        coefficients: dict[int | None, NDArray[np.floating]] = {
            chip.number: fields.coefficients(chip, rng) for chip in discrepancy.model.chips
        }
        waves = {
            chip.number: fields.functions(chip).finer_waves(rng) for chip in discrepancy.model.chips
        }
        field = Functions(self.rows[1], coefficients, partial(_of_exposure, discrepancy, waves), n)
        return Together((fit, field))


def _of_exposure(
    discrepancy: Discrepancy, waves: dict[int, Float], number: int, x: Float, y: Float
) -> NDArray[np.floating]:
    """Values (N, m) of the functions of the field of an exposure on a chip."""
    model = discrepancy.model
    fields = required(discrepancy.fields, "no fields of exposures were estimated")
    chip = model.chips[model.chip_code(number)]
    return fields.evaluate(chip, waves[number], *model.basis(number).scaled(x, y))


def _bending(
    linear: LinearDeviations,
    mean: Float,
    rows: Int,
    seed: int | None,
    epoch: float | None,
    chip: int,
) -> Float:
    """Curvature of the drift (n, 2, K); with a seed, plus the deviation of a new exposure."""
    out = linear.polynomials(epoch, chip)[rows]
    if seed is None:
        return out
    # an exposure has the same deviation on all chips and at all epochs
    single = linear.of_single_exposures(mean, chip, np.random.default_rng(seed), epoch)
    return out + single[rows]


def _moved(discrepancy: Discrepancy, shift: Float, frames: bool) -> Float:
    """Mean parameters plus shifts: all (n, D), or without frames only polynomials and drift."""
    mean, model = discrepancy.mean, discrepancy.model
    D, n_moved = (len(mean), len(mean)) if frames else (model.n_distortion, model.n_global)
    theta = np.tile(mean[:n_moved], (len(shift), 1))
    theta[:, :D] += shift[:, :D]
    return theta


def _functions(discrepancy: Discrepancy, chip: int, x: Float, y: Float) -> NDArray[np.floating]:
    """Values (N, m) of the functions of the structure on a chip."""
    return discrepancy.structure[chip].evaluate(*discrepancy.model.basis(chip).scaled(x, y))


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
        """Term from standard deviations (ny, nx, 2) on a grid of each chip, by chip number.

        `source` describes their origin, and `squares` are the measured mean squares by chip, if
        known.
        """
        sizes = {chip.number: chip.size for chip in model.chips}
        tables = {chip: table_of(chip, sizes[chip], np.asarray(s)) for chip, s in sigma.items()}
        return cls(name, tables, source, squares or {})

    @property
    def rows(self) -> tuple[Row, ...]:
        """Row of the local error."""
        return (Row(self.name, LOCAL, self.source),)

    def draw(self, n: int, rng: np.random.Generator) -> Independent:
        """Draw independent errors and their sizes.

        Sizes are drawn independently for each chip and axis.
        """
        relative_errors = {chip: square.relative_error for chip, square in self.squares.items()}
        sizes = {chip: square.relative_draws(n, rng) for chip, square in self.squares.items()}
        return Independent(self.rows[0], self.sigma, sizes, relative_errors)

    def sigma(self, domain: EvaluationDomain) -> Float:
        """Standard deviations (N, 2) in the unit of u and v, interpolated from the tables.

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
    return (
        LocalErrors.on_grid(INTERPOLATION, sigma, solution.model, MEASURED_BY_NEIGHBOURS, squares),
    )
