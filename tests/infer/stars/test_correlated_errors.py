"""Errors that are correlated between u and v: closed forms of scipy and numpy, and derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import expit, logsumexp
from scipy.stats import multivariate_normal

from bayesdist.diagnose.holdout.predictive import frames_for, predictive_of
from bayesdist.diagnose.score.sample import scored_sample
from bayesdist.errors import InputError
from bayesdist.infer import OutlierMixture, fit_linear
from bayesdist.infer.stars.likelihood import MixtureAt
from bayesdist.infer.stars.stars import prepare
from tests.infer.support import (
    MIXTURES,
    UNCLIPPED,
    legendre_design,
    numerical_gradient,
    posterior_at,
    residual_of,
    simulated,
    target_of,
)

pytestmark = pytest.mark.usefixtures("one_thread")
LARGEST = 0.97


def correlated(seed: int = 1, n: int = 300, **more):
    """A model, matches with errors of all shapes and directions, and their covariances."""
    model, matches, truth = simulated(seed, n, **more)
    rng = np.random.default_rng([seed, 46])
    sigma = 0.05 * np.exp(0.5 * rng.standard_normal((2, n)))
    rho = rng.uniform(-LARGEST, LARGEST, n)
    rho[:5] = 0.0
    matches = matches.with_columns(sigma_u=sigma[0], sigma_v=sigma[1], rho_uv=rho)
    mixed = rho * sigma[0] * sigma[1]
    C = np.moveaxis(np.array([[sigma[0] ** 2, mixed], [mixed, sigma[1] ** 2]]), -1, 0)
    error = np.einsum("nij,nj->ni", np.linalg.cholesky(C), rng.standard_normal((n, 2)))
    uv = model.predict(truth.theta, matches.x, matches.y, **exposures_of(model, matches)) + error
    return model, matches.with_columns(u=uv[:, 0], v=uv[:, 1]), C


def exposures_of(model, matches) -> dict[str, np.ndarray]:
    return {} if model.frames == "none" else {"exposure": matches.exposure}


def test_least_squares_is_that_of_full_covariances():
    model, matches, C = correlated(order=3)
    fit = fit_linear(matches, model, **UNCLIPPED)
    phi = legendre_design(3, matches.x, matches.y)
    A = np.einsum("ab,nk->nabk", np.eye(2), phi).reshape(len(phi), 2, -1)
    W = np.linalg.inv(C)
    normal = np.einsum("nak,nab,nbl->kl", A, W, A)
    right = np.einsum("nak,nab,nb->k", A, W, np.stack([matches.u, matches.v], axis=1))
    expected = np.linalg.solve(normal, right)
    np.testing.assert_allclose(fit.mean, expected, atol=1e-8)
    np.testing.assert_allclose(fit.cov, np.linalg.inv(normal), rtol=1e-7, atol=1e-14)
    r = residual_of(model, fit.mean, matches)
    chi2 = np.einsum("na,nab,nb->", r, W, r)
    assert fit.chi2 == pytest.approx(chi2, rel=1e-9)


def log_likelihood(model, matches, C, theta, h, mixture) -> float:
    j = np.exp(h[0])
    r = residual_of(model, theta, matches)
    core = [
        multivariate_normal.logpdf(x, cov=c + j**2 * np.eye(2)) for x, c in zip(r, C, strict=True)
    ]
    if mixture.model == "none":
        return float(np.sum(core))
    f = expit(h[1])
    if mixture.model == "uniform":
        false = np.full(len(r), -np.log(np.pi * mixture.match_radius**2))
    else:
        median = np.median(np.stack([matches.sigma_u, matches.sigma_v]))
        wide = median**2 + j**2 + np.exp(2 * h[2])
        false = multivariate_normal.logpdf(r, cov=wide * np.eye(2))
    both = np.stack([np.log1p(-f) + np.array(core), np.log(f) + false])
    return float(logsumexp(both, axis=0).sum())


@pytest.mark.parametrize("name", MIXTURES)
def test_the_likelihood_is_that_of_bivariate_normals(name):
    mixture, h = MIXTURES[name]
    model, matches, C = correlated(n=700, order=2, frames="shift_rotation", n_exposures=3)
    target, fit = target_of(model, matches, mixture)
    rng = np.random.default_rng(3)
    found, expected = [], []
    for _ in range(3):
        theta = np.asarray(fit.mean) + 0.02 * rng.standard_normal(model.n_params)
        at = np.array(h) + 0.2 * rng.standard_normal(len(h))
        found.append(target.log_density(np.concatenate([theta, at])[None])[0])
        found[-1] -= target.hyper.log_prior(at[None])[0]
        expected.append(log_likelihood(model, matches, C, theta, at, mixture))
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("name", MIXTURES)
@pytest.mark.parametrize("nominal", [False, True])
def test_derivatives_are_those_of_the_density(name, nominal):
    mixture, h = MIXTURES[name]
    model, matches, _ = correlated(n=200, order=2)
    if nominal:
        mixture = OutlierMixture(mixture.model, match_radius=0.6)
        near = {"u_nominal": matches.u + 0.1, "v_nominal": matches.v - 0.05}
        matches = matches.with_columns(**near)
    target, fit = target_of(model, matches, mixture)
    psi = np.concatenate([fit.mean, h])
    value, gradient, matrix = target.expand(psi)

    def density(points):
        return target.log_density(np.atleast_2d(points))

    assert value == pytest.approx(density(psi)[0], rel=1e-10)
    step = np.full(len(psi), 1e-4)
    np.testing.assert_allclose(
        gradient, numerical_gradient(density, psi, step).ravel(), rtol=2e-5, atol=1e-3
    )
    dense = matrix.dense()
    columns = [
        (target.expand(psi + e)[1] - target.expand(psi - e)[1]) / 2e-4
        for e in 1e-4 * np.eye(len(psi))
    ]
    np.testing.assert_allclose(
        dense, -np.array(columns), rtol=1e-4, atol=0.02 * np.abs(dense).max() * 1e-3
    )


def test_scores_of_single_stars_are_derivatives_with_respect_to_their_position():
    model, matches, _ = correlated(n=50)
    mixture = OutlierMixture()
    target, fit = target_of(model, matches, mixture)
    constants = target.hyper.constants(np.array([MIXTURES["gaussian"][1]]))
    stars, _ = prepare(model, matches)
    at = MixtureAt(np.asarray(fit.mean), constants)
    scores = at.scores(stars)
    sums = [scores[:2] @ phi for phi in legendre_design(2, matches.x, matches.y).T]
    h = np.array(MIXTURES["gaussian"][1])

    def density(points):
        points = np.atleast_2d(points)
        return np.array([target.log_density(np.append(p, h)[None])[0] for p in points])

    numeric = numerical_gradient(density, np.asarray(fit.mean), np.full(model.n_params, 1e-4))
    np.testing.assert_allclose(np.array(sums).T.ravel(), numeric.ravel(), rtol=1e-4, atol=1e-3)


def test_residuals_in_units_of_their_errors_are_independent():
    n = 20_000
    model, matches, _ = correlated(n=n)
    fit = fit_linear(matches, model, **UNCLIPPED)
    sample = scored_sample(matches, fit)
    # correlations are even about zero, and products are compared by their sign
    sign = np.sign(matches.rho_uv)
    z, raw = sample.whitened, sample.residual / np.sqrt(sample.variance)
    np.testing.assert_allclose((z**2).mean(axis=1), 1.0, atol=4 * np.sqrt(2 / n))
    assert abs(np.mean(sign * z[0] * z[1])) < 4 / np.sqrt(n)
    assert np.mean(sign * raw[0] * raw[1]) > 0.4


def test_errors_are_scaled_and_added_with_their_correlation(rng):
    _, matches, C = correlated(n=40)
    np.testing.assert_allclose(matches.covariances(), C)
    np.testing.assert_allclose(matches.with_scaled_errors(3.0).covariances(), 9 * C)
    more = matches.with_errors((0.03, 0.04), in_quadrature=True).covariances()
    np.testing.assert_allclose(more, C + np.diag([0.0009, 0.0016]))
    np.testing.assert_allclose(matches.with_covariances(2 * C).covariances(), 2 * C)
    assert matches.with_errors(0.05).rho_uv is None


@pytest.mark.parametrize("rho", [-0.97, 0.9])
@pytest.mark.parametrize("mixture", ["none", "gaussian"])
def test_the_frame_of_a_held_out_exposure_is_found(rho, mixture):
    """Steps that take the variances alone diverge."""
    model, matches, _ = correlated(n=900, frames="shift", n_exposures=2)
    C, rng = matches.covariances(), np.random.default_rng(5)
    C[:, 0, 1] = C[:, 1, 0] = rho * matches.sigma_u * matches.sigma_v
    target, fit = target_of(model, matches, MIXTURES[mixture][0])
    truth = np.asarray(fit.mean)
    uv = model.predict(truth, matches.x, matches.y, exposure=matches.exposure)
    uv += np.einsum("nij,nj->ni", np.linalg.cholesky(C), rng.standard_normal((900, 2)))
    matches = matches.with_covariances(C).with_columns(u=uv[:, 0], v=uv[:, 1])
    draws = rng.multivariate_normal(truth, fit.cov, 200)
    hyper = np.array(MIXTURES[mixture][1])
    hyper[0] = np.log(1e-3)  # no jitter to speak of
    rows = np.concatenate([draws, np.tile(hyper, (200, 1))], axis=1)
    held = matches.select(matches.exposure == 1)
    held = held.with_columns(exposure=np.zeros(len(held), int), exposure_names=("new",))
    found = frames_for(predictive_of(posterior_at(target, rows)), held, ("new",))["new"]
    # the shift of the second exposure, within the errors of some 450 stars
    np.testing.assert_allclose(found.values, truth[-2:], atol=4 * 0.06 / np.sqrt(450))


@pytest.mark.parametrize("rho", [1.0, -1.2, np.nan])
def test_impossible_correlations_are_refused(rho):
    _, matches, _ = correlated(n=20)
    with pytest.raises(InputError, match="rho_uv"):
        matches.with_columns(rho_uv=np.full(20, rho))
