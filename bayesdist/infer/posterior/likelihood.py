"""Gradient and curvature of each star's log-likelihood by its position, at a solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import InputError
from bayesdist.infer import kernel
from bayesdist.infer.kernel import GAUSSIAN, Constants
from bayesdist.infer.linear import Clip
from bayesdist.infer.posterior.memberships import sampled_points, star_averages
from bayesdist.infer.posterior.posterior import Posterior
from bayesdist.infer.stars.stars import Stars
from bayesdist.infer.transforms import Solution

__all__ = ["Scores", "scores_of"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scores:
    """Likelihood of a star at one point: a mixture, or least squares with rejection."""

    theta: Float
    clip: Clip | None  # limits of least squares
    constants: Constants | None  # of the mixture at one point

    def of(self, stars: Stars) -> Float:
        """Gradient by the model's u and v, and minus the second derivatives uu, uv, vv: (5, N)."""
        if self.constants is not None and (circle := stars.circle(self.constants)):
            return kernel.truncated_scores(
                stars.blocks,
                stars.columns,
                circle,
                stars.powers(self.theta),
                stars.model.order,
                self.constants,
            )
        r = stars.residuals(self.theta).T
        if self.constants is None:
            assert self.clip is not None
            used = self.clip.keeps_of(stars)
            w_u, w_v = used / stars.var_u, used / stars.var_v
            return np.stack([w_u * r[0], w_v * r[1], w_u, np.zeros(len(stars)), w_v])
        p = star_averages(stars, self.theta[None], self.constants)[0]
        j2, out = self.constants.j2[0], self.constants.out[0]
        outlier = 1 / out if self.constants.kind == GAUSSIAN else 0.0
        w = np.stack([1 / (stars.var_u + j2), 1 / (stars.var_v + j2)])
        mean = (1 - p) * w + p * outlier
        # derivative of the membership by position
        turn = (outlier - w) * r
        uu, vv = mean - p * (1 - p) * turn**2
        return np.stack([*(mean * r), uu, -p * (1 - p) * turn[0] * turn[1], vv])


def scores_of(solution: Solution) -> Scores:
    """Likelihood of a Posterior, LinearFit or HierarchicalFit, at its mean.

    The mixture of a posterior is taken at the mean of its sampled coordinates: location and scale
    of a symmetric density are nearly independent.  InputError for solutions made from others: a
    view has neither the mixture nor the clipping.
    """
    theta = np.asarray(solution.mean, float)
    if isinstance(solution, Posterior):
        _, h = sampled_points(solution)
        hyper = solution.mixture.bind(solution.reference_sigma)
        return Scores(theta, None, hyper.constants(h.mean(axis=0)[None]))
    clip = getattr(solution, "clip", None)
    if clip is None:
        raise InputError(
            f"a {type(solution).__name__} does not say how it was fitted",
            where="solution",
            do="give the fit or the posterior itself, and make views of the result",
        )
    return Scores(theta, clip, None)
