"""Errors that a star of the catalogue has in all of its exposures, their size marginalised."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import MatchTable
from bayesdist.infer.discrepancy.priors import log_half_cauchy
from bayesdist.infer.robust.scores import Scores
from bayesdist.infer.stars import prepare
from bayesdist.model import DistortionModel

__all__ = ["shared_star_errors"]

Float = NDArray[np.float64]

STEPS = 60
RANGE = 300.0


def shared_star_errors(
    table: MatchTable, scores: Scores, covariance: Float, model: DistortionModel, median: float
) -> tuple[Float, float]:
    """What is added to the covariance of the parameters, and the rms error of a star on an axis.

    A star with an error a of its own in all of its matches has a summed score of mean a h, h its
    summed curvature, so that with a ~ N(0, w^2)

        log p(w) = sum over stars and axes of [g^2 w^2 / (1 + w^2 h) - log(1 + w^2 h)] / 2

    in which stars that are matched once say nothing that a jitter would not say as well, and are
    left out.

    Parameters
    ----------
    table : MatchTable
        Matches with codes of the stars.
    scores : Scores
        Of the solution.
    covariance : ndarray, shape (D, D)
        Of its parameters, by its likelihood.
    model : DistortionModel
    median : float
        Of the half-Cauchy prior of w, in the unit of u, v.

    Returns
    -------
    covariance : ndarray, shape (D, D)
        Beyond what errors of the same size that are independent from match to match would do.
    rms : float
    """
    assert table.star is not None
    stars, order = prepare(model, table)
    code = table.star[order]
    repeated = np.bincount(code) > 1
    if repeated.sum() < 2:
        return np.zeros_like(covariance), 0.0
    g_u, g_v, h_uu, h_uv, h_vv = scores.of(stars)
    good = (h_uu > 0) & (h_vv > 0)
    size = np.geomspace(median / RANGE, median * RANGE, STEPS)
    log_density = log_half_cauchy(size, median)
    for g, h in ((g_u, h_uu), (g_v, h_vv)):
        top, bottom = (
            np.bincount(code[good], w[good], minlength=len(repeated))[repeated] for w in (g, h)
        )
        widened = 1 + size[:, None] ** 2 * bottom
        log_density = log_density + 0.5 * (
            size[:, None] ** 2 * top**2 / widened - np.log(widened)
        ).sum(axis=1)
    weight = np.exp(log_density - log_density.max())
    square = float(weight @ size**2 / weight.sum())

    D = model.n_distortion  # frames follow as they are correlated
    together = np.zeros((len(repeated), D, 2))
    alone = np.zeros((D, D))
    curvature = np.stack([h_uu, h_uv, h_uv, h_vv], axis=1).reshape(-1, 2, 2) * good[:, None, None]
    jacobians = model.effective_jacobian(scores.theta, stars.groups)
    for g, (columns, derivative) in enumerate(jacobians):
        rows = slice(stars.starts[g], stars.starts[g + 1])
        own = columns < D
        phi = model.basis(model.chips[stars.groups.chip[g]].number).evaluate_scaled(
            stars.X[rows], stars.Y[rows]
        )
        pull = np.einsum(
            "nk,nab,bkm->nma", phi, curvature[rows], derivative[:, :, own], optimize=True
        )
        columns = columns[own]
        alone[np.ix_(columns, columns)] += np.einsum("nma,nla->ml", pull, pull, optimize=True)
        np.add.at(together, (code[rows][:, None], columns), pull)
    shared = np.einsum("sma,sla->ml", together, together, optimize=True)
    by_scores = covariance[:, :D]
    extra = square * by_scores @ (shared - alone) @ by_scores.T
    return (extra + extra.T) / 2, float(np.sqrt(square))
