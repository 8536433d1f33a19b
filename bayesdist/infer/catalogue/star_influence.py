"""Covariance of single catalogue stars' errors with a solution.

With the notation of `star_sums`, an error c_s of star s moves the parameters by H^-1 G_s c_s.  So a
star that is seen again, in an exposure that was no part of the fit, has an error with which the
solution's own is correlated: cov(c_s, theta) = Sigma_s (H^-1 G_s)^T.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import Matches
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.infer.catalogue.star_sums import StarSums, influence_by_group
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.linear import LinearFit
from bayesdist.infer.stars.stars import prepare

__all__ = ["StarInfluence", "star_influence"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class StarInfluence:
    """Errors of a catalogue, and their effect on polynomials and drift of a solution."""

    errors: StarErrors
    codes: Int  # stars (k,) in the solution, ascending; all others have no effect on it
    # derivatives (levers, 2, k, n_distortion) of the parameters by these stars' errors on either
    # axis
    by: Float

    def with_solution(self, star: Int, epoch: Float | None) -> Float:
        """Covariance (n, 2, n_distortion) of the stars' errors with those of the parameters."""
        out = np.zeros((len(star), 2, self.by.shape[-1]))
        if not len(self.codes):
            return out
        at = np.minimum(np.searchsorted(self.codes, star), len(self.codes) - 1)
        known = np.flatnonzero(self.codes[at] == star)
        star, at = star[known], at[known]
        levers = self.errors.levers(star, None if epoch is None else epoch[known])
        variances = self.errors.variances[: len(levers), star]
        weight = levers[..., None] * variances  # (levers, n, 2)
        out[known] = np.einsum("lna,land->nad", weight, self.by[: len(levers)][:, :, at])
        return out


@one_thread
def star_influence(
    fit: LinearFit, matches: Matches, errors: StarErrors, codes: Int
) -> StarInfluence:
    """Effect on a fit of the catalogue errors of the stars `codes` (k,), ascending.

    The fit has no extra weight in the corners; `matches` are its own, with errors and star codes.
    """
    code = matches.column("star")
    model, D = fit.model, fit.model.n_distortion
    n_levers = 1 if errors.motion is None else 2
    by = np.zeros((n_levers, 2, len(codes), D))
    wanted = np.isin(code, codes) & fit.uses(matches)
    if not wanted.any():
        return StarInfluence(errors, codes, by)
    stars, order = prepare(model, matches.select(wanted))
    star = code[wanted][order]
    epoch = None if matches.epoch is None else matches.epoch[wanted][order]
    levers = list(errors.levers(star, epoch))
    inverse = np.stack([1 / stars.var_u, 1 / stars.var_v])
    sums = StarSums.of(stars, np.searchsorted(codes, star), inverse, levers)
    influence = influence_by_group(model, fit.mean, stars.groups, fit.cov, D)
    by[: len(levers)] = sums.each(influence, 0, len(codes))
    return StarInfluence(errors, codes, by)
