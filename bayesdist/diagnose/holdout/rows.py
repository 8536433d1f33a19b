"""Held-out stars compared with their prediction, group by group.

A star of an exposure that was fitted is predicted directly.  An exposure that was held out entirely
has no frame yet: a frame is fitted to its stars, and what the stars lose to it is subtracted from
the covariance of their residuals.

If the polynomials belong to no exposure, they and the residuals are along the detector axes: errors
that are fixed on the detector would otherwise average out over exposures of many roll angles.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.diagnose.holdout.frames import Frame, framed
from bayesdist.diagnose.holdout.predictive import (
    Predictive,
    noise_of,
    predictions,
)
from bayesdist.utils.arrays import Float, Int


@dataclass(frozen=True, eq=False)
class HeldRows:
    """Held-out stars of one group, or a part of them, and their prediction."""

    index: Int  # rows (n,) in their table
    residual: Float  # data minus prediction (n, 2)
    cov: Float  # elements uu, vv, uv (n, 3) of the residuals' covariance
    columns: Int  # indices (m,) of the solution's parameters that the prediction depends on
    jacobian: Float  # derivatives (n, 2, m) of the prediction with respect to these
    exposure: str = ""  # name, if its frame was fitted to these stars
    frame: Frame | None = None
    by_frame: Float | None = None  # derivatives (n, 2, q) with respect to the frame's parameters
    # covariance (n, 2, m) of the catalogue's errors of these stars with the parameters
    with_solution: Float | None = None

    def turned_back(self, matrix: Float) -> HeldRows:
        """Rows rotated to the axes before a frame with the linear part `matrix` (2, 2)."""
        angle = np.arctan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1])
        c, s = np.cos(angle), np.sin(angle)
        R = np.array([[c, s], [-s, c]])  # inverse of the frame's rotation
        cov = R @ self.cov[:, [0, 2, 2, 1]].reshape(-1, 2, 2) @ R.T
        return replace(
            self,
            residual=self.residual @ R.T,
            cov=cov.reshape(-1, 4)[:, [0, 3, 1]],
            jacobian=R @ self.jacobian,
            by_frame=None if self.by_frame is None else R @ self.by_frame,
            with_solution=None if self.with_solution is None else R @ self.with_solution,
        )


def predicted_rows(
    predictive: Predictive, table: Matches, frames: Mapping[str, Frame]
) -> Iterator[HeldRows]:
    """Iterate over the stars of a table that can be predicted.

    Stars of exposures that are neither in the solution nor in `frames` are left out.
    """
    model = predictive.model
    if not model.n_frame:
        yield from _known(predictive, table, np.arange(len(table)), None)
        return
    code = {name: k for k, name in enumerate(model.exposures)}
    codes = np.array([code.get(name, -1) for name in table.exposure_names], np.int64)
    is_fitted = codes[table.exposure] >= 0
    rows = np.flatnonzero(is_fitted)
    yield from _known(predictive, table, rows, codes[table.exposure[rows]])
    for k in np.unique(table.exposure[~is_fitted]):
        name = table.exposure_names[k]
        if name in frames:
            yield from _framed(
                predictive, table, np.flatnonzero(table.exposure == k), name, frames[name]
            )


def _known(
    predictive: Predictive, table: Matches, rows: Int, exposure: Int | None
) -> Iterator[HeldRows]:
    """Iterate over rows (n,) with a frame, if any, that belongs to the solution."""
    if not len(rows):
        return
    for prediction in predictions(predictive.model, predictive.mean, table, rows, exposure):
        C = predictive.cov[np.ix_(prediction.columns, prediction.columns)]
        cov = noise_of(predictive, table, prediction.index) + _squares(prediction.jacobian, C)
        held_rows = HeldRows(
            prediction.index, prediction.residual, cov, prediction.columns, prediction.jacobian
        )
        yield (
            held_rows.turned_back(prediction.frame)
            if predictive.model.gauge == "held"
            else held_rows
        )


def _framed(
    predictive: Predictive, table: Matches, rows: Int, name: str, frame: Frame
) -> Iterator[HeldRows]:
    """Iterate over rows (n,) of an exposure with a separately fitted frame."""
    n = predictive.model.n_distortion
    C = predictive.cov[:n, :n]
    for prediction, by_solution, by_frame in framed(predictive, table, rows, frame.values):
        index = prediction.index
        # errors of the solution that the frame absorbs are no errors of the prediction
        jacobian = by_solution - by_frame @ (frame.spent @ frame.shared)
        noise = noise_of(predictive, table, index)
        cov = noise + _squares(jacobian, C) - _squares(by_frame, frame.spent)
        common = None
        if predictive.stars is not None and table.star is not None:
            epoch = None if table.epoch is None else table.epoch[index]
            common = predictive.stars.with_solution(table.star[index], epoch)
            shared = np.einsum("nam,nbm->nab", common, jacobian)
            shared = (shared + np.swapaxes(shared, 1, 2)).reshape(-1, 4)
            cov -= shared[:, [0, 3, 1]]
        cov[:, :2] = np.maximum(cov[:, :2], 0.05 * noise[:, :2])
        residual, columns = prediction.residual, np.arange(n)
        held_rows = HeldRows(index, residual, cov, columns, jacobian, name, frame, by_frame, common)
        yield (
            held_rows.turned_back(prediction.frame)
            if predictive.model.gauge == "held"
            else held_rows
        )


def _squares(J: Float, C: Float) -> Float:
    """Elements uu, vv and uv (n, 3) of J C J^T."""
    JC = J @ C
    return np.stack([(JC[:, i] * J[:, k]).sum(axis=1) for i, k in ((0, 0), (1, 1), (0, 1))], axis=1)
