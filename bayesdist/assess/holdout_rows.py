"""Held-out stars against their prediction, group by group.

A star of an exposure that was fitted is predicted by itself.  An exposure that was held out whole
has no frame yet: one is fitted to its own stars, and what these have lost to it is taken off the
covariance of their residuals.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.holdout_predictive import Predictive, scores_of
from bayesdist.data import MatchTable
from bayesdist.data.pieces import Piece
from bayesdist.infer.stars import errors_of
from bayesdist.model import DistortionModel
from bayesdist.model.frames import frame_matrix, frame_names, frame_tangent, nearest_frame

__all__ = ["Frame", "Rows", "frames_for", "predicted_rows"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

AT_ONCE = 2**14
SOFT, EXACT = 10, 6  # steps with weights that reach far, and with those of the mixture
REACH = 4.0  # chi-square at which the former are one half
STARS_PER_FRAME = 20


@dataclass(frozen=True, eq=False)
class Frame:
    """The frame of an exposure that was held out whole.

    Parameters
    ----------
    values : ndarray, shape (q,)
    information : ndarray, shape (q, q)
        What its stars say of it.
    shared : ndarray, shape (q, n)
        What they say of it and of the solution's polynomials and drift together.
    """

    values: Float
    information: Float
    shared: Float


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
    """

    index: Int
    residual: Float
    cov: Float
    columns: Int
    jacobian: Float
    by_frame: Float | None = None
    frame: Frame | None = None


