"""Held-out stars against their prediction, group by group.

A star of an exposure that was fitted is predicted by itself.  An exposure that was held out whole
has no frame yet: one is fitted to its own stars, and what these have lost to it is taken off the
covariance of their residuals.

Polynomials that belong to no exposure lie along the detector's axes, and so do the residuals then:
what is wrong on the detector would average away over exposures of many roll angles.
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
    """Held-out stars of one group, or some of them, against their prediction."""

    index: Int  # rows (n,) of their table
    residual: Float  # data minus prediction (n, 2)
    cov: Float  # uu, vv and uv (n, 3) of the residuals' covariance
    columns: Int  # parameters (m,) of the solution that the prediction depends on
    jacobian: Float  # derivatives (n, 2, m) of the prediction by these
    exposure: str = ""  # with a frame that was fitted to its own stars
    frame: Frame | None = None
    by_frame: Float | None = None  # derivatives (n, 2, q) by its parameters
    # covariance (n, 2, m) of the catalogue's errors of these stars with those of the parameters
    with_solution: Float | None = None

    def turned_back(self, matrix: Float) -> HeldRows:
        """Rows along the axes before a frame with this linear part (2, 2), by its rotation."""
        angle = np.arctan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1])
        c, s = np.cos(angle), np.sin(angle)
        R = np.array([[c, s], [-s, c]])  # the inverse of the rotation
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
    """Iterator over the stars of a table that can be predicted.

    Stars of exposures are left out that neither the solution nor `frames` knows.
    """
    model = predictive.model
    if not model.n_frame:
        yield from _known(predictive, table, np.arange(len(table)), None)
        return
    code = {name: k for k, name in enumerate(model.exposures)}
    codes = np.array([code.get(name, -1) for name in table.exposure_names], np.int64)
    known = codes[table.exposure] >= 0
    rows = np.flatnonzero(known)
    yield from _known(predictive, table, rows, codes[table.exposure[rows]])
    for k in np.unique(table.exposure[~known]):
        name = table.exposure_names[k]
        if name in frames:
            yield from _framed(
                predictive, table, np.flatnonzero(table.exposure == k), name, frames[name]
            )


def _known(
    predictive: Predictive, table: Matches, rows: Int, exposure: Int | None
) -> Iterator[HeldRows]:
    """Iterator over rows (n,) whose frame, if there is one, belongs to the solution."""
    if not len(rows):
        return
    for one in predictions(predictive.model, predictive.mean, table, rows, exposure):
        C = predictive.cov[np.ix_(one.columns, one.columns)]
        cov = noise_of(predictive, table, one.index) + _squares(one.jacobian, C)
        found = HeldRows(one.index, one.residual, cov, one.columns, one.jacobian)
        yield found.turned_back(one.frame) if predictive.model.gauge == "held" else found


def _framed(
    predictive: Predictive, table: Matches, rows: Int, name: str, frame: Frame
) -> Iterator[HeldRows]:
    """Iterator over rows (n,) of an exposure with a frame of its own."""
    n = predictive.model.n_distortion
    C = predictive.cov[:n, :n]
    for one, by_solution, by_frame in framed(predictive, table, rows, frame.values):
        index = one.index
        # what the frame takes up of the solution's errors is no error of the prediction
        own = by_solution - by_frame @ (frame.spent @ frame.shared)
        noise = noise_of(predictive, table, index)
        cov = noise + _squares(own, C) - _squares(by_frame, frame.spent)
        common = None
        if predictive.stars is not None and table.star is not None:
            epoch = None if table.epoch is None else table.epoch[index]
            common = predictive.stars.with_solution(table.star[index], epoch)
            both = np.einsum("nam,nbm->nab", common, own)
            both = (both + np.swapaxes(both, 1, 2)).reshape(-1, 4)
            cov -= both[:, [0, 3, 1]]
        cov[:, :2] = np.maximum(cov[:, :2], 0.05 * noise[:, :2])
        residual, columns = one.residual, np.arange(n)
        found = HeldRows(index, residual, cov, columns, own, name, frame, by_frame, common)
        yield found.turned_back(one.frame) if predictive.model.gauge == "held" else found


def _squares(J: Float, C: Float) -> Float:
    """uu, vv and uv (n, 3) of J C J^T."""
    JC = J @ C
    return np.stack([(JC[:, i] * J[:, k]).sum(axis=1) for i, k in ((0, 0), (1, 1), (0, 1))], axis=1)
