"""The closed form: without outliers and with known errors the posterior *is* least squares.

Laplace and formal covariance agree to 1e-9; the sampled standard deviations agree with the formal
ones within their Monte-Carlo errors.

The rule for the latter.  The walkers of independence and Crank-Nicolson moves do not influence each
other and start from exact draws, so the 64 walker averages of (theta - mean)^2 are independent and
identically distributed, and their mean over sigma^2 follows 1 + s/8 t_63.  Over all orders that is
438 parameters, of which 1.6 are expected beyond 3 standard errors.  Asked for is therefore

- no parameter beyond the Bonferroni limit at 1e-3 over all 438 (5.2 standard errors), and
- no more parameters of an order beyond 3 than a binomial count exceeds with probability 1e-3.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.infer import OutlierMixture, sample
from bayesdist.infer.density.grid import build_proposal
from tests.reduced import case_in_full

from .support import UNCLIPPED, simulated, target_of

pytestmark = pytest.mark.usefixtures("one_thread")

ORDERS = range(1, 10)
CERTAIN = OutlierMixture("none", jitter=0.0)
ALL = sum((n + 1) * (n + 2) for n in ORDERS)


def problem(order: int):
    rng = np.random.default_rng(order)
    n = 400
    sigma = (rng.uniform(0.02, 0.1, n), rng.uniform(0.02, 0.1, n))
    model, matches, _ = simulated(60 + order, n, order=order, sigma=sigma)
    target, fit = target_of(model, matches, CERTAIN, **UNCLIPPED)
    return target, fit, matches


@pytest.mark.parametrize("order", ORDERS)
def test_laplace_covariance_is_the_least_squares_covariance(order):
    target, fit, _ = problem(order)
    (node,) = build_proposal(target, fit).nodes
    sigma = np.sqrt(np.diag(fit.cov))
    unit = np.outer(sigma, sigma)
    np.testing.assert_allclose(node.factor.covariance() / unit, fit.cov / unit, rtol=0, atol=1e-9)
    np.testing.assert_allclose((node.mode - fit.mean) / sigma, 0, atol=1e-6)


@pytest.mark.parametrize(
    "order",
    [
        order if order in (1, 5, 9) else case_in_full(order, instead="others are run")
        for order in ORDERS
    ],
)
def test_the_proposal_is_the_posterior(order):
    """Both densities differ by the same constant everywhere."""
    target, fit, _ = problem(order)
    proposal = build_proposal(target, fit)
    psi = proposal.draw(50, np.random.default_rng(0))
    difference = target.log_density(psi) - proposal.log_density(psi)
    assert np.ptp(difference) < 1e-6


def test_orders_have_438_parameters():
    assert ALL == 438


@pytest.mark.parametrize(
    "order",
    [
        case_in_full(n, instead="lower orders and 9 are run") if n in (6, 7, 8) else n
        for n in ORDERS
    ],
)
def test_sampled_sd_is_the_formal_sigma(order):
    _, fit, matches = problem(order)
    posterior = sample(fit, matches, outliers=CERTAIN, seed=order, walkers=16)
    assert posterior.convergence.converged, posterior.convergence.reasons
    info = posterior.sampler
    assert info.acceptance > 0.9
    E, draws, D = posterior.theta.shape
    by_walker = posterior.theta.reshape(E * info.walkers, draws // info.walkers, D)
    n = len(by_walker)
    assert n == 64

    def standard_errors(values):
        """Deviation of the mean over walkers from zero, in its standard errors."""
        means = values.mean(axis=1)
        return means.mean(axis=0) / (means.std(axis=0, ddof=1) / np.sqrt(n))

    deviation = (by_walker - fit.mean) / fit.sigma
    limit = stats.t(n - 1).isf(0.5e-3 / ALL)
    most = stats.binom(D, 2 * stats.t(n - 1).sf(3)).ppf(1 - 1e-3)
    for values in (deviation**2 - 1, deviation):
        t = np.abs(standard_errors(values))
        assert t.max() < limit
        assert (t > 3).sum() <= most
    # and the correlations: whitened by the formal covariance the draws are white
    white = np.linalg.solve(np.linalg.cholesky(fit.cov), (posterior.flat - fit.mean).T)
    scatter = (white**2).mean(axis=1)
    enough = 0.7 * white.shape[1]  # effective draws at the acceptance of these moves
    np.testing.assert_allclose(scatter, 1, atol=5.2 * np.sqrt(2 / enough))
    # the log density falls from its top by half a chi-square with D degrees of freedom
    quoted = np.log(2 * np.pi * matches.sigma_u * matches.sigma_v)
    depth = 2 * (-0.5 * fit.chi2 - quoted.sum() - posterior.log_prob)
    assert depth.mean() == pytest.approx(D, abs=5.2 * np.sqrt(2 * D / enough))
