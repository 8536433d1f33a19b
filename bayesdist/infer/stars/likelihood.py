"""Likelihood of single stars at a solution: Gaussian with rejection, or outlier mixture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.infer import kernel
from bayesdist.infer.kernel import GAUSSIAN, Constants
from bayesdist.infer.stars.stars import Stars, in_table_order, prepare
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Bool, Float


class Likelihood(Protocol):
    """Likelihood of single stars at one parameter vector."""

    @property
    def theta(self) -> Float:
        """The parameter vector (D,)."""

    def scores(self, stars: Stars) -> Float:
        """Derivatives of the log-likelihood with respect to the model position, shape (5, N).

        The rows are the first derivatives in u and v, and minus the second derivatives uu, uv, vv.
        """

    def inliers(self, stars: Stars) -> Float:
        """Probability (N,) that each star is a true match."""

    def variances(self, stars: Stars) -> Float:
        """Variances (2, N) of true matches along u and v."""


@dataclass(frozen=True, eq=False)
class Clip:
    """Rejection limits for the residuals from the first pass of a fit."""

    theta: Float  # parameters (D,) of the first pass
    chi2_limit: float  # largest chi-square of a star (sum over both axes)
    abs_limit: float  # largest radial residual, in the unit of u, v

    def keeps(self, model: DistortionModel, matches: Matches) -> Bool:
        """Boolean mask (N,) that is True for matches within both limits, in table order."""
        stars, order = prepare(model, matches)
        return in_table_order(self.keeps_of(stars), order).astype(bool)

    def keeps_of(self, stars: Stars) -> Bool:
        """Boolean mask (N,) that is True for prepared stars within both limits."""
        residual = stars.residuals(self.theta)
        chi2 = residual[:, 0] ** 2 / stars.var_u + residual[:, 1] ** 2 / stars.var_v
        r2 = (residual**2).sum(axis=1)
        return np.asarray((chi2 <= self.chi2_limit) & (r2 <= self.abs_limit**2))


@dataclass(frozen=True, eq=False)
class ClippedGaussian:
    """Gaussian likelihood of the stars within the rejection limits of a two-pass fit."""

    theta: Float
    clip: Clip

    def scores(self, stars: Stars) -> Float:
        """Derivatives of the log-likelihood (see `Likelihood.scores`); zero for rejected stars."""
        r = stars.residuals(self.theta).T
        used = self.clip.keeps_of(stars)
        w_u, w_v = used / stars.var_u, used / stars.var_v
        return np.stack([w_u * r[0], w_v * r[1], w_u, np.zeros(len(stars)), w_v])

    def inliers(self, stars: Stars) -> Float:
        """1 for stars within the limits, 0 for rejected stars; shape (N,)."""
        return self.clip.keeps_of(stars).astype(float)

    def variances(self, stars: Stars) -> Float:
        """Variances (2, N) from the quoted errors."""
        return np.stack([stars.var_u, stars.var_v])


@dataclass(frozen=True, eq=False)
class MixtureAt:
    """Outlier mixture with one set of hyperparameters."""

    theta: Float
    constants: Constants

    def scores(self, stars: Stars) -> Float:
        """Derivatives of the log-likelihood; see `Likelihood.scores`."""
        if circle := stars.circle(self.constants):
            return kernel.truncated_scores(
                stars.blocks,
                stars.columns,
                circle,
                stars.powers(self.theta),
                stars.model.order,
                self.constants,
            )
        r = stars.residuals(self.theta).T
        p = star_averages(stars, self.theta[None], self.constants)[0]
        j2, out = self.constants.j2[0], self.constants.out[0]
        outlier = 1 / out if self.constants.kind == GAUSSIAN else 0.0
        w = np.stack([1 / (stars.var_u + j2), 1 / (stars.var_v + j2)])
        mean = (1 - p) * w + p * outlier
        # derivative of log(core / outlier) with respect to the residual
        turn = (outlier - w) * r
        uu, vv = mean - p * (1 - p) * turn**2
        return np.stack([*(mean * r), uu, -p * (1 - p) * turn[0] * turn[1], vv])

    def inliers(self, stars: Stars) -> Float:
        """Probability (N,) that each star belongs to the core of the mixture."""
        return 1.0 - star_averages(stars, self.theta[None], self.constants)[0]

    def variances(self, stars: Stars) -> Float:
        """Variances (2, N) from the quoted errors and the jitter."""
        return np.stack([stars.var_u, stars.var_v]) + self.constants.j2[0]


def star_averages(stars: Stars, theta: Float, constants: Constants) -> Float:
    """Outlier probability, log-likelihood and its square per star (3, N), averaged over n draws.

    `theta` is (n, D), and `constants` belong to the n draws.
    """
    return np.asarray(_by_star(stars, theta, constants, len(theta))[0])


def star_log_likelihoods(stars: Stars, theta: Float, constants: Constants) -> Float:
    """Log-likelihood (n, N) of each star for draws theta (n, D) with the given constants."""
    return np.asarray(_by_star(stars, theta, constants, 1)[:, 1])


def _by_star(stars: Stars, theta: Float, constants: Constants, each: int) -> Float:
    powers, order = stars.powers(theta), stars.model.order
    if circle := stars.circle(constants):
        return kernel.truncated_memberships(
            stars.blocks, stars.columns, circle, powers, order, constants, each
        )
    return kernel.memberships(stars.blocks, stars.columns, powers, order, constants, each)


def log_densities(square: Float, var: Float, f: float, wide: float) -> tuple[Float, Float]:
    """Log densities (N,) of the stars as true matches and as false matches, up to a constant.

    `square` (2, N) are squared residuals and `var` (2, N) the variances of true matches.  A
    fraction `f` of the matches is false, with the variance `wide` on each axis.
    """
    log_good = np.log1p(-f) - 0.5 * (square / var + np.log(var)).sum(axis=0)
    return log_good, np.log(f) - 0.5 * (square / wide).sum(axis=0) - np.log(wide)


def good_probability(square: Float, var: Float, f: float, wide: float) -> Float:
    """Probability (N,) that each star is a true match; see `log_densities` for the arguments."""
    log_good, log_bad = log_densities(square, var, f, wide)
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * (log_good - log_bad))))
