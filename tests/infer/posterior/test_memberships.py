"""What the posterior says of each star: by Bayes' theorem in numpy, in the order of the table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.infer import GaussianPriors, OutlierMixture, load, memberships
from bayesdist.infer.density.target import Target
from bayesdist.infer.posterior.memberships import count_outliers, some_draws, star_log_likelihood
from tests.batched import in_batches

from ..oracle import star_terms
from ..support import MIXTURES, TWO_CHIPS, posterior_at, residual_of, simulated, table, target_of

pytestmark = pytest.mark.usefixtures("one_thread")

ALL = MIXTURES | {
    "jitter fixed": (OutlierMixture(jitter=0.03), [-3.0, np.log(0.8)]),
    "nothing is sampled": (OutlierMixture("none", jitter=0.01), []),
}
DRAWS = 9


@pytest.fixture(scope="module", params=ALL.values(), ids=ALL)
def known(request):
    """A posterior of a few draws, and the same numbers star by star."""
    mixture, h = request.param
    rng = np.random.default_rng(7)
    model, matches, _ = simulated(
        131, 400, frames="shift", n_exposures=2, chips=TWO_CHIPS, fraction=0.1
    )
    matches = matches.select(rng.permutation(400))
    target, fit = target_of(model, matches, mixture)
    psi = np.concatenate([fit.mean, h]) + 0.05 * rng.standard_normal(
        (DRAWS, model.n_params + len(h))
    )
    posterior = posterior_at(target, psi)
    p, loglik = [], []
    for k in range(DRAWS):
        terms = star_terms(
            mixture.model,
            residual_of(model, psi[k, : model.n_params], matches),
            matches.sigma_u**2,
            matches.sigma_v**2,
            radius=mixture.match_radius or 1.0,
            **({"j": mixture.jitter} | {n: v[0, k] for n, v in posterior.hyper.items()}),
        )
        p.append(terms.outlier)
        loglik.append(terms.loglik)
    return target, posterior, matches, np.array(p), np.array(loglik), psi


def test_memberships_are_means_over_the_draws(known):
    _, posterior, matches, p, loglik, _ = known
    found = memberships(posterior, matches)
    assert found.draws == DRAWS
    np.testing.assert_allclose(found.outlier_probability, p.mean(axis=0), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.log_likelihood, loglik.mean(axis=0), rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(
        found.log_likelihood_variance, loglik.var(axis=0), rtol=1e-6, atol=1e-9
    )


@pytest.mark.parametrize("at_a_time", [1, 1000, 1_000_000])
def test_log_likelihoods_of_the_stars_add_up_to_the_density(known, at_a_time):
    target, posterior, matches, _, loglik, psi = known
    by_star = star_log_likelihood(posterior, matches, at_a_time)
    assert by_star.shape == (1, DRAWS, 400)
    np.testing.assert_allclose(by_star[0], loglik, rtol=1e-10, atol=1e-9)
    prior = target.hyper.log_prior(psi[:, target.n_theta :])
    np.testing.assert_allclose(by_star[0].sum(axis=1) + prior, posterior.log_prob[0], rtol=1e-12)
    for k in (0, DRAWS - 1):
        # theta has a flat prior here: value, gradient and Hessian come with the same number
        assert target.expand(psi[k])[0] == pytest.approx(posterior.log_prob[0, k], rel=1e-12)


def test_some_of_the_stars_are_as_in_the_whole(known):
    """Also where some groups have none."""
    _, posterior, matches, *_ = known
    whole = memberships(posterior, matches)
    for rows in (np.arange(0, 400, 7), np.flatnonzero(matches.exposure == 1), np.array([5])):
        part = memberships(posterior, matches.select(rows))
        for name in ("outlier_probability", "log_likelihood", "log_likelihood_variance"):
            np.testing.assert_allclose(
                getattr(part, name), getattr(whole, name)[rows], rtol=1e-12, atol=1e-14
            )


def test_points_are_those_that_were_sampled(known):
    target, posterior, _, _, _, psi = known
    theta, h = posterior.sampled_points
    np.testing.assert_array_equal(theta, psi[:, : target.n_theta])
    np.testing.assert_allclose(h, psi[:, target.n_theta :], rtol=1e-12, atol=1e-12)


def test_outliers_are_counted(known):
    target, _, matches, p, _, psi = known
    n = target.n_theta
    # the threshold is not hit by chance
    assert np.abs(p.mean(axis=0) - 0.5).min() > 1e-6
    for piece in (2**20, 90):
        shards = load(target.model, in_batches(matches, piece))
        flagged, expected = count_outliers(shards, target.hyper, psi[:, :n], psi[:, n:])
        assert type(flagged) is int and flagged == (p.mean(axis=0) > 0.5).sum()
        assert expected == pytest.approx(p.mean(axis=0).sum(), rel=1e-10, abs=1e-12)


def test_fewer_draws_for_more_stars():
    theta, h = np.arange(1000.0)[:, None], np.zeros((1000, 0))
    for n_stars, draws in ((10, 64), (3_125_000, 64), (6_250_000, 32), (10**7, 20), (10**9, 8)):
        some, rest = some_draws(theta, h, n_stars)
        assert len(some) == len(rest) == draws
        assert some[0, 0] == 0 and some[-1, 0] == 999  # from the first to the last
        assert np.ptp(np.diff(some[:, 0])) <= 1
    assert len(some_draws(theta[:5], h[:5], 10)[0]) == 5


def test_draws_are_chosen_by_the_stars_of_the_posterior(known):
    """Some of the stars are judged by the same draws as all of them."""
    _, posterior, matches, *_ = known
    assert memberships(posterior, matches.select(np.arange(10))).draws == DRAWS
    many = replace(posterior, n_stars=10**9)
    assert memberships(many, matches).draws == 8
    assert memberships(many, matches.select(np.arange(10))).draws == 8


def test_planted_outliers_come_out_where_they_were_put():
    """Stars of two chips and exposures are sorted inside; planted outliers must come out again."""
    model, matches, _ = simulated(32, 200, frames="shift", n_exposures=2, chips=TWO_CHIPS)
    shuffled = matches.select(np.random.default_rng(3).permutation(200))
    u = shuffled.u.copy()
    planted = [3, 50, 51, 190]
    u[planted] += 3.0
    bad = table(
        shuffled.x,
        shuffled.y,
        u,
        shuffled.v,
        exposure=shuffled.exposure,
        exposure_names=shuffled.exposure_names,
        chip=shuffled.chip,
        chip_numbers=shuffled.chip_numbers,
    )
    target, fit = target_of(model, bad, OutlierMixture())
    psi = np.concatenate([fit.mean, MIXTURES["gaussian"][1]])
    p = memberships(posterior_at(target, psi[None]), bad).outlier_probability
    np.testing.assert_array_equal(np.flatnonzero(p > 0.5), planted)
    assert not fit.uses(bad)[planted].any()


def test_the_scale_of_the_priors_does_not_touch_the_likelihood():
    """The posterior keeps it as its reference sigma, in which densities are only expressed."""
    model, matches, _ = simulated(133, 100, fraction=0.1)
    shards = load(model, matches)
    target = Target(shards, OutlierMixture(), GaussianPriors.none(model))
    theta = simulated(133, 100, fraction=0.1)[2].theta
    posterior = posterior_at(target, np.concatenate([theta, MIXTURES["gaussian"][1]])[None])
    found = memberships(posterior, matches)
    object.__setattr__(posterior, "reference_sigma", 1e-4 * posterior.reference_sigma)
    again = memberships(posterior, matches)
    np.testing.assert_allclose(again.log_likelihood, found.log_likelihood, rtol=1e-12)
    np.testing.assert_allclose(
        again.outlier_probability, found.outlier_probability, rtol=1e-10, atol=1e-14
    )
