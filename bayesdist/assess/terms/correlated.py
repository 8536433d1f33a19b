"""What a calibration may leave out, as terms of the error budget."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.terms.field_terms import FieldDraws
from bayesdist.assess.terms.given import MEASURED, LocalTerm
from bayesdist.infer.discrepancy import Discrepancy
from bayesdist.infer.discrepancy.linear import LinearDeviations
from bayesdist.model.grid import grid_pixels, mesh

__all__ = [
    "DEVIATIONS",
    "STRUCTURE",
    "STRUCTURE_IN_FIT",
    "DeviationsTerm",
    "StructureInFit",
    "structure_term",
]

Float = NDArray[np.float64]

STRUCTURE = "unmodelled structure"
STRUCTURE_IN_FIT = "unmodelled structure in coefficients"
DEVIATIONS = "exposure-to-exposure variation"
SOURCE = f"{MEASURED}, with a prior on its size"


@dataclass(frozen=True, eq=False)
class StructureInFit:
    """Error of the parameters that were drawn towards what the model leaves out.

    Parameters
    ----------
    discrepancy : Discrepancy
    frames : bool
        Whether errors of the exposures' frames count, of each draw those of an exposure chosen at
        random.
    name, source : str
    """

    discrepancy: Discrepancy
    frames: bool = False
    name: str = STRUCTURE_IN_FIT
    source: str = SOURCE
    without: None = None

    def draws(self, n: int, rng: np.random.Generator) -> FieldDraws:
        """The first n draws, over and over: they belong to those of the structure itself."""
        return _theta(self.discrepancy, self.discrepancy.structure_theta, n, self.frames)


@dataclass(frozen=True, eq=False)
class DeviationsTerm:
    """Error by deviations of single exposures, and by a curvature of the drift.

    Parameters
    ----------
    discrepancy : Discrepancy
        With `linear`.
    single : bool
        Whether the position is one in a single exposure that is yet to come, whose own deviation
        is in the error; else one in the mean of the exposures.
    frames : bool
        As of `StructureInFit`.
    name, source : str
    """

    discrepancy: Discrepancy
    single: bool = False
    frames: bool = False
    name: str = DEVIATIONS
    source: str = SOURCE
    without: None = None

    def draws(self, n: int, rng: np.random.Generator) -> FieldDraws:
        """Draws in random order, as they have nothing to do with other terms."""
        linear = self.discrepancy.linear
        assert linear is not None
        rows = rng.integers(len(linear.theta), size=n)
        found = _theta(self.discrepancy, linear.theta[rows], n, self.frames)
        seed = int(rng.integers(2**63)) if self.single else None
        return _Bending(
            found.model,
            found.mean,
            found.theta,
            found.exposure,
            linear=linear,
            rows=rows,
            seed=seed,
        )


@dataclass(frozen=True, eq=False)
class _Bending(FieldDraws):
    """Draws of an error of parameters with what bends in time beside."""

    linear: LinearDeviations = None  # type: ignore[assignment]
    rows: NDArray[np.int64] = None  # type: ignore[assignment]
    seed: int | None = None

    def polynomials(self, *, epoch: float | None, chip: int) -> Float:
        """Legendre coefficients (n, 2, K) of the error."""
        out = super().polynomials(epoch=epoch, chip=chip)
        out = out + self.linear.polynomials(epoch, chip)[self.rows]
        if self.seed is not None:
            # one exposure has the same deviation on all chips, at all epochs
            rng = np.random.default_rng(self.seed)
            out += self.linear.of_single_exposures(self.mean, chip, rng)[self.rows]
        return out


def _theta(discrepancy: Discrepancy, shift: Float, n: int, frames: bool) -> FieldDraws:
    """Polynomials and drift moved by shifts of the parameters, with or without frames."""
    model, mean = discrepancy.model, discrepancy.mean
    moved, theta = shift[np.arange(n) % len(shift)], np.tile(mean, (n, 1))
    fitted = [e for e in range(len(model.exposures)) if model.free_frame_names(e)]
    if frames and fitted:
        # draws are in random order: their number chooses the exposure
        exposure = np.array(fitted)[(np.arange(n) % len(shift)) % len(fitted)]
        return FieldDraws(model, mean, theta + moved, exposure)
    D = model.n_distortion
    theta[:, :D] += moved[:, :D]
    return FieldDraws(model, mean, theta)


def structure_term(
    discrepancy: Discrepancy,
    grid: tuple[int, int],
    epoch: float | None,
    *,
    frames: bool = False,
) -> LocalTerm:
    """What the model leaves out at a position, on a grid.

    The fit was drawn towards it, so that the two errors are correlated: the squares of this term
    are those of both together less those of `StructureInFit`, and its draws belong to those.

    Parameters
    ----------
    discrepancy : Discrepancy
    grid : tuple of int
        Points on x and y.
    epoch : float or None
        Decimal years; needed by a model with time dependence.
    frames : bool
        As of `StructureInFit`.

    Returns
    -------
    LocalTerm
    """
    model = discrepancy.model
    followed = StructureInFit(discrepancy, frames).draws(
        discrepancy.n_draws, np.random.default_rng(0)
    )
    sigma, drawn = {}, {}
    for chip in model.chips:
        if chip.number not in discrepancy.structure:
            continue
        x, y = grid_pixels(chip.size, grid)
        basis, at = model.basis(chip.number), mesh(x, y)
        X, Y = basis.scaled(*at)
        found = discrepancy.structure[chip.number]
        functions = found.evaluate(X, Y).astype(found.coefficients.dtype)
        left = np.swapaxes(found.coefficients @ functions.T, 1, 2)
        e = followed.polynomials(epoch=epoch, chip=chip.number)
        fit = np.swapaxes(e @ basis.evaluate(*at).T, 1, 2)
        square = np.mean((fit + left) ** 2, axis=0) - np.mean(fit**2, axis=0)
        shape = (len(y), len(x), 2)
        sigma[chip.number] = np.sqrt(np.maximum(square, 0.0)).reshape(shape)
        drawn[chip.number] = left.reshape(-1, *shape)
    return LocalTerm(STRUCTURE, sigma, SOURCE, drawn=drawn)
