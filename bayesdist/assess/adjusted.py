"""A solution whose draws are spread by errors that its likelihood does not know of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.diagnose.correlated import Discrepancy
from bayesdist.infer import LinearFit, Posterior
from bayesdist.infer.catalogue.star_errors import StarCovariance
from bayesdist.infer.equations.scaled import scaled_cholesky
from bayesdist.infer.posterior.covariance import recolouring

__all__ = ["covariance_of", "with_correlated_errors", "with_noise", "with_shared_stars"]

Float = NDArray[np.float64]


def with_shared_stars(posterior: Posterior, fit: LinearFit, stars: StarCovariance) -> Posterior:
    """A posterior whose draws are spread by what the errors of the catalogue add.

    The linear map that turns the covariance of the fit into the larger one is applied to the
    deviations of the draws, so that they keep their shape: no noise could be added, as errors that
    the fit takes for independent may cancel.  Where the posterior is as much wider than the fit as
    its jitter says, so is the covariance that the map begins with.

    `fit`: that `stars` was computed for. The result comes with other draws of theta and the same
    mean; all else is as it was.
    """
    before = covariance_of(posterior, fit)
    return posterior.mapped(recolouring(before, before + stars.extra))


def covariance_of(
    posterior: Posterior, fit: LinearFit, stars: StarCovariance | None = None
) -> Float:
    """Covariance of a posterior without the noise of its draws, and with a catalogue's errors.

    Returns (D, D).
    """
    formal = np.asarray(fit.cov, float)
    wider = float(np.trace(np.linalg.solve(formal, posterior.cov))) / len(formal)
    return wider * formal if stars is None else wider * formal + stars.extra


def with_noise(
    posterior: Posterior, correlated: Discrepancy, before: Float | None = None
) -> Posterior:
    """A posterior whose draws are spread by the errors of the stars as they scatter.

    `before`: (D, D), its covariance where that is not the formal one, as in a hierarchy of
    exposures.
    """
    return _widened(posterior, correlated, correlated.noise, before)


def with_correlated_errors(
    posterior: Posterior, correlated: Discrepancy, before: Float | None = None
) -> Posterior:
    """A posterior whose draws are spread by all that is known of errors of its parameters.

    `posterior`, `correlated`, `before`: as `with_noise`.
    """
    return _widened(posterior, correlated, correlated.covariance, before)


def _widened(
    posterior: Posterior, correlated: Discrepancy, cov: Float, before: Float | None
) -> Posterior:
    formal = correlated.formal
    if before is None:
        return posterior.mapped(recolouring(formal, cov))
    # frames follow as they are correlated with polynomials and drift
    D = correlated.model.n_distortion
    follow = np.linalg.solve(before[:D, :D], before[:D]).T
    more = follow @ (cov - formal)[:D, :D] @ follow.T
    after = before + _least(before, (more + more.T) / 2)
    return posterior.mapped(recolouring(before, after))


def _least(before: Float, more: Float) -> Float:
    """Addition to a covariance, limited so that no direction loses more than half its variance."""
    root = scaled_cholesky(before)
    white = np.linalg.solve(root, np.linalg.solve(root, more).T)
    values, vectors = np.linalg.eigh((white + white.T) / 2)
    turned = root @ vectors
    return np.asarray((turned * np.maximum(values, -0.5)) @ turned.T)
