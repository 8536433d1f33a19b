"""Parts of a campaign: the scatter of its exposures, and each exposure fitted alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.app.artefacts.parts import Part
from bayesdist.infer import Posterior
from bayesdist.infer.exposures.hierarchy import Settling
from bayesdist.kinds.campaign.series import Series
from bayesdist.utils.arrays import Float


@dataclass(frozen=True, eq=False)
class ExposureScatter(Part):
    """Scatter of the linear terms of the exposures about those of the model.

    Parameters
    ----------
    kinds : tuple of str
        Names of the k linear terms that scatter.
    tau : ndarray, shape (n, k)
        Posterior draws of the standard deviation of each term.
    offsets : Settling
        Relation between the constant terms of chips and the shifts of single chips.
    """

    title = "joint fit of exposures"
    recorded = is_hierarchy = True

    kinds: tuple[str, ...]
    tau: Float
    offsets: Settling

    def averaged(self, posterior: Posterior, rng: np.random.Generator) -> Posterior:
        """Posterior in which each chip has its mean position over the exposures."""
        tau = self.tau[rng.integers(len(self.tau), size=len(posterior.flat))]
        flat = self.offsets.draws(posterior.flat, tau, rng)
        before, after = posterior.flat.std(axis=0), flat.std(axis=0)
        scale = np.divide(after, before, out=np.ones_like(after), where=before > 0)
        c = posterior.convergence
        scale = np.append(scale, np.ones(len(c.names) - len(scale)))  # hyperparameters come last
        return replace(
            posterior,
            theta=flat.reshape(posterior.theta.shape),
            # the number of effective draws is unchanged, but the draws scatter less
            convergence=replace(c, mcse_mean=c.mcse_mean * scale, mcse_sd=c.mcse_sd * scale),
        )


@dataclass(frozen=True, eq=False)
class ExposuresAlone(Part):
    """Linear terms of the exposures, each fitted without the others."""

    title = "fits of single exposures"
    recorded = True

    series: Series
