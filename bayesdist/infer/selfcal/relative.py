"""Gauge-free solutions: without their errors along free directions.

Two solutions of the same detections in different gauges differ by a move along directions that
detections leave free.  Of every error the part that such a move over the detector describes best is
removed (an S-transformation: Baarda 1973; Teunissen 1985); the rest is common to all gauges.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.solution import Solution
from bayesdist.model import DistortionModel

__all__ = ["gauge_free", "gauge_free_matrix"]

Float = NDArray[np.float64]


def gauge_free_matrix(model: DistortionModel, theta: Float, null: Float) -> Float:
    """Matrix S (D, D) that removes from a change of the parameters its part along free directions.

    S null = 0, `null` (D, d) being `Gauge.null`: the positions of all chips in the first exposure
    that S d makes are those of d without the combination of free directions that is nearest to
    them, by least squares over the area of the chips.
    """
    D = model.n_params
    if not null.shape[1]:
        return np.eye(D)
    rows = []
    for chip in model.chips:
        x, y, area = chip.quadrature(model.order + 1)  # exact for squares of the polynomials
        where = {"exposure": np.zeros(len(x), np.int64), "chip": np.full(len(x), chip.number)}
        if model.time is not None:
            where["epoch"] = np.full(len(x), model.time.epoch0[0])
        J = model.jacobian(theta, x, y, **where)
        rows.append((np.sqrt(area)[:, None, None] * J).reshape(-1, D))
    J = np.concatenate(rows)
    return np.asarray(np.eye(D) - null @ np.linalg.pinv(J @ null) @ J)


def gauge_free(solution: Solution, null: Float) -> Solution:
    """Solution whose errors are those of relative positions on the detector; its mean stays.

    `null` (D, d) are the free directions at it.
    """
    return solution.mapped(gauge_free_matrix(solution.model, solution.mean, null))
