"""Draws of the structure on a chip as a result, with its sizes for summaries."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.discrepancy.functions import StructureFunctions
from bayesdist.infer.discrepancy.result import ChipStructure
from bayesdist.infer.selfcal.structure import StructurePosterior
from bayesdist.model import Chip

__all__ = ["chip_structure"]

Float = NDArray[np.float64]

POINTS = 12  # on each axis


def chip_structure(
    chip: Chip,
    functions: StructureFunctions,
    waves: Float,
    coefficients: Sequence[Float],
    posteriors: Sequence[StructurePosterior],
) -> tuple[ChipStructure, list[dict[str, object]]]:
    """Structure on a chip, and its sizes on each axis for summaries.

    `waves` (FINE, 2) are those of structure finer than the functions; `coefficients` (n, m) are
    draws along u, and along v, from the posteriors.  Sizes: the chip, the axis, the amplitude and
    length of the field, the rms over the chip of the draws, by the mean of their squares and by
    their median.
    """
    found = ChipStructure(functions, waves, np.stack(coefficients, axis=1))
    here = found.evaluate(*_even_points())
    sizes = [np.sqrt(np.mean((drawn @ here.T) ** 2, axis=1)) for drawn in coefficients]
    rows: list[dict[str, object]] = [
        {
            "chip": chip.number,
            "axis": axis,
            "field_rms": posterior.field_rms,
            "length_pix": posterior.length * max(chip.size) / 2,
            "rms": float(np.sqrt(np.mean(by_draw**2))),
            "median": float(np.median(by_draw)),
            "most": float(np.quantile(by_draw, 0.95)),
        }
        for axis, by_draw, posterior in zip("uv", sizes, posteriors, strict=True)
    ]
    return found, rows


def _even_points() -> tuple[Float, Float]:
    """Scaled positions over which sizes are averaged."""
    line = (np.arange(POINTS) + 0.5) * 2 / POINTS - 1
    X, Y = np.meshgrid(line, line)
    return X.ravel(), Y.ravel()
