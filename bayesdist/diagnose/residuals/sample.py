"""Some of the stars with residuals and probabilities; their scatter by magnitude and exposure."""

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

SAMPLE = 200_000  # stars that show what all of them look like
MIN_STARS = 50  # stars whose scatter says anything by magnitude
CERTAIN = 0.5  # probability of a false match from which on a star is left out


@dataclass(frozen=True, eq=False)
class ExposureScatter:
    """Chi-square per degree of freedom of each exposure, with the errors of the solution.

    Parameters that were fitted to all exposures make all ratios smaller alike: that of one exposure
    is compared with that of all.
    """

    names: tuple[str, ...]  # of the E exposures that have stars
    n: Int  # (E,), probably true stars
    ratio: Float  # (E,)

    @property
    def of_all(self) -> float:
        """Chi-square per degree of freedom of all exposures together."""
        return float(self.n @ self.ratio / self.n.sum())

    @property
    def relative(self) -> Float:
        """Ratios (E,) in units of that of all."""
        return self.ratio / self.of_all

    @property
    def chance(self) -> Float:
        """Standard deviations (E,) of `relative` by chance, of Gaussian residuals on two axes."""
        return np.asarray(1.0 / np.sqrt(self.n))

    @property
    def deviating(self) -> Bool:
        """Boolean mask (E,) of exposures with other errors than all, by more than chance."""
        factor = np.maximum(self.relative, 1.0 / self.relative)
        by_chance = np.abs(self.relative - 1.0) <= 3.0 * self.chance
        return ~by_chance & (factor > EXPOSURE_CHI2.value)


@dataclass(frozen=True, eq=False)
class StarSample:
    """Evenly spread stars of the data, or all of them."""

    table: Matches  # n stars
    fit_residual: Float  # (N, 2), data minus the least-squares fit, in the unit of u and v
    used: Bool  # (N,), whether the fit used the star
    n_total: int  # stars that there are in all
    # (N, 2), of true matches along u and v: errors as quoted, with the jitter of the posterior
    variance: Float
    # (N, 2), data minus the model at the posterior mean; None where nothing was sampled
    posterior_residual: Float | None = None
    outlier_probability: Float | None = None  # (N,)
    # (N,), share of the variance that fitted places of the stars take out of the residuals; None
    # where places are known
    taken: Float | None = None

    def __len__(self) -> int:
        return len(self.table)

    @property
    def probably_true(self) -> Bool:
        """Boolean mask (N,) of the stars that are no likely false match, else that were used."""
        p = self.outlier_probability
        return self.used if p is None else p < CERTAIN

    @property
    def partial(self) -> bool:
        """True where there are more stars than these."""
        return len(self.table) < self.n_total

    @property
    def residual(self) -> Float:
        """Residuals at the posterior mean where there is one, else at the fit."""
        return self.fit_residual if self.posterior_residual is None else self.posterior_residual

    @property
    def expected_square(self) -> Float:
        """Mean squares (N, 2) that residuals of true matches have."""
        return self.variance if self.taken is None else self.variance * (1 - self.taken[:, None])

    @property
    def by_exposure(self) -> ExposureScatter | None:
        """Chi-square of each exposure; None where there is only one."""
        true, table = self.probably_true, self.table
        codes, square = table.exposure[true], (self.residual**2 / self.expected_square)[true]
        n = np.bincount(codes, minlength=len(table.exposure_names))
        there = np.flatnonzero(n)
        if there.size < 2:
            return None
        total = np.bincount(codes, square.sum(axis=1), minlength=n.size)
        names = tuple(table.exposure_names[k] for k in there)
        return ExposureScatter(names, n[there], total[there] / (2.0 * n[there]))


def star_sample(
    table: Matches, n_total: int, fit: LinearFit, posterior: Posterior | None = None
) -> StarSample:
    """Residuals and probabilities of some stars, by a fit and a posterior.

    `table`: with errors: as of ``matches.sample(SAMPLE)``. `n_total`: stars that there are in all.
    """
    stars, order = prepare(fit.model, table)
    solution = likelihood_shown(fit, posterior)
    said = None if posterior is None else memberships_of(posterior, stars).in_table_order(order)

    def residual(theta: Float) -> Float:
        return in_table_order(stars.residuals(theta), order)

    return StarSample(
        table=table,
        fit_residual=residual(fit.mean),
        used=in_table_order(fit.clip.keeps_of(stars), order),
        n_total=n_total,
        variance=in_table_order(solution.variances(stars).T, order),
        posterior_residual=None if posterior is None else residual(solution.theta),
        outlier_probability=None if said is None else said.outlier_probability,
    )


def dates_of(table: Matches) -> Float:
    """Distinct dates of the stars of a table in memory, ascending; empty if they have none."""
    return np.zeros(0) if table.epoch is None else np.unique(table.epoch)


def likelihood_shown(fit: LinearFit, posterior: Posterior | None) -> Likelihood:
    """Likelihood at the solution whose residuals are shown: the posterior's, where there is one.

    Positions of stars that were fitted belong to the parameters of the fit: at the mean of the
    draws the residuals would hold its distance from there, which the stars would follow.
    """
    if posterior is None:
        return fit.likelihood
    found = posterior.likelihood
    return replace(found, theta=np.asarray(fit.mean)) if posterior.own_places else found


def centroid_scatter(stars: StarSample, *, n_params: int = 0) -> MagnitudeErrors | None:
    """Scatter of the residuals by magnitude.

    Of stars with a posterior the likely false matches are left out, else what the fit rejected;
    `n_params` are the parameters of the fit to all stars. None where the stars have no magnitudes,
    or too few of them.
    """
    mag = stars.table.mag
    if mag is None:
        return None
    good = np.isfinite(mag) & stars.probably_true
    if good.sum() < MIN_STARS:
        return None
    share = round(n_params * len(stars) / max(stars.n_total, 1))
    return estimate(mag[good], *stars.residual[good].T, n_params=share)
