"""Draws of all discrepancies of a calibration, and their effect on the parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import nnls

from bayesdist.diagnose.correlated.deviations import LinearDeviations
from bayesdist.diagnose.correlated.exposure_fields import ExposureFields
from bayesdist.diagnose.correlated.functions import StructureFunctions
from bayesdist.model import Chip, DistortionModel
from bayesdist.utils.arrays import Float
from bayesdist.utils.matern import matern

POINTS = 12  # on each axis of a chip, over which sizes are averaged
PAIRED = 7  # likewise, positions whose neighbours' errors are compared
COMPARED = 300  # draws by which they are
LEAST = 1e-4  # half a squared difference relative to the variance, below which all is alike
SMALLEST = 0.01  # fraction of the variance that is worth a field
FIELDS = 6  # at most: a card of a FITS header has room for so many
LENGTHS = 9  # correlation lengths of the fields that represent the structure
WEIGHT = 30.0  # of the condition that their fractions add to 1


@dataclass(frozen=True, eq=False)
class ChipStructure:
    """Draws of the structure on one chip, which is added to the fitted polynomial."""

    functions: StructureFunctions
    waves: Float  # wave vectors (FINE, 2) of structure finer than the functions
    coefficients: Float  # (n, 2, m) of functions and waves, along u and v of the polynomials

    def evaluate(self, X: Float, Y: Float) -> Float:
        """Values (N, m) of all functions at scaled positions."""
        known = self.functions.evaluate(X, Y)
        return np.concatenate([known, self.functions.evaluate_finer(self.waves, X, Y)], axis=1)

    def sizes(self, chip: Chip, length: float) -> list[dict[str, object]]:
        """Rows of chip, axis, correlation length in pixels, and rms over the chip, for summaries.

        The rms is that of all draws by the mean of their squares, their median, and what 95 % of
        them do not exceed; `length` is in longer half sides.
        """
        line = (np.arange(POINTS) + 0.5) * 2 / POINTS - 1
        X, Y = np.meshgrid(line, line)
        here = self.evaluate(X.ravel(), Y.ravel())
        rows: list[dict[str, object]] = []
        for a, axis in enumerate("uv"):
            by_draw = np.sqrt(np.mean((self.coefficients[:, a] @ here.T) ** 2, axis=1))
            rows.append(
                {
                    "chip": chip.number,
                    "axis": axis,
                    "rms": float(np.sqrt(np.mean(by_draw**2))),
                    "median": float(np.median(by_draw)),
                    "most": float(np.quantile(by_draw, 0.95)),
                    "length_pix": length * max(chip.size) / 2,
                }
            )
        return rows


def structure_correlation(
    model: DistortionModel, structure: Mapping[int, ChipStructure], theta: Float
) -> list[list[float]]:
    """Correlation between positions of the structure that the parameters' errors do not hold.

    The structure and the error `theta` (n, D) of the parameters that belongs to it have a joint
    covariance.  What it has beyond that of the parameters is represented by a sum of independent
    Matern fields: rows of their fraction of the variance and their correlation length in pixels.
    Fractions add to 1 at most; the rest is independent from position to position.
    """
    half = max(max(chip.size) for chip in model.chips) / 2
    separations = np.geomspace(2.0, half, 14)
    variance, squares = 0.0, np.zeros(len(separations))
    for chip in model.chips:
        if chip.number in structure:
            own = _by_separation(model, chip, structure[chip.number], theta, separations)
            variance, squares = variance + own[0], squares + own[1:]
    if not variance > 0:
        return []
    # half the squared difference of errors, relative to their variance
    apart = np.clip(squares / (2 * variance), LEAST, 1.0)
    lengths = np.geomspace(4.0, 2 * half, LENGTHS)
    fields = 1 - matern(separations[:, None] / lengths)
    # differences of neighbours to the same relative precision as those of stars far apart
    rows = np.hstack([fields, np.ones((len(apart), 1))]) / apart[:, None]
    rows = np.vstack([rows, np.full(LENGTHS + 1, WEIGHT)])
    fractions, _ = nnls(rows, np.append(np.ones(len(apart)), WEIGHT))
    fractions = fractions[:-1] / max(fractions.sum(), 1e-300)
    kept = np.sort(np.argsort(fractions)[-FIELDS:])
    kept = kept[fractions[kept] > SMALLEST]
    if not len(kept):
        return []
    # small fractions go to the largest: independent errors would widen differences of neighbours
    rest = fractions.sum() - fractions[kept].sum()
    fractions[kept[np.argmax(fractions[kept])]] += rest
    return [[round(float(fractions[k]), 3), float(f"{lengths[k]:.3g}")] for k in kept]


def _by_separation(
    model: DistortionModel, chip: Chip, found: ChipStructure, theta: Float, separations: Float
) -> Float:
    """Variance of what the parameters' errors do not hold, and mean squared differences of it.

    The first of (1 + s,) is the variance, the others are the squared differences between positions
    at these separations (s,) in pixels.
    """
    line = (np.arange(PAIRED) + 0.5) * 2 / PAIRED - 1
    X, Y = (z.ravel() for z in np.meshgrid(line, line))
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(X.size)
    separations = np.append(0.0, separations)
    step = 2 * separations[:, None] / np.array(chip.size)[:, None, None]
    at = np.empty((2, len(separations), X.size))
    for k, (z, moved) in enumerate(((X, np.cos(angle)), (Y, np.sin(angle)))):
        other = z + step[k] * moved
        # to the other side where it would leave the chip
        at[k] = np.where(np.abs(other) <= 1, other, z - step[k] * moved)
    inside = (np.abs(at[0]) <= 1) & (np.abs(at[1]) <= 1)
    draws = slice(None, None, max(1, len(theta) // COMPARED))
    values = found.evaluate(at[0].ravel(), at[1].ravel()).astype(found.coefficients.dtype)
    phi = model.basis(chip.number).evaluate_scaled(at[0].ravel(), at[1].ravel())
    out = np.zeros(len(separations))
    for a in (0, 1):
        in_fit = theta[draws, model.coefficient_slice(chip.number, a)] @ phi.T
        every = found.coefficients[draws, a] @ values.T + in_fit
        for sign, errors in ((1, every), (-1, in_fit)):
            shaped = errors.reshape(len(errors), len(separations), -1)
            square = np.mean((shaped - shaped[:, :1]) ** 2, axis=0)
            square[0] = np.mean(shaped[:, 0] ** 2, axis=0)
            out += sign * (square * inside).sum(axis=1) / np.maximum(inside.sum(axis=1), 1)
    return out


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """Structure outside the fitted model, as independent draws.

    Parameters
    ----------
    model : DistortionModel
    mean : ndarray, shape (D,)
        Of the solution.
    formal : ndarray, shape (D, D)
        Covariance of its parameters by the likelihood.
    noise : ndarray, shape (D, D)
        Covariance by the observed scatter of the stars, and by the errors that a star of the
        catalogue has in all of its exposures.
    structure : dict of int to ChipStructure
        By chip number.
    structure_theta : ndarray, shape (n, D)
        Error of the parameters that belongs to each draw of the structure.
    linear : LinearDeviations or None
        Of exposures and drifts.
    facts : mapping
        Sizes, for summaries: JSON-able.
    fields : ExposureFields or None
        Second-order terms and smooth fields of single exposures; None for one exposure.
    """

    model: DistortionModel
    mean: Float
    formal: Float
    noise: Float
    structure: Mapping[int, ChipStructure]
    structure_theta: Float
    linear: LinearDeviations | None
    facts: Mapping[str, Any] = field(default_factory=dict)
    fields: ExposureFields | None = None

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return len(self.structure_theta)

    @property
    def stored(self) -> Discrepancy:
        """Discrepancy as files have it: coefficients of the structure in single precision."""
        structure = {
            number: replace(chip, coefficients=chip.coefficients.astype(np.float32))
            for number, chip in self.structure.items()
        }
        return replace(self, structure=structure)

    def moved(self, matrix: Float) -> Discrepancy:
        """Discrepancy with all errors of the parameters multiplied by a matrix (D, D)."""
        linear, fields = self.linear, self.fields
        return replace(
            self,
            formal=matrix @ self.formal @ matrix.T,
            noise=matrix @ self.noise @ matrix.T,
            structure_theta=self.structure_theta @ matrix.T,
            linear=linear and replace(linear, theta=linear.theta @ matrix.T),
            fields=fields and replace(fields, theta=fields.theta @ matrix.T),
        )

    @cached_property
    def covariance(self) -> Float:
        """Covariance (D, D) of the parameters' errors by all causes; about zero, not their mean."""
        out = self.noise.copy()
        parts = [part.theta for part in (self.linear, self.fields) if part is not None]
        for theta in (self.structure_theta, *parts):
            out += theta.T @ theta / len(theta)
        return out

    @property
    def structure_rms(self) -> float | None:
        """Rms over the detector of the structure, both axes together; None where there is none."""
        by_axis = self._sizes("rms")
        return None if by_axis is None else float(np.hypot(*by_axis))

    @property
    def structure_median(self) -> tuple[float, float] | None:
        """Median rms over the detector along u and v, without the prior's tail; None without."""
        return self._sizes("median")

    def _sizes(self, name: str) -> tuple[float, float] | None:
        """Sizes of the structure along u and v, over all chips."""
        rows = self.facts.get("structure")
        if not rows:
            return None
        u, v = (
            float(np.sqrt(np.mean([r[name] ** 2 for r in rows if r["axis"] == axis])))
            for axis in "uv"
        )
        return u, v
