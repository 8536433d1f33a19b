"""The posterior density as a function of the parameters, evaluated for many points at once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from bayesdist.infer import kernel
from bayesdist.infer.equations.arrow import Arrow
from bayesdist.infer.equations.normal import mixture
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.kernel import Constants
from bayesdist.infer.stars.likelihood import HYPER_NAMES, Hyper, OutlierMixture
from bayesdist.infer.stars.shards import Shards
from bayesdist.infer.stars.stars import Stars
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float

SCRATCH = 32_000_000  # bytes of effective coefficients in memory at a time


class Density(Protocol):
    """Density of psi = (theta, hyperparameters) that can be sampled."""

    @property
    def n_theta(self) -> int:
        """Number of parameters in theta, that is, without the hyperparameters."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """Names of psi."""
        ...

    def log_density(self, psi: Float) -> Float:
        """Log density (n,) of points psi (n, D); minus infinity outside the support."""
        ...


@dataclass(frozen=True, eq=False)
class Target:
    """Posterior density of psi = (theta, hyperparameters).

    Raises InputError if a star is outside its match circle.
    """

    shards: Shards
    mixture: OutlierMixture
    priors: GaussianPriors

    def __post_init__(self) -> None:
        self.shards.survey.check_circle(self.mixture.match_radius)

    @property
    def model(self) -> DistortionModel:
        """The distortion model."""
        return self.shards.model

    @cached_property
    def hyper(self) -> Hyper:
        """Likelihood terms and priors of the hyperparameters."""
        return self.mixture.bind(self.shards.survey.reference_sigma)

    @property
    def n_theta(self) -> int:
        """Number of distortion parameters."""
        return self.model.n_params

    @property
    def names(self) -> tuple[str, ...]:
        """Names of psi."""
        return self.model.names + self.hyper.names

    def log_density(self, psi: Float) -> Float:
        """Log posterior (n,) of points (n, D), up to a constant, in one pass over the data.

        The result is minus infinity for points that are not finite or outside the support.
        """
        ok = np.isfinite(psi).all(axis=1)
        out = np.full(len(psi), -np.inf)
        theta, h = psi[ok, : self.n_theta], psi[ok, self.n_theta :]
        if not len(theta):
            return out
        value = self.priors.log_density(theta) + self.hyper.log_prior(h)
        value += self.shards.sum(log_likelihood, theta, self.hyper.constants(h))
        out[ok] = np.where(np.isnan(value), -np.inf, value)
        return out

    def expand(self, psi: Float, *, em: bool = False) -> tuple[float, Float, Arrow]:
        """Value, gradient (D,) and minus the Hessian of the log posterior at a point (D,).

        The Hessian may be indefinite away from the mode.  If `em` is True, it is computed with EM
        weights, which make the distortion part positive semidefinite.  The computation takes one
        pass over the data.
        """
        model = self.model
        theta, h = psi[: self.n_theta], psi[self.n_theta :]
        constants = self.hyper.constants(h[None])
        sums = self.shards.sum(mixture, theta, constants, em)
        loglik, by_j, n_outliers, by_s, jj, jf, js, ff, fs, ss = sums.scalars
        by_f = n_outliers - len(self.shards) * float(np.exp(constants.log_f[0]))
        sampled = [tuple(HYPER_NAMES).index(name) for name in self.mixture.hyper]
        by_hyper = np.array([by_j, by_f, by_s])[sampled]
        curvature = np.array([[jj, jf, js], [jf, ff, fs], [js, fs, ss]])[np.ix_(sampled, sampled)]

        by_hyper, curvature, chain = self.hyper.chained(h, by_hyper, curvature)
        prior_gradient, prior_curvature = self.hyper.prior_terms(h)
        curvature = curvature + prior_curvature
        sums = replace(sums, cross=np.einsum("ghak,hi->giak", sums.cross[:, sampled], chain))
        matrix, right = sums.assemble(model, theta)
        gradient = np.concatenate([right + self.priors.pull(theta), by_hyper + prior_gradient])
        matrix = matrix + self.priors.matrix(model, len(h))
        g = model.n_global
        # the EM matrix needs a positive definite hyperparameter block by itself
        matrix.border[g:, g:] += _positive(curvature) if em else curvature
        value = loglik + float(self.priors.log_density(theta)) + float(self.hyper.log_prior(h))
        return value, gradient, matrix


def log_likelihood(
    stars: Stars, theta: Float, constants: Constants, scratch: int = SCRATCH
) -> Float:
    """Log-likelihood (n,) of the stars at parameter vectors theta (n, n_params).

    The vectors are divided so that their effective coefficients take at most `scratch` bytes.
    """
    model = stars.model
    out = np.empty(len(theta))
    step = max(1, scratch // (16 * model.n_terms * len(stars.groups)))
    for a in range(0, len(theta), step):
        rows = slice(a, a + step)
        powers, mixture_constants = stars.powers(theta[rows]), constants.of(rows)
        if circle := stars.circle(constants):
            out[rows] = kernel.truncated_log_likelihood(
                stars.blocks, stars.columns, circle, powers, model.order, mixture_constants
            )
        else:
            out[rows] = kernel.log_likelihood(
                stars.blocks, stars.columns, powers, model.order, mixture_constants
            )
    return out


def _positive(curvature: Float) -> Float:
    if not len(curvature):
        return curvature
    values, vectors = np.linalg.eigh(curvature)
    return (vectors * np.maximum(np.abs(values), 1.0)) @ vectors.T
