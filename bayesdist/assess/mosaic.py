"""Arrangement of the chips of a detector."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.solution import place_of
from bayesdist.infer.solution import Solution

__all__ = ["chip_places"]

Float = NDArray[np.float64]


def chip_places(solution: Solution, *, epoch: float | None = None) -> tuple[tuple[int, int], ...]:
    """Row and column of each chip in a drawing of the detector, along the axes of the first chip.

    `epoch`: decimal years; needed by a model with time dependence. The result is in the order of
    the model's chips; row 0 is the one on top (largest y), column 0 the one at the left.  No two
    chips have the same place: where they overlap, all stand in one column.
    """
    chips = solution.model.chips
    centres, gradient = [], None
    for chip in chips:
        place = place_of(solution.model, epoch=epoch, chip=chip.number)
        polynomial = place.polynomial(solution.mean)
        middle = (np.array(chip.size) + 1) / 2
        centres.append(polynomial @ place.basis.evaluate(*middle[:, None])[0])
        if gradient is None:
            px, py = place.gradient(*middle[:, None])
            gradient = np.column_stack([polynomial @ px[0], polynomial @ py[0]])
    assert gradient is not None
    x, y = np.linalg.lstsq(gradient, np.transpose(centres), rcond=None)[0]
    half = np.array([c.size for c in chips]).min(axis=0) / 2
    places = tuple(zip(_ranks(-y, half[1]), _ranks(x, half[0]), strict=True))
    if len(set(places)) < len(places):
        order = np.argsort(-y, kind="stable").tolist()
        places = tuple((order.index(k), 0) for k in range(len(chips)))
    return places


def _ranks(values: Float, least: float) -> list[int]:
    """Group of each value, counted from the lowest; groups lie `least` apart."""
    order = np.argsort(values, kind="stable")
    new = np.diff(values[order]) > least
    ranks = np.empty(len(values), np.int64)
    ranks[order] = np.concatenate([[0], np.cumsum(new)])
    return ranks.tolist()
