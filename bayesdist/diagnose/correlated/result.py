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
from bayesdist.diagnose.correlated.priors import StructureFunctions
from bayesdist.model import Chip, DistortionModel
from bayesdist.utils.arrays import Float
from bayesdist.utils.random import matern

POINTS = 12  # per axis of a chip, at which sizes are averaged
PAIRED = 7  # per axis of a chip, positions at which errors of neighbours are compared
COMPARED = 300  # number of draws used for that comparison
LEAST = 1e-4  # lower limit to half the squared difference relative to the variance
SMALLEST = 0.01  # smallest fraction of the variance that is represented by a field
FIELDS = 6  # largest number: a FITS header card has room for this many
LENGTHS = 9  # number of correlation lengths of the fields that represent the structure
WEIGHT = 30.0  # of the condition that their fractions add to 1


@dataclass(frozen=True, eq=False)
class ChipStructure:
    """Draws of the structure on one chip, which is added to the fitted polynomial."""

    functions: StructureFunctions
    waves: Float  # (FINE, 2) wave vectors of structure finer than the functions
    coefficients: Float  # (n, 2, m) of functions and waves, along u and v of the polynomials

    def evaluate(self, X: Float, Y: Float) -> Float:
        """Values (N, m) of all functions at scaled positions."""
        resolved = self.functions.evaluate(X, Y)
        return np.concatenate([resolved, self.functions.evaluate_finer(self.waves, X, Y)], axis=1)

    def sizes(self, chip: Chip, length: float) -> list[dict[str, object]]:
        """Rows of chip, axis, correlation length in pixels, and rms over the chip, for summaries.

        The rms is given as the root mean square over all draws, their median, and their 95th
        percentile.  `length` is in longer half sides.
        """
        line = (np.arange(POINTS) + 0.5) * 2 / POINTS - 1
        X, Y = np.meshgrid(line, line)
        values = self.evaluate(X.ravel(), Y.ravel())
        rows: list[dict[str, object]] = []
        for a, axis in enumerate("uv"):
            by_draw = np.sqrt(np.mean((self.coefficients[:, a] @ values.T) ** 2, axis=1))
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
    """Correlation of the structure between positions, beyond the errors of the parameters.

    The structure and the corresponding error `theta` (n, D) of the parameters have a joint
    covariance.  Its excess over that of the parameters is represented by a sum of independent
    Matern fields.  The rows contain the fraction of the variance and the correlation length in
    pixels of each field.  Fractions add to at most 1; the remainder is independent between
    positions.
    """
    half = max(max(chip.size) for chip in model.chips) / 2
    separations = np.geomspace(2.0, half, 14)
    variance, squares = 0.0, np.zeros(len(separations))
    for chip in model.chips:
        if chip.number in structure:
            by_separation = _by_separation(model, chip, structure[chip.number], theta, separations)
            variance, squares = variance + by_separation[0], squares + by_separation[1:]
    if not variance > 0:
        return []
    # half the squared difference of errors, relative to their variance
    apart = np.clip(squares / (2 * variance), LEAST, 1.0)
    lengths = np.geomspace(4.0, 2 * half, LENGTHS)
    fields = 1 - matern(separations[:, None] / lengths)
    # fit differences of neighbours to the same relative precision as those at large separations
    rows = np.hstack([fields, np.ones((len(apart), 1))]) / apart[:, None]
    rows = np.vstack([rows, np.full(LENGTHS + 1, WEIGHT)])
    fractions, _ = nnls(rows, np.append(np.ones(len(apart)), WEIGHT))
    fractions = fractions[:-1] / max(fractions.sum(), 1e-300)
    selected = np.sort(np.argsort(fractions)[-FIELDS:])
    selected = selected[fractions[selected] > SMALLEST]
    if not len(selected):
        return []
    # add small fractions to the largest: independent errors would increase differences of
    # neighbours
    omitted = fractions.sum() - fractions[selected].sum()
    fractions[selected[np.argmax(fractions[selected])]] += omitted
    return [[round(float(fractions[k]), 3), float(f"{lengths[k]:.3g}")] for k in selected]


