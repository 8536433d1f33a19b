"""The posterior density: its value written out, its gradient and Hessian by differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.errors import InputError
from bayesdist.infer import GaussianPriors, OutlierMixture
from bayesdist.infer.stars import prepare
from bayesdist.model import FRAME_KINDS, DistortionModel

from .support import CHIP, TWO_CHIPS, UNCLIPPED, numerical_gradient, simulated, table, target_of

pytestmark = pytest.mark.usefixtures("one_thread")

MIXTURES = {
    "gaussian": (OutlierMixture(), [np.log(0.02), -3.0, np.log(0.8)]),
    "uniform": (OutlierMixture("uniform", match_radius=2.0), [np.log(0.02), -3.0]),
    "none": (OutlierMixture("none"), [np.log(0.02)]),
}


def problem(kind, frames="none", n=150, chips=(CHIP,), **priors):
    model, matches, truth = simulated(
        31, n, frames=frames, n_exposures=2, chips=chips, fraction=0.1
    )
    prior = GaussianPriors.of(model, priors)
    mixture, h = MIXTURES[kind]
    target, fit = target_of(model, matches, mixture, prior, **UNCLIPPED)
    return target, fit, matches, np.concatenate([fit.mean, h]), truth


@pytest.mark.parametrize("kind", MIXTURES)
def test_value_is_likelihood_times_priors(kind):
    named = {"v_1_1": (0.1, 0.03)}
    target, _, matches, psi, _ = problem(kind, "affine", **named)
    model = target.stars.model
    other = psi + 0.01 * np.random.default_rng(0).standard_normal(len(psi))
    values = []
    for p in (psi, other):
        theta, h = p[: model.n_params], p[model.n_params :]
        r = np.column_stack([matches.u, matches.v]) - model.predict(
            theta, matches.x, matches.y, exposure=matches.exposure
        )
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
                bad = stats.norm(scale=np.exp(h[2])).logpdf(r).sum(axis=1)
                variance = np.exp(2 * h[2])
                log_prior += stats.invgamma(1, scale=0.25**2).logpdf(variance)
                log_prior += np.log(2 * variance)
            loglik = np.logaddexp(np.log1p(-f) + good, np.log(f) + bad)
        k = model.names.index("v_1_1")
        log_prior += -0.5 * ((theta[k] - 0.1) / 0.03) ** 2
        values.append(loglik.sum() + log_prior)
        np.testing.assert_allclose(target.star_log_likelihood(p[None])[0], loglik, atol=1e-9)
    np.testing.assert_allclose(target.log_density(np.array([psi, other])), values, rtol=1e-11)


@pytest.mark.parametrize("kind", MIXTURES)
def test_many_points_are_each_by_itself(kind):
    target, _, _, psi, _ = problem(kind, "affine")
    points = psi + 0.01 * np.random.default_rng(1).standard_normal((7, len(psi)))
    together = target.log_density(points)
    np.testing.assert_allclose(
        together, [target.log_density(p[None])[0] for p in points], rtol=1e-13
    )


def test_points_that_are_not_finite_have_no_density():
    target, _, _, psi, _ = problem("gaussian")
    points = np.array([psi] * 4)
    points[1, 0], points[2, -1], points[3, -3] = np.nan, np.inf, -np.inf
    values = target.log_density(points)
    assert np.isfinite(values[0]) and (values[1:] == -np.inf).all()


@pytest.mark.parametrize("kind", MIXTURES)
@pytest.mark.parametrize("frames", FRAME_KINDS)
def test_gradient_by_differences(kind, frames):
    target, fit, _, psi, _ = problem(kind, frames, u_1_1=(0.1, 0.03))
    scale = np.concatenate([fit.sigma, np.full(len(psi) - len(fit.sigma), 0.1)])
    psi = psi + scale * np.random.default_rng(2).standard_normal(len(psi))
    value, gradient, _, _ = target.expand(psi)
    assert value == pytest.approx(target.log_density(psi[None])[0], abs=1e-8)
    numeric = numerical_gradient(lambda p: target.log_density(p[None])[0], psi, 1e-2 * scale)
    # in units of one sigma, where the gradient is of order one
    np.testing.assert_allclose(gradient * scale, numeric * scale, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("kind", MIXTURES)
def test_hessian_by_differences(kind):
    """Shifts are linear in the parameters, so that the Hessian has no further terms."""
    target, fit, _, psi, _ = problem(kind, "shift", chips=TWO_CHIPS)
    scale = np.concatenate([fit.sigma, np.full(len(psi) - len(fit.sigma), 0.1)])
    _, _, curvature, safe = target.expand(psi)
    numeric = -numerical_gradient(lambda p: target.expand(p)[1], psi, 1e-2 * scale)
    unit = np.outer(scale, scale)
    np.testing.assert_allclose(curvature.dense() * unit, numeric * unit, rtol=1e-5, atol=1e-5)
    assert np.linalg.eigvalsh(safe.dense() * unit)[0] > 0


def test_outlier_probability_is_in_the_order_of_the_table():
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
    p = target.outlier_probability(psi[None])
    np.testing.assert_array_equal(np.flatnonzero(p > 0.5), planted)
    assert not fit.used[planted].any()


def test_tables_that_do_not_fit_the_model_are_refused():
    model, matches, _ = simulated(33, 50)
    with pytest.raises(InputError, match="in pix and the model is in mas"):
        prepare(DistortionModel(2, (CHIP,), unit="mas"), matches)
    bare = type(matches)(matches.x, matches.y, matches.u, matches.v)
    with pytest.raises(InputError, match="carry no errors"):
        prepare(model, bare)
