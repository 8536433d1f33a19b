"""Errors that a star of the catalogue has in all of its exposures, with their size marginalised."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.diagnose.correlated.priors import log_half_t
from bayesdist.infer.catalogue.star_sums import StarSums, influence_by_group
from bayesdist.infer.stars.likelihood import Likelihood
from bayesdist.infer.stars.stars import Stars, prepare
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int

STEPS = 60
RANGE = 300.0
NEGLIGIBLE = 1e-8  # density relative to the maximum
MIN_FREE = 0.1  # smallest fraction of the stars' errors that remains after the fit


@dataclass(frozen=True, eq=False)
class SharedStars:
    """Errors that stars of the catalogue have in all of their matches."""

    rms: float  # per star and axis, in the unit of u and v; 0 if no star is matched twice
    # (N,) factor, in the order of the table, by which the matches of a star determine the structure
    # at its position less well than matches of different stars
    repetition: Float
    stars: Stars
    code: Int  # (N,) star of each match, in the order of `stars`
    curvature: Float  # (3, N) minus the second derivatives uu, uv, vv of the log-likelihood

    def covariance(self, model: DistortionModel, theta: Float, formal: Float) -> Float:
        """Covariance (D, D) in excess of that due to independent errors of the same size.

        `formal` (D, D) is the covariance of the parameters from their likelihood.
        """
        D = model.n_distortion  # frames change according to their correlation with these
        uu, uv, vv = self.curvature
        unit_weights = np.ones(len(self.code))
        sums = StarSums.of(self.stars, self.code, np.stack([uu, vv]), [unit_weights], uv)
        gradient = influence_by_group(model, theta, self.stars.groups, None, D)
        alike = [np.ones((int(self.code.max()) + 1, 2))]
        shared = sums.shared(gradient, alike)[0] - sums.independent(gradient, alike)
        by_scores = formal[:, :D]
        extra = self.rms**2 * by_scores @ shared @ by_scores.T
        return np.asarray((extra + extra.T) / 2)


def shared_stars(
    table: Matches, code: Int, likelihood: Likelihood, model: DistortionModel, median: float
) -> SharedStars | None:
    """Size of the errors that stars have in all of their matches.

    None if stars have one match each.

    The likelihood includes the variance 1 / h_i of each match, from quoted errors and jitter, of
    which the shared error is a part.  The summed score g of a star, with matches that share a
    variance w^2, then has the variance h (1 + w^2 k), where h is the sum of the h_i and k = h - sum
    h_i^2 / h, so that

        log p(w) = sum over stars and axes of [g^2 / h w^2 k / (1 + w^2 k) - log(1 + w^2 k)] / 2

    Stars with a single match are left out because k is 0.  `code` (N,) is the star of each match,
    or the tight group of stars; `median` is that of the half-Cauchy prior of w, in the unit of u
    and v.
    """
    stars, order = prepare(model, table)
    code = np.unique(code[order], return_inverse=True)[1]
    n_matches = np.bincount(code)
    repeated = n_matches > 1
    if repeated.sum() < 2:
        return None
    g_u, g_v, h_uu, h_uv, h_vv = likelihood.scores(stars)
    good = (h_uu > 0) & (h_vv > 0)
    # correction for the part of the stars' errors that the fit has absorbed
    free = 1 - min(model.n_params / (2 * len(repeated)), 1 - MIN_FREE)
    squares, k_of_stars = [], []  # squared scores over curvature, (n_stars,), and k of each star
    for g, h in ((g_u, h_uu), (g_v, h_vv)):
        top, bottom, sums = (
            np.bincount(code[good], w[good], minlength=len(repeated)) for w in (g, h, h**2)
        )
        bottom = np.maximum(bottom, 1e-300)
        squares.append(top**2 / bottom / free)
        k_of_stars.append(np.maximum(bottom - sums / bottom, 0.0))
    square, k = (
        np.concatenate([z[repeated] for z in per_axis]) for per_axis in (squares, k_of_stars)
    )
    low, high = median / RANGE, median * RANGE
    # second pass where the density is: many stars determine the size to a few per cent
    for _ in range(2):
        size = np.geomspace(low, high, STEPS)
        widening = size[:, None] ** 2 * k
        log_density = log_half_t(size, median) + 0.5 * (
            square * widening / (1 + widening) - np.log1p(widening)
        ).sum(axis=1)
        weight = np.exp(log_density - log_density.max())
        likely = np.flatnonzero(weight > NEGLIGIBLE)
        low, high = size[max(likely[0] - 1, 0)], size[min(likely[-1] + 1, STEPS - 1)]
    variance = float(weight @ size**2 / weight.sum())
    repetition = np.empty(len(order))
    repetition[order] = (1 + variance * np.mean(k_of_stars, axis=0))[code]
    curvature = np.stack([h_uu, h_uv, h_vv]) * good
    return SharedStars(float(np.sqrt(variance)), repetition, stars, code, curvature)
