"""Draws of all discrepancies of a calibration, their effect on the parameters, and their arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.diagnose.correlated.deviations import KINDS, LinearDeviations
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
    """

    model: DistortionModel
    mean: Float
    formal: Float
    noise: Float
    structure: Mapping[int, ChipStructure]
    structure_theta: Float
    linear: LinearDeviations | None
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return len(self.structure_theta)

    def moved(self, matrix: Float) -> Discrepancy:
        """Discrepancy with all errors of the parameters multiplied by a matrix (D, D)."""
        linear = self.linear
        return replace(
            self,
            formal=matrix @ self.formal @ matrix.T,
            noise=matrix @ self.noise @ matrix.T,
            structure_theta=self.structure_theta @ matrix.T,
            linear=linear and replace(linear, theta=linear.theta @ matrix.T),
        )

    @cached_property
    def covariance(self) -> Float:
        """Covariance (D, D) of the parameters' errors by all causes; about zero, not their mean."""
        out = self.noise.copy()
        for theta in (self.structure_theta, None if self.linear is None else self.linear.theta):
            if theta is not None:
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


def discrepancy_to_arrays(
    found: Discrepancy,
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Arrays by name, and the facts."""
    arrays: dict[str, NDArray[Any]] = {
        "mean": found.mean,
        "formal": found.formal,
        "noise": found.noise,
        "structure_theta": found.structure_theta,
    }
    for number, chip in found.structure.items():
        arrays[f"chip{number}_n_side"] = np.array(chip.functions.n_side)
        arrays[f"chip{number}_waves"] = chip.waves
        arrays[f"chip{number}_coefficients"] = chip.coefficients.astype(np.float32)
    linear = found.linear
    if linear is not None:
        arrays |= {
            "linear_theta": linear.theta,
            "linear_terms": np.array(linear.terms, np.int64).reshape(-1, 3),
            "linear_curvature": linear.curvature,
            "linear_epoch": np.array(linear.epoch),
            "linear_exposures": np.array(linear.n_exposures),
            "linear_kinds": np.array([k in linear.kinds for k in KINDS]),
            "linear_size": np.array(linear.size),
        }
        arrays |= {f"scatter_{name}": values for name, values in linear.scatter.items()}
    return arrays, dict(found.facts)


def discrepancy_from_arrays(
    model: DistortionModel, arrays: Mapping[str, NDArray[Any]]
) -> Discrepancy:
    """Discrepancy from the arrays of `discrepancy_to_arrays`."""
    structure = {}
    for chip in model.chips:
        name = f"chip{chip.number}"
        if f"{name}_waves" in arrays:
            n_side = int(arrays[f"{name}_n_side"])
            structure[chip.number] = ChipStructure(
                StructureFunctions(model.order, chip.size, n_side),
                arrays[f"{name}_waves"],
                arrays[f"{name}_coefficients"],
            )
    linear = None
    if "linear_theta" in arrays:
        linear = LinearDeviations(
            model=model,
            theta=arrays["linear_theta"],
            terms=tuple((int(a), int(b), int(c)) for a, b, c in arrays["linear_terms"]),
            curvature=arrays["linear_curvature"],
            epoch=float(arrays["linear_epoch"]),
            scatter={
                name.removeprefix("scatter_"): values
                for name, values in arrays.items()
                if name.startswith("scatter_")
            },
            n_exposures=int(arrays["linear_exposures"]),
            kinds=tuple(k for k, has in zip(KINDS, arrays["linear_kinds"], strict=True) if has),
            size=float(arrays["linear_size"]),
        )
    mean, formal, noise = (arrays[k] for k in ("mean", "formal", "noise"))
    return Discrepancy(model, mean, formal, noise, structure, arrays["structure_theta"], linear)


def as_stored(found: Discrepancy) -> Discrepancy:
    """The discrepancy in the precision of files, so that it is the same before and after."""
    arrays, facts = discrepancy_to_arrays(found)
    return replace(discrepancy_from_arrays(found.model, arrays), facts=facts)
