"""A solution whose draws are spread by errors that its likelihood does not know of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.errors import required
from bayesdist.infer import LinearFit, Posterior
from bayesdist.infer.catalogue.star_errors import StarCovariance
from bayesdist.infer.equations.scaled import recolouring, scaled_cholesky

__all__ = ["with_diagnosed_errors", "with_shared_stars"]

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
    before = _covariance(posterior, fit)
    return posterior.mapped(recolouring(before, before + stars.extra))


def with_diagnosed_errors(
    posterior: Posterior,
    diagnostics: Diagnostics | None,
    hierarchy: LinearFit | None = None,
    *,
    noise_alone: bool = False,
) -> Posterior:
    """Posterior whose draws are spread by all that diagnostics know of errors of its parameters.

    So it is exported and shown; `posterior` is as it was sampled.  `hierarchy` is the fit of a
    hierarchy of exposures, whose covariance has no noise of draws.  `noise_alone` counts, of the
    correlated errors, those of the stars as they scatter: what else there is stands in terms of its
    own.
    """
    if diagnostics is None:
        return posterior
    solution, stars, found = posterior, diagnostics.catalogue, diagnostics.correlated
    if stars is not None:
        needed = required(hierarchy, "errors of the catalogue need a joint fit")
        solution = with_shared_stars(posterior, needed, stars)
    if found is None:
        return solution
    cov = found.noise if noise_alone else found.covariance
    if hierarchy is None:
        return solution.mapped(recolouring(found.formal, cov))
    before = _covariance(posterior, hierarchy)
    if stars is not None:
        before = before + stars.extra
    # frames follow as they are correlated with polynomials and drift
    D = found.model.n_distortion
    follow = np.linalg.solve(before[:D, :D], before[:D]).T
    more = follow @ (cov - found.formal)[:D, :D] @ follow.T
    return solution.mapped(recolouring(before, before + _least(before, (more + more.T) / 2)))


def _covariance(posterior: Posterior, fit: LinearFit) -> Float:
    """Covariance (D, D) of a posterior without the noise of its draws."""
    formal = np.asarray(fit.cov, float)
    wider = float(np.trace(np.linalg.solve(formal, posterior.cov))) / len(formal)
    return wider * formal


def _least(before: Float, more: Float) -> Float:
    """Addition to a covariance, limited so that no direction loses more than half its variance."""
    root = scaled_cholesky(before)
    white = np.linalg.solve(root, np.linalg.solve(root, more).T)
    values, vectors = np.linalg.eigh((white + white.T) / 2)
    turned = root @ vectors
    return np.asarray((turned * np.maximum(values, -0.5)) @ turned.T)
