"""Solutions with another covariance, for errors that their fit did not know or counted too much."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.equations.scaled import scaled_cholesky
from bayesdist.infer.posterior.posterior import Posterior
from bayesdist.infer.transforms import Derived, Solution
from bayesdist.model import DistortionModel

__all__ = ["Recoloured", "recolouring", "with_spread"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Recoloured(Derived):
    """Solution whose draws are rescaled to the covariance `cov`, in which they keep their shape."""

    source: Solution
    cov: Float

    @property
    def model(self) -> DistortionModel:
        """The distortion model."""
        return self.source.model

    @property
    def unit(self) -> str:
        """Unit of u and v."""
        return self.model.unit

    @property
    def mean(self) -> Float:
        """Mean (D,) of the source."""
        return self.source.mean

    @property
    def sigma(self) -> Float:
        """Standard deviation of each parameter."""
        return np.asarray(np.sqrt(np.diag(self.cov)))

    @cached_property
    def _map(self) -> Float:
        return recolouring(np.asarray(self.source.cov), self.cov)

    def draws(self, n: int, rng: np.random.Generator) -> Float:
        """Parameter vectors (n, D): draws of the source, rescaled to this covariance.

        A sum with independent noise would not do: the difference of the covariances may have
        negative eigenvalues, where errors that a fit takes for independent cancel.
        """
        mean = np.asarray(self.mean)
        theta = np.asarray(self.source.draws(n, rng), float)
        return np.asarray(mean + (theta - mean) @ self._map.T)


def with_spread(posterior: Posterior, before: Float, after: Float) -> Posterior:
    """Posterior whose deviations are mapped from covariance `before` to `after`; its mean stays.

    The map is that of `recolouring`; all else but theta is unchanged.
    """
    spread, mean = recolouring(before, after), posterior.mean
    return replace(posterior, theta=mean + (posterior.theta - mean) @ spread.T)


def recolouring(before: Float, after: Float) -> Float:
    """Linear map A (D, D) with A before A^T = after; the identity where the two are equal.

    Both are positive definite, but for parameters without variance, which A leaves as they are.
    """
    free = np.flatnonzero(np.diag(before) > 0)
    inner = np.ix_(free, free)
    old, new = (scaled_cholesky(cov[inner]) for cov in (before, after))
    out = np.eye(len(before))
    out[inner] = np.linalg.solve(old.T, new.T).T
    return out
