"""Frames of exposures that were held out whole, fitted to their own stars.

What is known of a campaign's exposures beforehand, how they scatter, goes into the fit.  With the
information F of the stars and the precision P of the scatter, the frame b is then off by a vector
of covariance (F + P)^-1, and the residuals that it leaves have, in place of Sigma + A P^-1 A^T,
the covariance Sigma - A (F + P)^-1 A^T; P is zero where nothing is known.  That holds for weights
that are the inverse of Sigma, the errors of the stars without those of the solution.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import Matches
from bayesdist.diagnose.holdout.predictive import Predictive, scores_of
from bayesdist.infer.stars.stars import errors_of
from bayesdist.model import DistortionModel, Groups
from bayesdist.model.frames import RIGID, frame_names, nearest_frame

__all__ = ["AT_ONCE", "Bare", "Frame", "framed", "frames_for", "noise_of"]

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
    names : tuple of str, length q
        Of its parameters, deviations of single chips among them.
    values : ndarray, shape (q,)
    spent : ndarray, shape (q, q)
        Covariance of their errors: inverse of what its stars and the scatter say of it.
    shared : ndarray, shape (q, n)
        What its stars say of it and of the solution's polynomials and drift together.
    precision : ndarray, shape (q,)
        What the scatter says of each.
    n : int
        Stars.
    """

    names: tuple[str, ...]
    values: Float
    spent: Float
    shared: Float
    precision: Float
    n: int


@dataclass(frozen=True, eq=False)
class Bare:
    """Stars of one exposure and chip under a frame that belongs to no solution.

    Parameters
    ----------
    index : ndarray of int, shape (n,)
        Rows of their table.
    residual : ndarray, shape (n, 2)
        Data minus prediction.
    by_solution : ndarray, shape (n, 2, n_distortion)
        Derivatives of the prediction by polynomials and drift.
    by_frame : ndarray, shape (n, 2, q)
    matrix : ndarray, shape (2, 2)
        Linear part of the frame.
    """

    index: Int
    residual: Float
    by_solution: Float
    by_frame: Float
    matrix: Float


def noise_of(predictive: Predictive, table: Matches, index: Int) -> Float:
    """uu, vv and uv (n, 3) of the errors of stars without those of the solution's parameters."""
    var = np.stack(errors_of(table), axis=1)[index] ** 2 + predictive.jitter2
    if predictive.local and not predictive.local_in_noise:
        place = (table.x[index], table.y[index], table.chip_number[index])
        var = var + predictive.local_variance(*place)[:, None]
    return np.column_stack([var, np.zeros(len(var))])


def _alone(model: DistortionModel) -> DistortionModel:
    """The model of one exposure, behind another one that defines the gauge and has no stars."""
    return replace(model, exposures=("(release)", "(held out)"))


def framed(predictive: Predictive, table: Matches, index: Int, values: Float) -> Iterator[Bare]:
    """Rows of an exposure under a frame, chip by chip and date by date.

    Parameters
    ----------
    predictive : Predictive
    table : Matches
    index : ndarray of int, shape (n,)
        Rows of one exposure.
    values : ndarray, shape (q,)
        Of the frame.

    Yields
    ------
    Bare
    """
    model, n = _alone(predictive.model), predictive.model.n_distortion
    theta = np.zeros(model.n_params)
    theta[:n] = predictive.mean[:n]
    own = model.frame_slice(1)
    theta[own] = values
    groups = _groups(model, table, index, exposure=1)
    effective = model.effective(theta, groups)
    jacobians = model.effective_jacobian(theta, groups)
    matrix, _ = model.frame(theta, 1)
    data = np.stack([table.u, table.v], axis=1)
    for g, members in enumerate(groups.members()):
        columns, d = jacobians[g]
        basis = model.basis(model.chips[groups.chip[g]].number)
        for start in range(0, len(members), AT_ONCE):
            rows = index[members[start : start + AT_ONCE]]
            phi = basis.evaluate(table.x[rows], table.y[rows])
            derivative = np.zeros((len(rows), 2, model.n_params))
            derivative[:, :, columns] = np.einsum("nk,akm->nam", phi, d)
            yield Bare(
                rows,
                data[rows] - phi @ effective[g].T,
                derivative[:, :, :n],
                derivative[:, :, own],
                matrix,
            )


def _groups(model: DistortionModel, table: Matches, index: Int, *, exposure: int | None) -> Groups:
    return model.groups(
        len(index),
        epoch=None if table.epoch is None else table.epoch[index],
        exposure=exposure,
        chip=table.chip_number[index],
    )