def _by_separation(
    model: DistortionModel, chip: Chip, found: ChipStructure, theta: Float, separations: Float
) -> Float:
    """Variance beyond the errors of the parameters, and mean squared differences of it.

    The result has the shape (1 + s,): the variance, followed by the squared differences between
    positions at the separations (s,) in pixels.
    """
    line = (np.arange(PAIRED) + 0.5) * 2 / PAIRED - 1
    X, Y = (z.ravel() for z in np.meshgrid(line, line))
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(X.size)
    separations = np.append(0.0, separations)
    step = 2 * separations[:, None] / np.array(chip.size)[:, None, None]
    at = np.empty((2, len(separations), X.size))
    for k, (z, moved) in enumerate(((X, np.cos(angle)), (Y, np.sin(angle)))):
        neighbour = z + step[k] * moved
        # use the opposite direction if the position is outside the chip
        at[k] = np.where(np.abs(neighbour) <= 1, neighbour, z - step[k] * moved)
    inside = (np.abs(at[0]) <= 1) & (np.abs(at[1]) <= 1)
    draws = slice(None, None, max(1, len(theta) // COMPARED))
    values = found.evaluate(at[0].ravel(), at[1].ravel()).astype(found.coefficients.dtype)
    phi = model.basis(chip.number).evaluate_scaled(at[0].ravel(), at[1].ravel())
    out = np.zeros(len(separations))
    for a in (0, 1):
        in_fit = theta[draws, model.coefficient_slice(chip.number, a)] @ phi.T
        with_structure = found.coefficients[draws, a] @ values.T + in_fit
        for sign, errors in ((1, with_structure), (-1, in_fit)):
            shaped = errors.reshape(len(errors), len(separations), -1)
            square = np.mean((shaped - shaped[:, :1]) ** 2, axis=0)
            square[0] = np.mean(shaped[:, 0] ** 2, axis=0)
            out += sign * (square * inside).sum(axis=1) / np.maximum(inside.sum(axis=1), 1)
    return out


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """Structure that the fitted model lacks, as independent draws.

    Parameters
    ----------
    model : DistortionModel
        Model of the solution.
    mean : ndarray, shape (D,)
        Parameters of the solution.
    formal : ndarray, shape (D, D)
        Covariance of the parameters from the likelihood.
    noise : ndarray, shape (D, D)
        Covariance from the observed scatter of the stars, including the errors that a star of the
        catalogue has in all of its exposures.
    structure : dict of int to ChipStructure
        Structure by chip number.
    structure_theta : ndarray, shape (n, D)
        Error of the parameters that corresponds to each draw of the structure.
    linear : LinearDeviations or None
        Linear deviations of exposures, and curvature of drifts.
    facts : mapping
        Sizes for summaries; JSON-serialisable.
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

    def structure_of_catalogue(self) -> Float:
        """Error (n, D) of the parameters in each draw if the structure is the catalogue's.

        A structure of the detector is an error where the model lacks it, and low orders of it are
        part of the polynomials.  A structure of the catalogue is an error where the fit follows it,
        low orders above all; what the model lacks then is no error of the calibration.
        """
        out = self.structure_theta.copy()
        for number, chip in self.structure.items():
            first = chip.functions.n_terms
            sines = chip.coefficients[:, :, first : first + chip.functions.n_sines]
            low = chip.functions.low_orders(sines)
            for a in (0, 1):
                out[:, self.model.coefficient_slice(number, a)] -= low[:, a]
        return out

    @property
    def stored(self) -> Discrepancy:
        """Discrepancy with the precision of files: structure coefficients in single precision."""
        structure = {
            number: replace(chip, coefficients=chip.coefficients.astype(np.float32))
            for number, chip in self.structure.items()
        }
        return replace(self, structure=structure)

    def moved(self, matrix: Float) -> Discrepancy:
        """Discrepancy with all parameter errors multiplied by a matrix (D, D)."""
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
        """Covariance (D, D) of the parameters' errors due to all causes.

        It is taken about zero rather than about their mean.
        """
        out = self.noise.copy()
        parts = [part.theta for part in (self.linear, self.fields) if part is not None]
        for theta in (self.structure_theta, *parts):
            out += theta.T @ theta / len(theta)
        return out

    @property
    def structure_rms(self) -> float | None:
        """Rms of the structure over the detector, both axes together; None without structure."""
        by_axis = self._sizes("rms")
        return None if by_axis is None else float(np.hypot(*by_axis))

    @property
    def structure_median(self) -> tuple[float, float] | None:
        """Median rms over the detector along u and v, without the tail of the prior.

        None without structure.
        """
        return self._sizes("median")

    def _sizes(self, name: str) -> tuple[float, float] | None:
        """Sizes of the structure along u and v, over all chips; None without structure."""
        rows = self.facts.get("structure")
        if not rows:
            return None
        u, v = (
            float(np.sqrt(np.mean([r[name] ** 2 for r in rows if r["axis"] == axis])))
            for axis in "uv"
        )
        return u, v
