"""Probability that each star is a false match, averaged over posterior draws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.infer.kernel import Constants
from bayesdist.infer.posterior.posterior import Posterior
from bayesdist.infer.stars.likelihood import Hyper, star_averages, star_log_likelihoods
from bayesdist.infer.stars.shards import Shards
from bayesdist.infer.stars.stars import Stars, in_table_order, prepare
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.quantities import takes

MOST_DRAWS, LEAST_DRAWS = 64, 8
AT_A_TIME = 1_000_000  # log-likelihoods (stars times draws) that are computed at a time
EVALUATIONS = 200_000_000  # limit on stars times draws that are averaged


@dataclass(frozen=True, eq=False)
class Memberships:
    """Outlier probability and log-likelihood of each star.

    Parameters
    ----------
    outlier_probability : ndarray, shape (N,)
        Probability that a star is a false match, averaged over the draws.
    log_likelihood : ndarray, shape (N,)
        Mean over the draws.
    log_likelihood_variance : ndarray, shape (N,)
        Variance over the draws.
    draws : int
        Number of posterior draws that were averaged.
    """

    outlier_probability: Float
    log_likelihood: Float
    log_likelihood_variance: Float
    draws: int

    def in_table_order(self, order: Int) -> Memberships:
        """Memberships reordered to the rows of the table; `order` (N,) is that of `prepare`."""
        return Memberships(
            in_table_order(self.outlier_probability, order),
            in_table_order(self.log_likelihood, order),
            in_table_order(self.log_likelihood_variance, order),
            self.draws,
        )


def some_draws(theta: Float, h: Float, n_stars: int) -> tuple[Float, Float]:
    """Evenly spaced subset of the draws theta (n, D) and h (n, n_hyper).

    The subset is smaller if there are more stars, `n_stars`, because the posterior is then
    narrower.
    """
    n = int(np.clip(EVALUATIONS // n_stars, LEAST_DRAWS, MOST_DRAWS))
    rows = np.linspace(0, len(theta) - 1, min(n, len(theta))).astype(int)
    return theta[rows], h[rows]


@takes(posterior=Posterior, matches=Matches)
def memberships(posterior: Posterior, matches: Matches) -> Memberships:
    """Probability that each star is a false match, and its log-likelihood.

    Parameters
    ----------
    posterior : Posterior
    matches : Matches
        The stars from which the posterior was sampled, or a subset.

    Returns
    -------
    Memberships
        In the order of the rows of `matches`.

    Raises
    ------
    InputError
        If the matches have no errors, another unit than the model, or other chips.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> rng = np.random.default_rng(1)
    >>> matches, truth = simulate_wise(500, rng=rng)
    >>> model = bd.build_model(matches, order=2, size=(1016, 1016))
    >>> fit = bd.fit_linear(matches, model)
    >>> posterior = bd.sample(fit, matches, seed=1, target_ess=100)
    >>> doubted = bd.memberships(posterior, matches).outlier_probability > 0.5
    >>> doubted.shape
    (500,)
    """
    stars, order = prepare(posterior.model, matches)
    return memberships_of(posterior, stars).in_table_order(order)


def memberships_of(posterior: Posterior, stars: Stars) -> Memberships:
    """Memberships of stars that are already prepared for the posterior's model, in their order."""
    theta, constants = averaged_draws(posterior)
    p, mean, square = star_averages(stars, theta, constants)
    return Memberships(p, mean, np.maximum(square - mean**2, 0.0), len(theta))


def averaged_draws(posterior: Posterior) -> tuple[Float, Constants]:
    """Draws over which memberships are averaged: theta (n, D), and the mixture at each draw.

    If the stars' positions are unknowns too, only the mean is used: the positions of the stars are
    those of the mean and would differ at any other draw.
    """
    if posterior.own_places:
        theta, h = (points.mean(axis=0, keepdims=True) for points in posterior.sampled_points)
    else:
        theta, h = some_draws(*posterior.sampled_points, posterior.n_stars)
    return theta, posterior.bound_mixture.constants(h)


def star_log_likelihood(
    posterior: Posterior, matches: Matches, at_a_time: int = AT_A_TIME
) -> Float:
    """Log-likelihood (chains, draws, N) of each star at every draw.

    About `at_a_time` values (stars times draws) are computed at a time.
    """
    stars, order = prepare(posterior.model, matches)
    theta, h = posterior.sampled_points
    constants = posterior.bound_mixture.constants(h)
    out = np.empty((len(theta), len(matches)))
    step = max(1, at_a_time // max(1, len(matches)))
    for k in range(0, len(theta), step):
        rows = slice(k, k + step)
        values = star_log_likelihoods(stars, theta[rows], constants.of(rows))
        out[rows] = in_table_order(values.T, order).T
    return out.reshape(*posterior.log_prob.shape, len(matches))


def count_outliers(shards: Shards, hyper: Hyper, theta: Float, h: Float) -> tuple[int, float]:
    """Count stars of outlier probability above 0.5, and expected false matches.

    `theta` (n, D) and `h` (n, n_hyper) are all posterior draws; the result is averaged over a
    subset.
    """
    theta, h = some_draws(theta, h, len(shards))
    flagged, expected = shards.sum(_count, theta, hyper.constants(h))
    return int(flagged), float(expected)


def _count(stars: Stars, theta: Float, constants: Constants) -> Float:
    p = star_averages(stars, theta, constants)[0]
    return np.array([(p > 0.5).sum(), p.sum()])