def frames_for(predictive: Predictive, held: Matches, names: Sequence[str]) -> dict[str, Frame]:
    """Frames of exposures that the solution does not know, fitted to their own stars.

    Parameters
    ----------
    predictive : Predictive
    held : Matches
        Held-out stars; they are read once for every step.
    names : sequence of str

    Returns
    -------
    dict of str to Frame
        Of the exposures that have enough stars.
    """
    unknown = [name for name in names if name not in set(predictive.model.exposures)]
    if not predictive.model.n_frame or not unknown:
        return {}
    model = _alone(predictive.model)
    kinds = model.free_frame_names(1)
    precision = np.zeros(len(kinds))
    if predictive.deviations is not None:
        precision = predictive.deviations.precision(kinds)
    values = _first_guess(predictive, held, unknown, precision)
    for step in range(SOFT + EXACT):
        sums = _frame_sums(predictive, held, values, soft=step < SOFT)
        for name, (gradient, curvature, *_) in sums.items():
            pull = gradient - precision * values[name]
            values[name] = values[name] + _solved(curvature + np.diag(precision), pull)
    final = _frame_sums(predictive, held, values, soft=False)
    return {
        name: Frame(
            kinds,
            values[name],
            _inverse(information + np.diag(precision)),
            shared,
            precision,
            n,
        )
        for name, (_, _, information, shared, n) in final.items()
    }


def _unit(matrix: Float) -> Float:
    """Scales that bring a diagonal to one: shears and shifts have units far apart."""
    diagonal = np.diag(matrix)
    return np.where(diagonal > 0, 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 0.0)


def _solved(matrix: Float, right: Float) -> Float:
    s = _unit(matrix)
    return np.asarray(s * np.linalg.lstsq(s[:, None] * matrix * s, s * right)[0])


def _inverse(matrix: Float) -> Float:
    s = _unit(matrix)
    return np.asarray(s[:, None] * np.linalg.pinv(s[:, None] * matrix * s) * s)


def _of_exposures(held: Matches, names: Sequence[str]) -> Iterator[tuple[str, Matches, Int]]:
    """Name, table and rows of some exposures."""
    for table in held.batches():
        for k, name in enumerate(table.exposure_names):
            if name in names:
                rows = np.flatnonzero(table.exposure == k)
                if len(rows):
                    yield name, table, rows


def _first_guess(
    predictive: Predictive, held: Matches, names: Sequence[str], precision: Float
) -> dict[str, Float]:
    """Frames nearest to the linear maps that least squares finds."""
    model = predictive.model
    kind, o = model.frames, np.asarray(model.origin)
    normal = {name: np.zeros((3, 3)) for name in names}
    right = {name: np.zeros((3, 2)) for name in names}
    for name, table, rows in _of_exposures(held, names):
        groups = _groups(model, table, rows, exposure=None)
        effective = model.effective(predictive.mean, groups)
        for g, members in enumerate(groups.members()):
            index = rows[members]
            basis = model.basis(model.chips[groups.chip[g]].number)
            w = basis.evaluate(table.x[index], table.y[index]) @ effective[g].T
            A = np.column_stack([np.ones(len(w)), w - o])
            normal[name] += A.T @ A
            right[name] += A.T @ (np.stack([table.u, table.v], axis=1)[index] - o)
    out = {}
    for name, N in normal.items():
        if N[0, 0] < STARS_PER_FRAME:
            continue
        found = np.linalg.lstsq(N, right[name])[0]
        frame = nearest_frame(kind, found[1:].T, found[0])
        if kind == "shift":
            frame = (right[name][0] - N[0, 1:]) / N[0, 0]
        values = np.zeros(len(precision))
        for k, part in enumerate(frame_names(kind)):
            # what scatters begins at its mean; where the telescope pointed is anything
            values[k] = frame[k] if part in RIGID or not precision[k] else 0.0
        out[name] = values
    return out


def _frame_sums(
    predictive: Predictive, held: Matches, values: Mapping[str, Float], *, soft: bool
) -> dict[str, tuple[Float, Float, Float, Float, int]]:
    """Gradient, curvature, information, what is shared with the solution, stars, by exposure."""
    q, D = _alone(predictive.model).n_frame, predictive.model.n_distortion
    shapes = ((q,), (q, q), (q, q), (q, D))
    out = {name: [np.zeros(shape) for shape in shapes] for name in values}
    count = dict.fromkeys(values, 0)
    for name, table, index in _of_exposures(held, list(values)):
        for rows in framed(predictive, table, index, values[name]):
            var = noise_of(predictive, table, rows.index)[:, :2]
            if soft:
                weight = 1 / (1 + (rows.residual**2 / var).sum(axis=1) / REACH)
                score = weight[:, None] * rows.residual / var
            else:
                cov = np.column_stack([var, np.zeros(len(var))])
                score = scores_of(predictive, rows.residual, cov).place
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
            shared += along.T @ np.einsum("na,nam->nm", score, rows.by_solution)
            count[name] += len(rows.index)
    return {name: (a, b, c, d, count[name]) for name, (a, b, c, d) in out.items()}
