"""The posterior density: its value written out, its gradient and Hessian by differences."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from bayesdist.errors import InputError
from bayesdist.infer import GaussianPriors, OutlierMixture, load
from bayesdist.infer.density.target import Target, log_likelihood
from bayesdist.infer.posterior.memberships import star_log_likelihood
from bayesdist.infer.stars.stars import prepare
from bayesdist.model import FRAME_KINDS, DistortionModel

from ..support import (
    CHIP,
    MIXTURES,
    TWO_CHIPS,
    UNCLIPPED,
    numerical_gradient,
    posterior_at,
    residual_of,
    simulated,
    target_of,
)

pytestmark = pytest.mark.usefixtures("one_thread")

FIXED = {
    "gaussian, jitter fixed": (OutlierMixture(jitter=0.02), [-3.0, np.log(0.8)]),
    "uniform, jitter fixed": (OutlierMixture("uniform", match_radius=2.0, jitter=0.0), [-3.0]),
    "nothing": (OutlierMixture("none", jitter=0.01), []),
}


def problem(kind, frames="none", n=150, chips=(CHIP,), **priors):
    model, matches, truth = simulated(
        31, n, frames=frames, n_exposures=2, chips=chips, fraction=0.1
    )
    prior = GaussianPriors.of(model, priors)
    mixture, h = (MIXTURES | FIXED)[kind]
    found, fit = target_of(model, matches, mixture, prior, **UNCLIPPED)
    return found, fit, matches, np.concatenate([fit.mean, h]), truth


@pytest.mark.parametrize("kind", MIXTURES)
def test_value_is_likelihood_times_priors(kind):
    named = {"v_1_1": (0.1, 0.03)}
    found, _, matches, psi, _ = problem(kind, "affine", **named)
    model = found.model
    other = psi + 0.01 * np.random.default_rng(0).standard_normal(len(psi))
    values, each = [], []
    for p in (psi, other):
        theta, h = p[: model.n_params], p[model.n_params :]
        r = residual_of(model, theta, matches)
        j = np.exp(h[0])
        good = stats.norm(scale=np.hypot(0.05, j)).logpdf(r).sum(axis=1)
        log_prior = np.log(2) + stats.t(4, scale=0.05).logpdf(j) + h[0]
        if kind == "none":
            loglik = good
        else:
            f = 1 / (1 + np.exp(-h[1]))
            log_prior += stats.beta(1, 9).logpdf(f) + np.log(f * (1 - f))
            bad = np.full(len(r), -np.log(np.pi * 4))
            if kind == "gaussian":
                core, excess = 0.05**2 + j**2, np.exp(2 * h[2])
                bad = stats.norm(scale=np.sqrt(core + excess)).logpdf(r).sum(axis=1)
                log_prior += stats.invgamma(1, scale=25 * core).logpdf(excess)
                log_prior += np.log(2 * excess)
            loglik = np.logaddexp(np.log1p(-f) + good, np.log(f) + bad)
        k = model.names.index("v_1_1")
        log_prior += -0.5 * ((theta[k] - 0.1) / 0.03) ** 2
        values.append(loglik.sum() + log_prior)
        each.append(loglik)
    both = np.array([psi, other])
    np.testing.assert_allclose(found.log_density(both), values, rtol=1e-11)
    # and star by star, in the order of the table
    by_star = star_log_likelihood(posterior_at(found, both), matches)
    np.testing.assert_allclose(by_star[0], each, atol=1e-9)


@pytest.mark.parametrize("kind", MIXTURES)
def test_many_points_are_each_by_itself(kind):
    found, _, _, psi, _ = problem(kind, "affine")
    points = psi + 0.01 * np.random.default_rng(1).standard_normal((7, len(psi)))
    together = found.log_density(points)
    np.testing.assert_array_equal(together, [found.log_density(p[None])[0] for p in points])
    for scratch in (1, 16 * 6 * 2 * 3):  # room for one, and for three of them
        theta, h = points[:, : found.n_theta], points[:, found.n_theta :]
        constants = found.hyper.constants(h)
        of_one, of_few = (
            found.shards.sum(log_likelihood, theta, constants, *limit) for limit in ((), (scratch,))
        )
        np.testing.assert_array_equal(of_few, of_one)


def test_points_that_are_not_finite_have_no_density():
    found, _, _, psi, _ = problem("gaussian")
    points = np.array([psi] * 4)
    points[1, 0], points[2, -1], points[3, -3] = np.nan, np.inf, -np.inf
    values = found.log_density(points)
    assert np.isfinite(values[0]) and (values[1:] == -np.inf).all()
    assert (found.log_density(points[1:]) == -np.inf).all()
    assert found.log_density(points[:0]).shape == (0,)


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.floats(-30, 30), min_size=3, max_size=3),
    st.floats(-1e6, 1e6),
)
def test_far_from_the_posterior_the_density_is_a_number(h, shift):
    """Whatever a move proposes: never NaN, and what is far away is worse."""
    found, psi = _far()
    points = np.array([psi, psi])
    points[1, -3:] = h
    points[1, 0] += shift
    best, far = found.log_density(points)
    assert not np.isnan(far) and far < np.inf
    assert far < best + 1000


@cache
def _far():
    found, _, _, psi, _ = problem("gaussian")
    return found, psi


@pytest.mark.parametrize("kind", MIXTURES | FIXED)
@pytest.mark.parametrize("frames", FRAME_KINDS)
def test_gradient_by_differences(kind, frames):
    found, fit, _, psi, _ = problem(kind, frames, u_1_1=(0.1, 0.03))
    scale = np.concatenate([fit.sigma, np.full(len(psi) - len(fit.sigma), 0.1)])
    psi = psi + scale * np.random.default_rng(2).standard_normal(len(psi))
    value, gradient, _ = found.expand(psi)
    assert value == pytest.approx(found.log_density(psi[None])[0], abs=1e-8)
    numeric = numerical_gradient(lambda p: found.log_density(p[None])[0], psi, 1e-2 * scale)
    # in units of one sigma, where the gradient is of order one
    np.testing.assert_allclose(gradient * scale, numeric * scale, rtol=1e-5, atol=1e-5)
    em_value, em_gradient, _ = found.expand(psi, em=True)
    assert em_value == value
    np.testing.assert_array_equal(em_gradient, gradient)


@pytest.mark.parametrize("kind", MIXTURES | FIXED)
def test_hessian_by_differences(kind):
    """Shifts are linear in the parameters, so that the Hessian has no further terms."""
    found, fit, _, psi, _ = problem(kind, "shift", chips=TWO_CHIPS)
    scale = np.concatenate([fit.sigma, np.full(len(psi) - len(fit.sigma), 0.1)])
    curvature = found.expand(psi)[2]
    numeric = -numerical_gradient(lambda p: found.expand(p)[1], psi, 1e-2 * scale)
    unit = np.outer(scale, scale)
    np.testing.assert_allclose(curvature.dense() * unit, numeric * unit, rtol=1e-5, atol=1e-5)
    safe = found.expand(psi, em=True)[2].dense()
    assert np.linalg.eigvalsh(safe * unit)[0] > 0
    n = found.n_theta
    assert (safe[n:, :n] == 0).all()  # memberships held: nothing couples


def test_em_curvature_is_positive_where_the_hessian_is_not():
    """Far from the mode most stars waver, and Newton's step would lead uphill in nothing."""
    found, fit, _, psi, _ = problem("gaussian", "shift")
    far = psi.copy()
    far[found.model.coefficient_slice(1, 0)] += 0.3
    far[-3:] = [np.log(0.1), 0.0, np.log(0.3)]
    scale = np.concatenate([fit.sigma, np.full(3, 0.1)])
    unit = np.outer(scale, scale)
    assert np.linalg.eigvalsh(found.expand(far)[2].dense() * unit)[0] < 0
    assert np.linalg.eigvalsh(found.expand(far, em=True)[2].dense() * unit)[0] > 0


