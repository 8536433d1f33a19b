"""Errors of stars as a fit took them, and the scatter of exposures that were fitted jointly."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.data.magnitude_errors import AddedErrors, MagnitudeErrors
from bayesdist.data.matches import Matches
from bayesdist.infer import Posterior
from bayesdist.infer.exposures.chip_offsets import Settling
from bayesdist.utils.arrays import Float


@dataclass(frozen=True, eq=False)
class ErrorLaw:
    """Law by which errors of stars, fitted or held out, follow from the quoted ones."""

    factor: float = 1.0  # on all quoted errors; 1 where they will do
    # errors of the centroids, in place of the quoted ones
    by_magnitude: MagnitudeErrors | None = None
    added: AddedErrors | None = None  # beyond these, by groups of stars
    # errors by magnitude are added in quadrature to the quoted ones, which are the catalogue's
    with_catalogue: bool = False

    def applied(self, matches: Matches) -> Matches:
        """Matches with these errors; they themselves where the quoted errors stand."""
        if self.factor != 1.0:
            matches = matches.with_scaled_errors(self.factor)
        if self.by_magnitude is not None:
            matches = matches.with_errors(self.by_magnitude, in_quadrature=self.with_catalogue)
        return (
            matches if self.added is None else matches.with_errors(self.added, in_quadrature=True)
        )


QUOTED = ErrorLaw()


@dataclass(frozen=True, eq=False)
class ExposureScatter:
    """Scatter of the linear terms of exposures about those of the model."""

    kinds: tuple[str, ...]  # kinds of deviation
    tau: Float  # (n, k), draws of the scatter of each kind
    offsets: Settling  # how the constant terms of chips follow from the shifts of single chips

    def averaged(self, posterior: Posterior, rng: np.random.Generator) -> Posterior:
        """The posterior with the chips where the exposures have them on average."""
        some = self.tau[rng.integers(len(self.tau), size=len(posterior.flat))]
        flat = self.offsets.draws(posterior.flat, some, rng)
        before, after = posterior.flat.std(axis=0), flat.std(axis=0)
        scale = np.divide(after, before, out=np.ones_like(after), where=before > 0)
        c = posterior.convergence
        scale = np.append(scale, np.ones(len(c.names) - len(scale)))  # hyperparameters stand last
        return replace(
            posterior,
            theta=flat.reshape(posterior.theta.shape),
            # of as many effective draws, which scatter less
            convergence=replace(c, mcse_mean=c.mcse_mean * scale, mcse_sd=c.mcse_sd * scale),
        )
