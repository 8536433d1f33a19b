"""Held-out stars against their prediction, group by group.

A star of an exposure that was fitted is predicted by itself.  An exposure that was held out whole
has no frame yet: one is fitted to its own stars, and what these have lost to it is taken off the
covariance of their residuals.

Polynomials that belong to no exposure lie along the detector's axes, and so do the residuals then:
what is wrong on the detector would average away over exposures of many roll angles.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import Matches
from bayesdist.diagnose.holdout.frames import AT_ONCE, Frame, framed, noise_of
from bayesdist.diagnose.holdout.predictive import Predictive

__all__ = ["Rows", "predicted_rows"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Rows:
    """Stars of one group, or some of them.

    Parameters
    ----------
    index : ndarray of int, shape (n,)
        Rows of their table.
    residual : ndarray, shape (n, 2)
        Data minus prediction.
    cov : ndarray, shape (n, 3)
        uu, vv and uv of the residuals' covariance.
    columns : ndarray of int, shape (m,)
        Parameters of the solution that the prediction depends on.
    jacobian : ndarray, shape (n, 2, m)
        Of the prediction, by these.
    by_frame : ndarray, shape (n, 2, q) or None
        By those of a frame of their own.
    frame : Frame or None
    with_solution : ndarray, shape (n, 2, m) or None
        Covariance of the catalogue's errors of these stars with those of the parameters.
    """

    index: Int
    residual: Float
    cov: Float
    columns: Int
    jacobian: Float
    by_frame: Float | None = None
    frame: Frame | None = None
    with_solution: Float | None = None


def predicted_rows(
    predictive: Predictive, table: Matches, frames: Mapping[str, Frame]
) -> Iterator[Rows]:
    """The stars of a table that can be predicted.

    Parameters
    ----------
    predictive : Predictive
    table : Matches
        With errors.
    frames : mapping of str to Frame
        Of the exposures that the solution does not know; stars of others are left out.

    Yields
    ------
    Rows
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
        frame = frames.get(table.exposure_names[k])
        if frame is not None:
            yield from _framed(predictive, table, np.flatnonzero(table.exposure == k), frame)


def _known(
    predictive: Predictive, table: Matches, rows: Int, exposure: Int | None
) -> Iterator[Rows]:
    """Rows whose frame, if there is one, belongs to the solution."""
    model = predictive.model
    if not len(rows):
        return
    groups = model.groups(
        len(rows),
        epoch=None if table.epoch is None else table.epoch[rows],
        exposure=exposure,
        chip=table.chip_number[rows],
    )
    effective = model.effective(predictive.mean, groups)
    jacobians = model.effective_jacobian(predictive.mean, groups)
    data = np.stack([table.u, table.v], axis=1)
    for g, members in enumerate(groups.members()):
        columns, d = jacobians[g]
        basis = model.basis(model.chips[groups.chip[g]].number)
        C = predictive.cov[np.ix_(columns, columns)]
        for start in range(0, len(members), AT_ONCE):
            index = rows[members[start : start + AT_ONCE]]
            phi = basis.evaluate(table.x[index], table.y[index])
            part = np.einsum("nk,akm->nam", phi, d)
            residual = data[index] - phi @ effective[g].T
            cov = noise_of(predictive, table, index) + _squares(part, C)
            found = Rows(index, residual, cov, columns, part)
            if model.gauge == "held":
                found = _turned_back(
                    found, model.frame(predictive.mean, int(groups.exposure[g]))[0]
                )
            yield found


def _framed(predictive: Predictive, table: Matches, index: Int, frame: Frame) -> Iterator[Rows]:
    """Rows of an exposure with a frame of its own."""
    n = predictive.model.n_distortion
    C = predictive.cov[:n, :n]
    for bare in framed(predictive, table, index, frame.values):
        # what the frame takes up of the solution's errors is no error of the prediction
        own = bare.by_solution - bare.by_frame @ (frame.spent @ frame.shared)
        noise = noise_of(predictive, table, bare.index)
        cov = noise + _squares(own, C) - _squares(bare.by_frame, frame.spent)
        common = None
        if predictive.stars is not None and table.star is not None:
            epoch = None if table.epoch is None else table.epoch[bare.index]
            common = predictive.stars.with_solution(table.star[bare.index], epoch)
            both = np.einsum("nam,nbm->nab", common, own)
            cov -= np.stack(
                [2 * both[:, 0, 0], 2 * both[:, 1, 1], both[:, 0, 1] + both[:, 1, 0]], axis=1
            )
        cov[:, :2] = np.maximum(cov[:, :2], 0.05 * noise[:, :2])
        rows = Rows(bare.index, bare.residual, cov, np.arange(n), own, bare.by_frame, frame, common)
        held = predictive.model.gauge == "held"
        yield _turned_back(rows, bare.matrix) if held else rows


def _squares(J: Float, C: Float) -> Float:
    """uu, vv and uv of J C J^T."""
    JC = J @ C
    return np.stack([(JC[:, i] * J[:, k]).sum(axis=1) for i, k in ((0, 0), (1, 1), (0, 1))], axis=1)


def _turned_back(rows: Rows, matrix: Float) -> Rows:
    """Rows along the axes before a frame of this linear part, by the rotation in it."""
    angle = np.arctan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1])
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, s], [-s, c]])  # the inverse of the rotation
    uu, vv, uv = rows.cov.T
    cov = np.stack([np.stack([uu, uv], axis=1), np.stack([uv, vv], axis=1)], axis=1)
    cov = R @ cov @ R.T

    def turned(values: Float | None) -> Float | None:
        return None if values is None else np.asarray(R @ values)

    return Rows(
        rows.index,
        rows.residual @ R.T,
        np.stack([cov[:, 0, 0], cov[:, 1, 1], cov[:, 0, 1]], axis=1),
        rows.columns,
        R @ rows.jacobian,
        turned(rows.by_frame),
        rows.frame,
        turned(rows.with_solution),
    )
