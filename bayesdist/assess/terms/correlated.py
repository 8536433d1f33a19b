"""Correlated errors that a calibration leaves, as terms of the error model."""

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
    """Structure that the model leaves out, and the error of the parameters that followed it.

    The fit was drawn towards the structure, so that the two errors are correlated: row k of both is
    draw k of the posterior.  What is left counts as much as both together have beyond the error of
    the parameters.
    """

    discrepancy: Discrepancy
    frames: bool = False  # True if errors of the exposures' frames count
    # True if what is left at a position counts; False where errors of look-up tables stand for it
    left: bool = True

    @property
    def rows(self) -> tuple[Row, ...]:
        """The part in the parameters, and what is left."""
        in_fit = Row(STRUCTURE_IN_FIT, source=SOURCE)
        return (in_fit, Row(STRUCTURE, LOCAL, SOURCE)) if self.left else (in_fit,)

    def draw(self, n: int, rng: np.random.Generator) -> ErrorDraws:
        """The first n draws, over and over."""
        found, shift = self.discrepancy, self.discrepancy.structure_theta
        rows = np.arange(n) % len(shift)
        theta, pool = _moved(found, shift[rows], self.frames), Pool(rows, len(shift))
        fit = Polynomials(
            self.rows[0], found.model, found.mean, theta, frames=self.frames, pools=(pool,)
        )
        if not self.left:
            return fit
        coefficients: dict[int | None, NDArray[np.floating]] = {
            chip: one.coefficients for chip, one in found.structure.items()
        }
        left = Functions(self.rows[1], coefficients, partial(_functions, found), n)
        return Together((fit, left), remainder=True)

    def sigma(self, domain: EvaluationDomain) -> Float:
        """Standard deviations (N, 2) of what is left, over all draws."""
        draws = self.draw(self.discrepancy.n_draws, np.random.default_rng(0))
        exposure = None
        if self.frames:
            fitted = [e for e, _ in enumerate(domain.model.exposures)]
            fitted = [e for e in fitted if domain.model.free_frame_names(e)]
            # draws are in random order: their number chooses the exposure
            if fitted:
                exposure = np.array(fitted)[np.arange(self.discrepancy.n_draws) % len(fitted)]
        return np.sqrt(draws.on(domain, Image(exposure)).squares()[STRUCTURE])


@dataclass(frozen=True, eq=False)
class Deviations:
    """Error by deviations of single exposures, and by a curvature of the drift."""

    discrepancy: Discrepancy  # with `linear`
    # True if the position is one in a single exposure that is yet to come, whose own deviation is
    # in the error; else one in the mean of the exposures
    single: bool = False
    frames: bool = False  # as of `StructureErrors`

    @property
    def rows(self) -> tuple[Row, ...]:
        """One row."""
        return (Row(DEVIATIONS, source=SOURCE),)

    def draw(self, n: int, rng: np.random.Generator) -> Polynomials:
        """Draws in random order, as they have nothing to do with other terms."""
        linear = required(self.discrepancy.linear, "no deviations of exposures were estimated")
        rows = rng.integers(len(linear.theta), size=n)
        return self.of_rows(rows, int(rng.integers(2**63)) if self.single else None)

    def of_rows(self, rows: Int, seed: int | None) -> Polynomials:
        """Draws (n,) of the posterior by their numbers, with new deviations of single exposures.

        `seed` is that of these deviations; None for none of them.
        """
        found = self.discrepancy
        linear = required(found.linear, "no deviations of exposures were estimated")
        theta = _moved(found, linear.theta[rows], self.frames)
        more = partial(_bending, linear, np.asarray(found.mean, float), rows, seed)
        pools = [Pool(rows, len(linear.theta))]
        if seed is not None:  # their deviations are new in each set of draws
            pools.append(Pool(rows, len(linear.theta), renewed=True))
        return Polynomials(
            self.rows[0],
            found.model,
            found.mean,
            theta,
            frames=self.frames,
            more=more,
            pools=tuple(pools),
        )


@dataclass(frozen=True, eq=False)
class FieldsOfExposures:
    """Error by second-order terms and smooth fields that differ from exposure to exposure.

    The parameters follow their mean over the exposures.  A position in a single exposure that is
    yet to come has the field of that exposure besides.
    """

    discrepancy: Discrepancy  # with `fields`
    single: bool = False  # as of `Deviations`
    frames: bool = False  # as of `StructureErrors`

    @property
    def rows(self) -> tuple[Row, ...]:
        """The part in the parameters, and with `single` that of the exposure."""
        in_fit = Row(FIELDS_IN_FIT, source=SOURCE)
        return (in_fit, Row(FIELDS, source=SOURCE)) if self.single else (in_fit,)

    def draw(self, n: int, rng: np.random.Generator) -> ErrorDraws:
        """Draws in random order, as they have nothing to do with other terms."""
        fields = required(self.discrepancy.fields, "no fields of exposures were estimated")
        return self.of_rows(rng.integers(len(fields.theta), size=n), rng)

    def of_rows(self, rows: Int, rng: np.random.Generator) -> ErrorDraws:
        """Effect on the parameters of draws (n,) by their numbers.

        With `single`, fields of single exposures beside, of the posterior's draws in their order.
        """
        found, n = self.discrepancy, len(rows)
        fields = required(found.fields, "no fields of exposures were estimated")
        theta = _moved(found, fields.theta[rows], self.frames)
        fit = Polynomials(self.rows[0], found.model, found.mean, theta, frames=self.frames)
        if not self.single:
            return fit
        coefficients: dict[int | None, NDArray[np.floating]] = {
            chip.number: fields.coefficients(chip, rng) for chip in found.model.chips
        }
        waves = {chip.number: fields.functions(chip).finer_waves(rng) for chip in found.model.chips}
        own = Functions(self.rows[1], coefficients, partial(_of_exposure, found, waves), n)
        return Together((fit, own))


def _of_exposure(
    discrepancy: Discrepancy, waves: dict[int, Float], number: int, x: Float, y: Float
) -> NDArray[np.floating]:
    """Functions (N, m) of the field of an exposure on a chip."""
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
    """Curvature of the drift (n, 2, K), and with a seed the deviation of a new exposure."""
    out = linear.polynomials(epoch, chip)[rows]
    if seed is None:
        return out
    # one exposure has the same deviation on all chips, at all epochs
    return out + linear.of_single_exposures(mean, chip, np.random.default_rng(seed))[rows]


def _moved(discrepancy: Discrepancy, shift: Float, frames: bool) -> Float:
    """Parameters moved by shifts: all (n, D), or without frames of polynomials and drift alone."""
    mean, model = discrepancy.mean, discrepancy.model
    D, known = (len(mean), len(mean)) if frames else (model.n_distortion, model.n_global)
    theta = np.tile(mean[:known], (len(shift), 1))
    theta[:, :D] += shift[:, :D]
    return theta


def _functions(discrepancy: Discrepancy, chip: int, x: Float, y: Float) -> NDArray[np.floating]:
    """Functions (N, m) of the structure on a chip."""
    return discrepancy.structure[chip].evaluate(*discrepancy.model.basis(chip).scaled(x, y))