def predicted_rows(
    predictive: Predictive, table: MatchTable, frames: Mapping[str, Frame]
) -> Iterator[Rows]:
    """The stars of a table that can be predicted.

    Parameters
    ----------
    predictive : Predictive
    table : MatchTable
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
    predictive: Predictive, table: MatchTable, rows: Int, exposure: Int | None
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
    sigma = np.stack(errors_of(table), axis=1)
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
            cov = _noise(predictive, sigma[index]) + _squares(part, C)
            yield Rows(index, residual, cov, columns, part)


def _noise(predictive: Predictive, sigma: Float) -> Float:
    var = sigma**2 + predictive.jitter2
    return np.column_stack([var, np.zeros(len(var))])


def _squares(J: Float, C: Float) -> Float:
    """uu, vv and uv of J C J^T."""
    JC = J @ C
    return np.stack([(JC[:, i] * J[:, k]).sum(axis=1) for i, k in ((0, 0), (1, 1), (0, 1))], axis=1)


def _turned(predictive: Predictive, rows: Rows, w: Float, values: Float) -> Rows:
    """Rows of the bare polynomial, which predicts w (n, 2), under a frame."""
    model, kind = predictive.model, predictive.model.frames
    o = np.asarray(model.origin)
    M, d = frame_matrix(kind, values)
    about = w - o
    tangent = np.einsum("mab,nb->nam", frame_tangent(kind, values), about)
    eye = np.broadcast_to(np.eye(2), (len(w), 2, 2))
    return Rows(
        rows.index,
        rows.residual + w - (o + d + about @ M.T),
        rows.cov,
        np.arange(model.n_distortion),
        np.einsum("ab,nbm->nam", M, _all_columns(model, rows)),
        np.concatenate([eye, tangent], axis=2),
    )


def _all_columns(model: DistortionModel, rows: Rows) -> Float:
    """Derivatives (n, 2, n_distortion) by all polynomials and drifts."""
    out = np.zeros((len(rows.index), 2, model.n_distortion))
    out[:, :, rows.columns] = rows.jacobian
    return out


def _framed(predictive: Predictive, table: MatchTable, index: Int, frame: Frame) -> Iterator[Rows]:
    """Rows of an exposure with a frame of its own."""
    sigma = np.stack(errors_of(table), axis=1)
    spent = np.linalg.pinv(frame.information)
    n = predictive.model.n_distortion
    C = predictive.cov[:n, :n]
    for bare in _known(predictive, table, index, None):
        w = np.stack([table.u, table.v], axis=1)[bare.index] - bare.residual
        rows = _turned(predictive, bare, w, frame.values)
        assert rows.by_frame is not None
        # what the frame takes up of the solution's errors is no error of the prediction
        own = rows.jacobian - rows.by_frame @ (spent @ frame.shared)
        noise = _noise(predictive, sigma[bare.index])
        cov = noise + _squares(own, C) - _squares(rows.by_frame, spent)
        cov[:, :2] = np.maximum(cov[:, :2], 0.05 * noise[:, :2])
        yield Rows(bare.index, rows.residual, cov, rows.columns, own, rows.by_frame, frame)


def frames_for(
    predictive: Predictive, pieces: Sequence[Piece], names: Sequence[str]
) -> dict[str, Frame]:
    """Frames of exposures that the solution does not know, fitted to their own stars.

    Parameters
    ----------
    predictive : Predictive
    pieces : sequence of Piece
        Of the held-out stars; they are gone through once for every step.
    names : sequence of str

    Returns
    -------
    dict of str to Frame
        Of the exposures that have enough stars.
    """
    unknown = [name for name in names if name not in set(predictive.model.exposures)]
    if not predictive.model.n_frame or not unknown:
        return {}
    values = _first_guess(predictive, pieces, unknown)
    for step in range(SOFT + EXACT):
        sums = _frame_sums(predictive, pieces, values, soft=step < SOFT)
        for name, (gradient, curvature, *_) in sums.items():
            values[name] = values[name] + np.linalg.lstsq(curvature, gradient)[0]
    final = _frame_sums(predictive, pieces, values, soft=False)
    return {name: Frame(values[name], one[2], one[3]) for name, one in final.items()}


def _bare_of(
    predictive: Predictive, pieces: Sequence[Piece], names: Sequence[str]
) -> Iterator[tuple[str, Rows, Float, Float]]:
    """Name, rows of the bare polynomial, its prediction and the data, of some exposures."""
    for piece in pieces:
        table = piece.read()
        data = np.stack([table.u, table.v], axis=1)
        for k, name in enumerate(table.exposure_names):
            if name in names:
                for rows in _known(predictive, table, np.flatnonzero(table.exposure == k), None):
                    yield name, rows, data[rows.index] - rows.residual, data[rows.index]


def _first_guess(
    predictive: Predictive, pieces: Sequence[Piece], names: Sequence[str]
) -> dict[str, Float]:
    """Frames nearest to the linear maps that least squares finds."""
    kind, o = predictive.model.frames, np.asarray(predictive.model.origin)
    normal = {name: np.zeros((3, 3)) for name in names}
    right = {name: np.zeros((3, 2)) for name in names}
    for name, _, w, data in _bare_of(predictive, pieces, names):
        A = np.column_stack([np.ones(len(w)), w - o])
        normal[name] += A.T @ A
        right[name] += A.T @ (data - o)
    out = {}
    for name, N in normal.items():
        if N[0, 0] < STARS_PER_FRAME:
            continue
        found = np.linalg.lstsq(N, right[name])[0]
        out[name] = nearest_frame(kind, found[1:].T, found[0])
        if kind == "shift":
            out[name] = (right[name][0] - N[0, 1:]) / N[0, 0]
    return out


def _frame_sums(
    predictive: Predictive, pieces: Sequence[Piece], values: Mapping[str, Float], *, soft: bool
) -> dict[str, tuple[Float, Float, Float, Float]]:
    """Gradient, curvature, information, and what is shared with the solution, by exposure."""
    q, D = len(frame_names(predictive.model.frames)), predictive.model.n_distortion
    out = {n: (np.zeros(q), np.zeros((q, q)), np.zeros((q, q)), np.zeros((q, D))) for n in values}
    for name, bare, w, _ in _bare_of(predictive, pieces, list(values)):
        rows = _turned(predictive, bare, w, values[name])
        assert rows.by_frame is not None
        a, b = rows.cov[:, 0], rows.cov[:, 1]
        var = np.stack([a, b], axis=1)
        if soft:
            weight = 1 / (1 + (rows.residual**2 / var).sum(axis=1) / REACH)
            score = weight[:, None] * rows.residual / var
        else:
            score = scores_of(predictive, rows.residual, rows.cov).place
        # curvature as of a Gaussian of the same weights: steps never overshoot
        share = np.clip(
            (score * rows.residual).sum(axis=1)
            / np.maximum((rows.residual**2 / var).sum(axis=1), 1e-300),
            0.0,
            1.0,
        )
        A = rows.by_frame
        along = np.einsum("na,nam->nm", score, A)
        gradient, curvature, information, shared = out[name]
        gradient += along.sum(axis=0)
        curvature += np.einsum("n,na,nam,nak->mk", share, 1 / var, A, A)
        information += along.T @ along
        shared += along.T @ np.einsum("na,nam->nm", score, rows.jacobian)
    return out
