"""A discrepancy as plain arrays and facts, for files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.diagnose.correlated.deviations import KINDS, LinearDeviations
from bayesdist.diagnose.correlated.functions import StructureFunctions
from bayesdist.diagnose.correlated.result import ChipStructure, Discrepancy
from bayesdist.model import DistortionModel

__all__ = ["as_stored", "discrepancy_from_arrays", "discrepancy_to_arrays"]


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
