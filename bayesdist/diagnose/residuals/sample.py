"""A sample of the stars with residuals and probabilities, and their scatter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.data.magnitude_errors import MagnitudeErrors, estimate
from bayesdist.data.matches import Matches
from bayesdist.infer.posterior import Posterior
from bayesdist.infer.posterior.memberships import memberships_of
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.infer.stars.likelihood import Likelihood
from bayesdist.infer.stars.stars import in_table_order, prepare
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.limits import EXPOSURE_CHI2

SAMPLE = 200_000  # number of stars that represent all of them
MIN_STARS = 50  # smallest number for an estimate of the scatter by magnitude
CERTAIN = 0.5  # probability of being a false match at which a star is excluded


@dataclass(frozen=True, eq=False)
class ExposureScatter:
    """Chi-square per degree of freedom of each exposure, with the errors of the solution.

    Parameters that were fitted to all exposures reduce all ratios alike, so that each exposure is
    compared with all exposures together.
    """

    names: tuple[str, ...]  # of the E exposures with stars
    n: Int  # (E,) number of probably true stars
    ratio: Float  # (E,) chi-square per degree of freedom

    @property
    def of_all(self) -> float:
        """Chi-square per degree of freedom of all exposures together."""
        return float(self.n @ self.ratio / self.n.sum())

    @property
    def relative(self) -> Float:
        """Ratios (E,) divided by that of all exposures."""
        return self.ratio / self.of_all

    @property
    def chance(self) -> Float:
        """Standard deviations (E,) of `relative` for Gaussian residuals on two axes."""
        return np.asarray(1.0 / np.sqrt(self.n))

    @property
    def deviating(self) -> Bool:
        """Boolean mask (E,) of exposures whose errors differ significantly from those of all."""
        factor = np.maximum(self.relative, 1.0 / self.relative)
        by_chance = np.abs(self.relative - 1.0) <= 3.0 * self.chance
        return ~by_chance & (factor > EXPOSURE_CHI2.value)


@dataclass(frozen=True, eq=False)
class StarSample:
    """Evenly spread stars of the data, or all of them."""

    table: Matches  # n stars
    fit_residual: Float  # (N, 2) data minus least-squares fit, in the unit of u and v
    used: Bool  # (N,) True if the fit used the star
    n_total: int  # number of all stars
    # (N, 2) of true matches along u and v: quoted errors, with the jitter of the posterior
    variance: Float
    # (N, 2) data minus the model at the posterior mean; None without a posterior
    posterior_residual: Float | None = None
    outlier_probability: Float | None = None  # (N,)
    # (N,) fraction of the variance of the residuals that fitted positions of the stars absorb; None
    # if the positions are known
    taken: Float | None = None

    def __len__(self) -> int:
        return len(self.table)

    @property
    def probably_true(self) -> Bool:
        """Boolean mask (N,) of probably true matches; of the stars used without a posterior."""
        p = self.outlier_probability
        return self.used if p is None else p < CERTAIN

    @property
    def partial(self) -> bool:
        """True if the sample does not contain all stars."""
        return len(self.table) < self.n_total

    @property
    def residual(self) -> Float:
        """Residuals at the posterior mean if there is one, otherwise at the fit."""
        return self.fit_residual if self.posterior_residual is None else self.posterior_residual

    @property
    def expected_square(self) -> Float:
        """Expected squares (N, 2) of the residuals of true matches."""
        return self.variance if self.taken is None else self.variance * (1 - self.taken[:, None])

    @property
    def by_exposure(self) -> ExposureScatter | None:
        """Chi-square of each exposure; None if there is only one."""
        true, table = self.probably_true, self.table
        codes, square = table.exposure[true], (self.residual**2 / self.expected_square)[true]
        n = np.bincount(codes, minlength=len(table.exposure_names))
        with_stars = np.flatnonzero(n)
        if with_stars.size < 2:
            return None
        total = np.bincount(codes, square.sum(axis=1), minlength=n.size)
        names = tuple(table.exposure_names[k] for k in with_stars)
        return ExposureScatter(names, n[with_stars], total[with_stars] / (2.0 * n[with_stars]))


def star_sample(
    table: Matches, n_total: int, fit: LinearFit, posterior: Posterior | None = None
) -> StarSample:
    """Residuals and probabilities of stars, from a fit and a posterior.

    `table` must contain errors, as from ``matches.sample(SAMPLE)``; `n_total` is the number of all
    stars.
    """
    stars, order = prepare(fit.model, table)
    solution = likelihood_shown(fit, posterior)
    membership = (
        None if posterior is None else memberships_of(posterior, stars).in_table_order(order)
    )

    def residual(theta: Float) -> Float:
        return in_table_order(stars.residuals(theta), order)

    return StarSample(
        table=table,
        fit_residual=residual(fit.mean),
        used=in_table_order(fit.clip.keeps_of(stars), order),
        n_total=n_total,
        variance=in_table_order(solution.variances(stars).T, order),
        posterior_residual=None if posterior is None else residual(solution.theta),
        outlier_probability=None if membership is None else membership.outlier_probability,
    )


def dates_of(table: Matches) -> Float:
    """Distinct dates of the stars of a table in memory, ascending; empty without dates."""
    return np.zeros(0) if table.epoch is None else np.unique(table.epoch)


def likelihood_shown(fit: LinearFit, posterior: Posterior | None) -> Likelihood:
    """Likelihood at the solution whose residuals are shown: the posterior's if there is one.

    If the positions of stars were fitted, the parameters of the fit are used, because the positions
    belong to them.  Residuals at the mean of the draws would include the distance of that mean from
    the fit, which fitted positions would follow.
    """
    if posterior is None:
        return fit.likelihood
    likelihood = posterior.likelihood
    return replace(likelihood, theta=np.asarray(fit.mean)) if posterior.own_places else likelihood


def centroid_scatter(stars: StarSample, *, n_params: int = 0) -> MagnitudeErrors | None:
    """Scatter of the residuals by magnitude.

    Likely false matches are excluded, or stars rejected by the fit if there is no posterior.
    `n_params` is the number of parameters fitted to all stars.  Returns None if there are no
    magnitudes, or too few stars with them.
    """
    mag = stars.table.mag
    if mag is None:
        return None
    good = np.isfinite(mag) & stars.probably_true
    if good.sum() < MIN_STARS:
        return None
    share = round(n_params * len(stars) / max(stars.n_total, 1))
    return estimate(mag[good], *stars.residual[good].T, n_params=share)