def test_the_curvature_of_the_priors_is_added_once():
    """Against the same target without priors."""
    model, matches, _ = simulated(31, 150, frames="affine", n_exposures=2, fraction=0.1)
    priors = GaussianPriors.of(model, {"u_1_0": (500.0, 0.1), "e2.shift_v": (1.0, 0.01)})
    mixture, h = MIXTURES["gaussian"]
    shards = load(model, matches)
    with_, without = (Target(shards, mixture, p) for p in (priors, GaussianPriors.none(model)))
    psi = np.concatenate([simulated(31, 10, frames="affine", n_exposures=2)[2].theta, h])
    difference = with_.expand(psi)[2].dense() - without.expand(psi)[2].dense()
    expected = np.zeros(len(psi))
    expected[[model.names.index("u_1_0"), model.names.index("e2.shift_v")]] = 100.0, 10_000.0
    np.testing.assert_allclose(difference, np.diag(expected), atol=1e-6)


def test_tables_that_do_not_fit_the_model_are_refused():
    model, matches, _ = simulated(33, 50)
    with pytest.raises(InputError, match="in pix, but the model is in mas"):
        prepare(DistortionModel(2, (CHIP,), unit="mas"), matches)
    bare = type(matches)(matches.x, matches.y, matches.u, matches.v)
    with pytest.raises(InputError, match="have no errors"):
        prepare(model, bare)


def test_names_are_those_of_the_parameters():
    found, *_ = problem("gaussian", "shift")
    assert found.names == (*found.model.names, "log j", "logit f", "log s_out")
    fixed = replace(found, mixture=OutlierMixture("none", jitter=0.0))
    assert fixed.names == found.model.names and fixed.n_theta == found.model.n_params
