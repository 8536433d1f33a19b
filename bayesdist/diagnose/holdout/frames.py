"""Frames of exposures that were held out entirely, fitted to their stars.

The prior on a campaign's exposures, their scatter, enters the fit.  Let F be the information of the
stars, P the precision of the scatter, A the derivatives of positions with respect to the frame, and
Sigma the errors of the stars without those of the solution.  The error of the fitted frame then has
the covariance (F + P)^-1, and the residuals have the covariance Sigma - A (F + P)^-1 A^T instead of
Sigma + A P^-1 A^T.  P is zero without a prior.  The result holds if the weights are the inverse of
Sigma.
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

SOFT, EXACT = 10, 6  # number of steps with long-tailed weights, and with those of the mixture
REACH = 4.0  # chi-square at which the long-tailed weight is one half
STARS_PER_FRAME = 20


@dataclass(frozen=True, eq=False)
class Frame:
    """Frame of an exposure that was held out entirely."""

    names: tuple[str, ...]  # names of its parameters, including deviations of single chips
    values: Float  # (q,)
    # (q, q) covariance of their errors: inverse of the information from the stars and the prior
    spent: Float
    # (q, n) information between the frame and the solution's polynomials and drift
    shared: Float
    precision: Float  # (q,) prior precision of each parameter from the scatter
    n: int  # number of stars


def _alone(model: DistortionModel) -> DistortionModel:
    """Model of one exposure, after a dummy exposure that defines the gauge and has no stars."""
    return replace(model, exposures=("(release)", "(held out)"))


def framed(
    predictive: Predictive, table: Matches, index: Int, values: Float
) -> Iterator[tuple[Prediction, Float, Float]]:
    """Iterate over rows (n,) of one exposure, predicted with a frame of given parameters (q,).

    Each item contains the prediction and the derivatives (n, 2, n_distortion) with respect to
    polynomials and drift, and (n, 2, q) with respect to the frame.
    """
    model, n = _alone(predictive.model), predictive.model.n_distortion
    theta = np.zeros(model.n_params)
    theta[:n] = predictive.mean[:n]
    frame_columns = model.frame_slice(1)
    theta[frame_columns] = values
    for prediction in predictions(model, theta, table, index, 1):
        derivative = np.zeros((len(prediction.index), 2, model.n_params))
        derivative[:, :, prediction.columns] = prediction.jacobian
        yield prediction, derivative[:, :, :n], derivative[:, :, frame_columns]


def frames_for(predictive: Predictive, held: Matches, names: Sequence[str]) -> dict[str, Frame]:
    """Fit frames to exposures that the solution does not include, using their stars.

    The held-out stars are read once per step.  Exposures with too few stars are left out.
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
    """Iterate over name, table and rows of the given exposures."""
    for table in held.batches():
        for k, name in enumerate(table.exposure_names):
            if name in names:
                rows = np.flatnonzero(table.exposure == k)
                if len(rows):
                    yield name, table, rows


def _first_guess(
    predictive: Predictive, held: Matches, names: Sequence[str], precision: Float
) -> dict[str, Float]:
    """Frames nearest to the linear maps from a least-squares fit."""
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
        coefficients = np.linalg.lstsq(N, right[name])[0]
        frame = nearest_frame(kind, coefficients[1:].T, coefficients[0])
        if kind == "shift":
            frame = (right[name][0] - N[0, 1:]) / N[0, 0]
        values = np.zeros(len(precision))
        for k, part in enumerate(frame_names(kind)):
            # start parameters with a prior at its mean; the pointing has none
            values[k] = frame[k] if part in RIGID or not precision[k] else 0.0
        out[name] = values
    return out


def _frame_sums(
    predictive: Predictive, held: Matches, values: Mapping[str, Float], *, soft: bool
) -> dict[str, tuple[Float, Float, Float, Float, int]]:
    """Gradient, curvature, information, cross-information with the solution and number of stars.

    Returns them by the name of the exposure.  `soft` selects the long-tailed weights.
    """
    q, D = _alone(predictive.model).n_frame, predictive.model.n_distortion
    shapes = ((q,), (q, q), (q, q), (q, D))
    out = {name: [np.zeros(shape) for shape in shapes] for name in values}
    count = dict.fromkeys(values, 0)
    for name, table, index in _of_exposures(held, list(values)):
        for prediction, by_solution, A in framed(predictive, table, index, values[name]):
            residual, noise = prediction.residual, noise_of(predictive, table, prediction.index)
            var = noise[:, :2]
            chi2 = (residual**2 / var).sum(axis=1)
            if soft:
                score = residual / var / (1 + chi2 / REACH)[:, None]
            else:
                score = scores_of(predictive, residual, noise).place
            # curvature of a Gaussian with the same weights, so that steps never overshoot
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
