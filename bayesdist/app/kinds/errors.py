"""Measurement errors assumed by a fit, and the scatter of exposures that were fitted jointly."""

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
    """Rule that derives the errors of fitted and held-out stars from the quoted errors.

    Parameters
    ----------
    factor : float
        Factor on all quoted errors; 1 if these are adequate.
    by_magnitude : MagnitudeErrors or None
        Centroid errors as a function of magnitude, which replace the quoted errors or are added to
        them.
    added : AddedErrors or None
        Additional errors of groups of stars, added in quadrature.
    with_catalogue : bool
        True if `by_magnitude` is added in quadrature to the quoted errors, because these are the
        errors of the catalogue.
    """

    factor: float = 1.0
    by_magnitude: MagnitudeErrors | None = None
    added: AddedErrors | None = None
    with_catalogue: bool = False

    def applied(self, matches: Matches) -> Matches:
        """Matches with these errors applied; returned unchanged if the quoted errors are kept."""
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
