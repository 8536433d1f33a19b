"""The posterior density as a function: parameters in, log density out, for many points at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer import kernel
from bayesdist.infer.arrow import Arrow
from bayesdist.infer.mixture import Hyper, OutlierMixture
from bayesdist.infer.normal import accumulate
from bayesdist.infer.prior import GaussianPriors
from bayesdist.infer.stars import Stars

__all__ = ["Target"]

Float = NDArray[np.float64]

_KINDS = {"none": kernel.NO_OUTLIERS, "gaussian": kernel.GAUSSIAN, "uniform": kernel.UNIFORM}
SCRATCH = 32_000_000  # bytes of effective coefficients held at a time


@dataclass(frozen=True, eq=False)
class Target:
    """Posterior density of psi = (theta, hyperparameters).

    Parameters
    ----------
    stars : Stars
    mixture : OutlierMixture
    priors : GaussianPriors
    """

    stars: Stars
    mixture: OutlierMixture
    priors: GaussianPriors

    @cached_property
    def hyper(self) -> Hyper:
        """Likelihood terms and priors of the hyperparameters."""
        return self.mixture.bind(self.stars.reference_sigma)

    @property
    def n_theta(self) -> int:
        """Number of distortion parameters."""
        return self.stars.model.n_params

    @property
    def names(self) -> tuple[str, ...]:
        """Names of psi."""
        return self.stars.model.names + self.hyper.names

    @cached_property
    def _blocks(self) -> NDArray[np.int64]:
        return kernel.blocks_of(self.stars.starts)

    @cached_property
    def _columns(self) -> tuple[Float, ...]:
        s = self.stars
        return (s.X, s.Y, s.u, s.v, s.var_u, s.var_v)

    def log_density(self, psi: Float) -> Float:
        """Log posterior of points (n, D), up to a constant.

        Points outside the support, or not finite, give minus infinity.
        """
        ok = np.isfinite(psi).all(axis=1)
        out = np.full(len(psi), -np.inf)
        theta, h = psi[ok, : self.n_theta], psi[ok, self.n_theta :]
        value = self.priors.log_density(theta) + self.hyper.log_prior(h)
        model, groups = self.stars.model, self.stars.groups
        step = max(1, SCRATCH // (16 * model.n_terms * len(groups)))
        for a in range(0, len(theta), step):
            rows = slice(a, a + step)
            # all chips share the order, hence the map to powers
            coef = model.basis(model.chips[0].number).to_scaled_powers(
                model.effective(theta[rows], groups)
            )
            value[rows] += kernel.log_likelihood(
                self._blocks,
                self._columns,  # type: ignore[arg-type]
                coef,
                model.order,
                self.hyper.constants(h[rows]),
                _KINDS[self.mixture.model],
                self.stars.reference_sigma**2,
            )
        out[ok] = np.where(np.isnan(value), -np.inf, value)
        return out

    def expand(self, psi: Float) -> tuple[float, Float, Arrow, Arrow]:
        """Second-order expansion of the log posterior at one point: one pass over the data.

        Parameters
        ----------
        psi : ndarray, shape (D,)

        Returns
        -------
        value : float
        gradient : ndarray, shape (D,)
        curvature : Arrow
            Minus the Hessian; may be indefinite away from the mode.
        safe : Arrow
            The same with the EM weights, whose distortion part is never indefinite.
        """
        stars, model = self.stars, self.stars.model
        theta, h = psi[: self.n_theta], psi[self.n_theta :]
        E = model.effective(theta, stars.groups)
        terms = self.hyper.terms(h, stars.residuals(theta), stars.var_u, stars.var_v)
        # residual = data - model, so a mixed derivative by the model has the other sign:
        # minus d2 l / dh dE = d2 l / dh dr phi
        full = accumulate(stars, E, terms.weight, terms.pull, terms.cross)
        matrix, right = full.assemble(model, theta, stars.groups)
        em = accumulate(stars, E, terms.safe_weight, terms.pull)
        em_matrix, _ = em.assemble(model, theta, stars.groups)

        prior_gradient, prior_curvature = self.hyper.prior_terms(h)
        gradient = np.concatenate(
            [right + self.priors.pull(theta), terms.gradient.sum(axis=0) + prior_gradient]
        )
        n_tail, g = len(h), model.n_global
        hyper_part = terms.curvature + np.diag(prior_curvature)
        matrix = matrix + self.priors.matrix(model, n_tail)
        matrix.border[g:, g:] += hyper_part
        safe = _with_tail(em_matrix + self.priors.matrix(model), hyper_part)
        value = (
            float(terms.loglik.sum())
            + float(self.priors.log_density(theta))
            + float(self.hyper.log_prior(h))
        )
        return value, gradient, matrix, safe

    def outlier_probability(self, psi: Float) -> Float:
        """Probability (N,) of being an outlier, averaged over points (n, D); in table order."""
        total = np.zeros(len(self.stars))
        for point in psi:
            theta, h = point[: self.n_theta], point[self.n_theta :]
            residual = self.stars.residuals(theta)
            total += self.hyper.terms(h, residual, self.stars.var_u, self.stars.var_v).outlier
        return self.stars.in_table_order(total / len(psi))

    def star_log_likelihood(self, psi: Float) -> Float:
        """Log-likelihood (n, N) of each star at points (n, D), in table order."""
        out = np.empty((len(psi), len(self.stars)))
        for k, point in enumerate(psi):
            theta, h = point[: self.n_theta], point[self.n_theta :]
            residual = self.stars.residuals(theta)
            terms = self.hyper.terms(h, residual, self.stars.var_u, self.stars.var_v)
            out[k] = self.stars.in_table_order(terms.loglik)
        return out


def _with_tail(matrix: Arrow, tail: Float) -> Arrow:
    """A matrix with a tail that is not coupled to the rest, made positive on its diagonal."""
    t, g = len(tail), len(matrix.border)
    values, vectors = np.linalg.eigh(tail) if t else (np.zeros(0), np.zeros((0, 0)))
    tail = (vectors * np.maximum(np.abs(values), 1.0)) @ vectors.T
    border = np.zeros((g + t, g + t))
    border[:g, :g] = matrix.border
    border[g:, g:] = tail
    n, _, q = matrix.edge.shape
    edge = np.zeros((n, g + t, q))
    edge[:, :g] = matrix.edge
    return Arrow(border, edge, matrix.blocks, n_tail=t)
