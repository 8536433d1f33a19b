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

from bayesdist.data.matches import Matches
from bayesdist.diagnose.holdout.predictive import (
    Prediction,
    Predictive,
    groups_of,
    noise_of,
    predictions,
    scores_of,
)
from bayesdist.infer.equations.scaled import determined
from bayesdist.model import DistortionModel
from bayesdist.model.frames import RIGID, frame_names, nearest_frame
from bayesdist.utils.arrays import Float, Int

SOFT, EXACT = 10, 6  # steps with weights that reach far, and with those of the mixture
REACH = 4.0  # chi-square at which the former are one half
STARS_PER_FRAME = 20


@dataclass(frozen=True, eq=False)
class Frame:
    """Frame of an exposure that was held out whole."""

    names: tuple[str, ...]  # of its parameters, deviations of single chips among them
    values: Float  # (q,)
    # (q, q) covariance of their errors: inverse of what its stars and the scatter say of it
    spent: Float
    # (q, n) what its stars say of it and of the solution's polynomials and drift together
    shared: Float
    precision: Float  # (q,) what the scatter says of each
    n: int  # stars


def _alone(model: DistortionModel) -> DistortionModel:
    """Model of one exposure, behind another one that defines the gauge and has no stars."""
    return replace(model, exposures=("(release)", "(held out)"))


def framed(
    predictive: Predictive, table: Matches, index: Int, values: Float
) -> Iterator[tuple[Prediction, Float, Float]]:
    """Iterator over rows (n,) of one exposure under a frame of its own, by its parameters (q,).

    With derivatives (n, 2, n_distortion) by polynomials and drift, and (n, 2, q) by the frame.
    """
    model, n = _alone(predictive.model), predictive.model.n_distortion
    theta = np.zeros(model.n_params)
    theta[:n] = predictive.mean[:n]
    own = model.frame_slice(1)
    theta[own] = values
    for one in predictions(model, theta, table, index, 1):
        derivative = np.zeros((len(one.index), 2, model.n_params))
        derivative[:, :, one.columns] = one.jacobian
        yield one, derivative[:, :, :n], derivative[:, :, own]


def frames_for(predictive: Predictive, held: Matches, names: Sequence[str]) -> dict[str, Frame]:
    """Frames of exposures that the solution does not know, fitted to their own stars.

    The held-out stars are read once for every step. Exposures with too few stars are left out.
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
            root = determined(curvature + np.diag(precision))
            values[name] = values[name] + root @ (root.T @ pull)
    final = _frame_sums(predictive, held, values, soft=False)
    out = {}
    for name, (_, _, information, shared, n) in final.items():
        root = determined(information + np.diag(precision))
        out[name] = Frame(kinds, values[name], root @ root.T, shared, precision, n)
    return out


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
        groups = groups_of(model, table, rows, None)
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
        for one, by_solution, A in framed(predictive, table, index, values[name]):
            residual, noise = one.residual, noise_of(predictive, table, one.index)
            var = noise[:, :2]
            chi2 = (residual**2 / var).sum(axis=1)
            if soft:
                score = residual / var / (1 + chi2 / REACH)[:, None]
            else:
                score = scores_of(predictive, residual, noise).place
            # curvature as of a Gaussian of the same weights: steps never overshoot
            share = (score * residual).sum(axis=1) / np.maximum(chi2, 1e-300)
            share = np.clip(share, 0.0, 1.0)
            along = np.einsum("na,nam->nm", score, A)
            gradient, curvature, information, shared = out[name]
            gradient += along.sum(axis=0)
            curvature += np.einsum("n,na,nam,nak->mk", share, 1 / var, A, A)
            information += along.T @ along
            shared += along.T @ np.einsum("na,nam->nm", score, by_solution)
            count[name] += len(residual)
    return {name: (a, b, c, d, count[name]) for name, (a, b, c, d) in out.items()}
