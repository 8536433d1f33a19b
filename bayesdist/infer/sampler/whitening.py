"""Whitened coordinates, in which state-dependent moves are made."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.infer.density.proposal import Proposal
from bayesdist.infer.density.target import Density
from bayesdist.infer.equations.arrow import ArrowFactor
from bayesdist.utils.arrays import Float


@dataclass(frozen=True, eq=False)
class Whitening:
    """Transformation to coordinates in which the posterior is close to a standard Gaussian."""

    centre: Float  # psi (D,) at the origin of the whitened coordinates
    factor: ArrowFactor  # factor of the precision of the distortion parameters
    scale: Float  # standard deviations (h,) of the hyperparameters

    @classmethod
    def of(cls, target: Density, proposal: Proposal, draws: Float) -> Whitening:
        """Whitening from the best node of a proposal and the hyperparameters of draws (n, D)."""
        n = target.n_theta
        factor = proposal.best.factor.matrix.without_tail().factor()
        hyper = draws[:, n:]
        centre = np.concatenate([proposal.best.mode[:n], np.nanmean(hyper, axis=0)])
        return cls(centre, factor, np.nanstd(hyper, axis=0))

    @property
    def n_theta(self) -> int:
        """Number of distortion parameters."""
        return self.factor.matrix.size

    def to_psi(self, w: Float) -> Float:
        """Convert whitened coordinates (n, D) to sampled coordinates psi (n, D)."""
        n = self.n_theta
        parts = [self.factor.colour(w[:, :n]), w[:, n:] * self.scale]
        return self.centre + np.concatenate(parts, axis=1)

    def to_white(self, psi: Float) -> Float:
        """Convert sampled coordinates psi (n, D) to whitened coordinates (n, D)."""
        n, shift = self.n_theta, psi - self.centre
        return np.concatenate([self.factor.whiten(shift[:, :n]), shift[:, n:] / self.scale], axis=1)
