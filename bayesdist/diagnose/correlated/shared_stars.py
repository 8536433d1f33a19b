"""Errors that a star of the catalogue has in all of its exposures, their size marginalised."""

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


@dataclass(frozen=True, eq=False)
class SharedStars:
    """Errors that stars of the catalogue have in all of their matches."""

    rms: float  # of a star on an axis, in the unit of u, v; 0 where no star is matched twice
    # mean factor, over the matches, by which a star's matches determine the structure at its
    # position less than as many stars would
    repetition: float
    stars: Stars
    code: Int  # star (N,) of each match, in the order of `stars`
    curvature: Float  # minus second derivatives (3, N) uu, uv, vv of the log-likelihood

    def covariance(self, model: DistortionModel, theta: Float, formal: Float) -> Float:
        """Covariance (D, D) in excess of that by independent errors of the same size.

        `formal` (D, D) is the covariance of the parameters by their likelihood.
        """
        D = model.n_distortion  # frames change as far as they are correlated
        uu, uv, vv = self.curvature
        one = np.ones(len(self.code))
        sums = StarSums.of(self.stars, self.code, np.stack([uu, vv]), [one], uv)
        gradient = influence_by_group(model, theta, self.stars.groups, None, D)
        alike = [np.ones((int(self.code.max()) + 1, 2))]
        shared = sums.shared(gradient, alike)[0] - sums.independent(gradient, alike)
        by_scores = formal[:, :D]
        extra = self.rms**2 * by_scores @ shared @ by_scores.T
        return np.asarray((extra + extra.T) / 2)


def shared_stars(
    table: Matches, likelihood: Likelihood, model: DistortionModel, median: float
) -> SharedStars | None:
    """Size of the errors that stars have in all of their matches; None where none is repeated.

    A star with an error a in all of its matches has a summed score of mean a h, h its summed
    curvature, so that with a ~ N(0, w^2)

        log p(w) = sum over stars and axes of [g^2 w^2 / (1 + w^2 h) - log(1 + w^2 h)] / 2

    Stars that are matched once are left out: their likelihood could not separate w from a jitter.
    The table has codes of the stars; `median` is that of the half-Cauchy prior of w, in the unit of
    u, v.
    """
    stars, order = prepare(model, table)
    code = table.column("star")[order]
    n_matches = np.bincount(code)
    repeated = n_matches > 1
    if repeated.sum() < 2:
        return None
    g_u, g_v, h_uu, h_uv, h_vv = likelihood.scores(stars)
    good = (h_uu > 0) & (h_vv > 0)
    size = np.geomspace(median / RANGE, median * RANGE, STEPS)
    log_density = log_half_t(size, median)
    summed = []
    for g, h in ((g_u, h_uu), (g_v, h_vv)):
        top, bottom = (np.bincount(code[good], w[good], minlength=len(repeated)) for w in (g, h))
        summed.append(bottom)
        top, bottom = top[repeated], bottom[repeated]
        widened = 1 + size[:, None] ** 2 * bottom
        log_density = log_density + 0.5 * (
            size[:, None] ** 2 * top**2 / widened - np.log(widened)
        ).sum(axis=1)
    weight = np.exp(log_density - log_density.max())
    square = float(weight @ size**2 / weight.sum())
    curvature = np.stack([h_uu, h_uv, h_vv]) * good
    # the matches of a star share its error; one match alone would show only its own part
    rest = np.mean(summed, axis=0) * (1 - 1 / np.maximum(n_matches, 1))
    repetition = float(np.average(1 + square * rest, weights=n_matches))
    return SharedStars(float(np.sqrt(square)), repetition, stars, code, curvature)
