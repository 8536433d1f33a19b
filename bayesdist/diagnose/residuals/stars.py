"""Residuals of stars at a solution: a sample of them, and sums over all stars in one pass.

The sample contains residuals and probabilities of stars, and gives the scatter by magnitude.  The
functions that sum over a shard of the data are module-level functions, so that they can be sent to
other processes.  Their results are added.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammainc, gammaincc

from bayesdist.data.magnitude_errors import MagnitudeErrors, estimate
from bayesdist.data.matches import Matches
from bayesdist.diagnose.residuals.binned import BinnedSums, binned_sums
from bayesdist.diagnose.statistics import joint_clusters
from bayesdist.infer.kernel import Constants
from bayesdist.infer.posterior import Posterior
from bayesdist.infer.posterior.memberships import averaged_draws, memberships_of
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.infer.stars.likelihood import Likelihood, star_averages
from bayesdist.infer.stars.shards import Shards
from bayesdist.infer.stars.stars import Stars, Sums, in_table_order, prepare
from bayesdist.model import DistortionModel
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.checks import EXPOSURE_CHI2

SAMPLE = 200_000  # number of stars that represent all of them
MIN_STARS = 50  # smallest number for an estimate of the scatter by magnitude
DEVIATING = 0.0027  # probability of naming any exposure by chance: three standard deviations
CERTAIN = 0.5  # probability of being a false match at which a star is excluded
Bins = tuple[int, int]


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
        """Boolean mask (E,) of exposures whose errors differ significantly from those of all.

        For Gaussian residuals 2 n `relative` is distributed as chi-square with 2 n degrees of
        freedom. The significance is divided by the number of exposures (Bonferroni).
        """
        factor = np.maximum(self.relative, 1.0 / self.relative)
        n, half = self.n, self.n * self.relative
        p_value = 2.0 * np.minimum(gammainc(n, half), gammaincc(n, half))
        return (p_value < DEVIATING / n.size) & (factor > EXPOSURE_CHI2.value)


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
        variance=in_table_order(solution.covariances(stars)[0::2].T, order),
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


@dataclass(frozen=True, eq=False)
class ExposureSums(Sums):
    """Counts and residuals of each exposure."""

    # n, n_used (E,): number of stars, and of those that the least-squares fit used
    n: Int
    n_used: Int
    # uu, vv (E,): sums of the squared residuals of the stars used
    uu: Float
    vv: Float

    @property
    def rms(self) -> tuple[Float, Float]:
        """Rms residuals in u and v of the stars used; NaN without stars."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(self.uu / self.n_used), np.sqrt(self.vv / self.n_used)


@dataclass(frozen=True, eq=False)
class StarSums(Sums):
    """Sums over stars at a solution."""

    # residuals of probably true stars at the solution, by the number of the chip and the numbers of
    # bins in x and y. If exposures have rotated frames, they are along the axes of the polynomials:
    # along those of the sky, effects of the detector would cancel
    binned: Mapping[tuple[int, Bins], BinnedSums]
    exposures: ExposureSums  # at the least-squares fit


def star_sums(
    stars: Stars,
    fit: Likelihood,
    solution: Likelihood,
    partitions: Mapping[int, tuple[Bins, ...]],
) -> StarSums:
    """Sums over stars: a task for `Shards.sum`.

    `fit` is the likelihood of the least-squares fit, and `solution` that of the posterior, or the
    fit again without a posterior: the clipping of a fit may accept false matches that hide effects
    in the residuals of true ones.  `partitions` are the numbers of bins in x and y, by the number
    of the chip.
    """
    used, residual = fit.inliers(stars) > 0.5, stars.residuals(fit.theta)
    exposures = _exposure_sums(stars, used, residual)
    if solution is not fit:
        used, residual = solution.inliers(stars) > 0.5, stars.residuals(solution.theta)
    code = _of_groups(stars, stars.groups.chip)
    arrays = (*stars.pixels(), *_along_gauge(stars, solution.theta, residual).T)
    binned = {}
    for number, several in partitions.items():
        k = stars.model.chip_code(number)
        good = used & (code == k)
        chip_arrays = arrays if good.all() else tuple(a[good] for a in arrays)
        size = stars.model.chips[k].size
        for bins in several:
            binned[number, bins] = binned_sums(
                *chip_arrays, bins=bins, size=size, mixed=stars.is_correlated
            )
    return StarSums(binned, exposures)


def star_bins(
    table: Matches,
    code: Int,
    model: DistortionModel,
    solution: Likelihood,
    partitions: Mapping[int, tuple[Bins, ...]],
) -> dict[tuple[int, Bins], BinnedSums]:
    """Sums over bins in which the detections of one star count as one, at their mean.

    Detections of a star share the error of its reference position, so that the means of bins
    scatter according to the number of stars.  `code` (N,) is the star of each match, or the tight
    group of stars; for the other arguments see `star_sums`.
    """
    stars, order = prepare(model, table)
    used, residual = solution.inliers(stars) > 0.5, stars.residuals(solution.theta)
    values = np.stack([*stars.pixels(), *_along_gauge(stars, solution.theta, residual).T])
    chip, code = _of_groups(stars, stars.groups.chip), code[order]
    out = {}
    for number, several in partitions.items():
        on_chip = used & (chip == model.chip_code(number))
        size = model.chips[model.chip_code(number)].size
        chip_values, star = values[:, on_chip], code[on_chip]
        for nx, ny in several:
            X, Y = (2 * (chip_values[k] - 0.5) / size[k] - 1 for k in (0, 1))
            cell = cell_index(X, Y, (nx, ny))
            _, of = joint_clusters(cell, star)
            means = [np.bincount(of, z) / np.bincount(of) for z in chip_values]
            out[number, (nx, ny)] = binned_sums(
                *means, bins=(nx, ny), size=size, mixed=stars.is_correlated
            )
    return out


def _along_gauge(stars: Stars, theta: Float, residual: Float) -> Float:
    """Residuals along the axes of the polynomials, before frames are applied."""
    if not stars.model.n_frame:
        return residual
    out = residual.copy()
    for g, e in enumerate(stars.groups.exposure):
        matrix, _ = stars.model.frame(theta, int(e))
        rows = slice(stars.starts[g], stars.starts[g + 1])
        out[rows] = np.linalg.solve(matrix, residual[rows].T).T
    return out


def flagged_by_exposure(shards: Shards, posterior: Posterior) -> Int:
    """Number (E,) of stars in each exposure that are more likely false matches than true.

    `shards` contains all stars; one pass over them is made.
    """
    return shards.sum(_flagged, *averaged_draws(posterior))


def _flagged(stars: Stars, theta: Float, constants: Constants) -> Int:
    p = star_averages(stars, theta, constants)[0]
    exposure = _of_groups(stars, stars.groups.exposure)
    return np.bincount(exposure[p > 0.5], minlength=len(stars.model.exposures))


def _of_groups(stars: Stars, codes: Int) -> Int:
    """Codes (N,) of the groups, repeated for each of their stars."""
    return np.repeat(codes, np.diff(stars.starts))


def _exposure_sums(stars: Stars, used: Bool, residual: Float) -> ExposureSums:
    exposure, n = _of_groups(stars, stars.groups.exposure), len(stars.model.exposures)
    of_used = exposure[used]
    u, v = residual[used].T
    return ExposureSums(
        n=np.bincount(exposure, minlength=n),
        n_used=np.bincount(of_used, minlength=n),
        uu=np.bincount(of_used, u * u, minlength=n).astype(np.float64),
        vv=np.bincount(of_used, v * v, minlength=n).astype(np.float64),
    )
