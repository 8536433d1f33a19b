"""Draws of all discrepancies of a calibration, and their effect on the parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from bayesdist.diagnose.correlated.deviations import LinearDeviations
from bayesdist.diagnose.correlated.exposure_fields import ExposureFields
from bayesdist.diagnose.correlated.functions import StructureFunctions
from bayesdist.model import Chip, DistortionModel
from bayesdist.utils.arrays import Float

POINTS = 12  # on each axis of a chip, over which sizes are averaged


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
