"""Error terms for correlated errors that remain after a calibration."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.terms.forms import (
    LOCAL,
    MEASURED,
    ErrorDraws,
    Functions,
    Image,
    Polynomials,
    Pool,
    Row,
    Together,
)
from bayesdist.diagnose.correlated import Discrepancy
from bayesdist.diagnose.correlated.deviations import LinearDeviations
from bayesdist.errors import required
from bayesdist.utils.arrays import Float, Int

STRUCTURE = "unmodelled structure"
STRUCTURE_IN_FIT = "unmodelled structure in coefficients"
DEVIATIONS = "unmodelled exposure-to-exposure variation"
FIELDS = "unmodelled fields of exposures"
FIELDS_IN_FIT = "unmodelled fields of exposures in coefficients"
SOURCE = f"{MEASURED}, with a prior on its size"


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

    @property
    def rows(self) -> tuple[Row, ...]:
        """Rows of the part in the parameters and, with `left`, of the omitted structure."""
        in_fit = Row(STRUCTURE_IN_FIT, source=SOURCE)
        return (in_fit, Row(STRUCTURE, LOCAL, SOURCE)) if self.left else (in_fit,)

    def draw(self, n: int, rng: np.random.Generator) -> ErrorDraws:
        """First n draws of the posterior, repeated if n is larger."""
        discrepancy, shift = self.discrepancy, self.discrepancy.structure_theta
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
        """Standard deviations (N, 2) of the omitted structure, over all draws."""
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
        """A single row."""
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

        With `single`, fields of single exposures are added, for the posterior draws in order.
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
    return out + linear.of_single_exposures(mean, chip, np.random.default_rng(seed))[rows]


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
