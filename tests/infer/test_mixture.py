"""The outlier mixture against scipy's densities, its derivatives by differences, its priors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats
from scipy.special import expit

from bayesdist.errors import InputError
from bayesdist.infer import OutlierMixture

from .support import numerical_gradient

SCALE = 0.05
MIXTURES = {
    "gaussian": OutlierMixture("gaussian"),
    "uniform": OutlierMixture("uniform", match_radius=1.5),
    "none": OutlierMixture("none"),
    "gaussian, jitter 0.02": OutlierMixture("gaussian", jitter=0.02),
    "uniform, jitter 0": OutlierMixture("uniform", match_radius=1.5, jitter=0.0),
    "none, jitter 0.02": OutlierMixture("none", jitter=0.02),
}
NATURAL = {"j": 0.03, "f": 0.04, "s_out": 0.6}


@pytest.fixture(params=MIXTURES.values(), ids=MIXTURES)
def hyper(request):
    return request.param.bind(SCALE)


def some_stars(n: int = 40):
    """Residuals from good to hopeless, unequal errors."""
    rng = np.random.default_rng(1)
    sigma = rng.uniform(0.02, 0.1, (n, 2))
    residual = sigma * rng.standard_normal((n, 2)) * rng.choice([0.5, 3, 10], (n, 1))
    return residual, sigma


def direct(mixture: OutlierMixture, values: dict[str, float], residual, sigma) -> np.ndarray:
    """log p of each star as design.md section 2 has it, by scipy.stats."""
    j = values.get("j", mixture.jitter)
    wide = np.hypot(sigma, j)
    good = stats.norm(scale=wide).logpdf(residual).sum(axis=1)
    if mixture.model == "none":
        return good
    f = values["f"]
    if mixture.model == "gaussian":
        bad = stats.norm(scale=values["s_out"]).logpdf(residual).sum(axis=1)
    else:
        bad = np.full(len(residual), -np.log(np.pi * mixture.match_radius**2))
    return np.logaddexp(np.log1p(-f) + good, np.log(f) + bad)


def test_hyperparameters_are_those_of_the_model():
    assert [m.hyper for m in MIXTURES.values()] == [
        ("j", "f", "s_out"),
        ("j", "f"),
        ("j",),
        ("f", "s_out"),
        ("f",),
        (),
    ]


def test_points_and_values_are_inverse(hyper):
    wanted = {k: NATURAL[k] for k in hyper.mixture.hyper}
    h = hyper.point(wanted)
    assert {k: float(v) for k, v in hyper.values(h).items()} == pytest.approx(wanted, rel=1e-12)
    for name, value, natural in zip(hyper.names, h, wanted.values(), strict=True):
        expected = np.log(natural / (1 - natural)) if name == "logit f" else np.log(natural)
        assert value == pytest.approx(expected, rel=1e-12)


def test_log_likelihood_is_the_formula(hyper):
    residual, sigma = some_stars()
    values = {k: NATURAL[k] for k in hyper.mixture.hyper}
    terms = hyper.terms(hyper.point(values), residual, *(sigma**2).T)
    expected = direct(hyper.mixture, values, residual, sigma)
    np.testing.assert_allclose(terms.loglik, expected, rtol=1e-12, atol=1e-12)


def test_outlier_probability_is_bayes_theorem():
    residual, sigma = some_stars()
    h = MIXTURES["gaussian"].bind(SCALE)
    p = h.terms(h.point(NATURAL), residual, *(sigma**2).T).outlier
    bad = 0.04 * stats.norm(scale=0.6).pdf(residual).prod(axis=1)
    good = 0.96 * stats.norm(scale=np.hypot(sigma, 0.03)).pdf(residual).prod(axis=1)
    np.testing.assert_allclose(p, bad / (bad + good), rtol=1e-10)
    assert p.min() < 0.01 and p.max() > 0.99


def test_derivatives_by_differences(hyper):
    residual, sigma = some_stars(12)
    variances = (sigma**2).T
    h0 = hyper.point({k: NATURAL[k] for k in hyper.mixture.hyper})
    n_h = len(h0)
    terms = hyper.terms(h0, residual, *variances)

    def per_star(k, point):
        """log p and its gradient of star k at (r_u, r_v, h...)."""
        out = hyper.terms(
            point[2:], point[None, :2], variances[0][k : k + 1], variances[1][k : k + 1]
        )
        return out.loglik[0], np.concatenate([-out.pull[0], out.gradient[0]])

    curvature = np.zeros((n_h, n_h))
    for k in range(12):
        point = np.concatenate([residual[k], h0])
        step = np.concatenate([1e-3 * sigma[k], np.full(n_h, 1e-3)])
        gradient = numerical_gradient(lambda p, k=k: per_star(k, p)[0], point, step)
        scale = 1e-7 / step * 1e-3  # differences of numbers of order 1 to 100
        np.testing.assert_allclose(-terms.pull[k], gradient[:2], rtol=1e-6, atol=scale[0])
        np.testing.assert_allclose(terms.gradient[k], gradient[2:], rtol=1e-6, atol=1e-7)
        hessian = numerical_gradient(lambda p, k=k: per_star(k, p)[1], point, step)
        uu, uv, vv = terms.weight[k]
        np.testing.assert_allclose(
            [uu, uv, vv],
            [-hessian[0, 0], -hessian[0, 1], -hessian[1, 1]],
            rtol=1e-6,
            atol=1e-6 / SCALE**2 * 1e-3,
        )
        np.testing.assert_allclose(terms.cross[k], hessian[2:, :2], rtol=1e-6, atol=1e-5)
        curvature -= hessian[2:, 2:]
    np.testing.assert_allclose(terms.curvature, curvature, rtol=1e-6, atol=1e-6)
    assert (terms.safe_weight >= 0).all()


def test_extreme_residuals_stay_finite(hyper):
    """1e6 sigma: a false match across the whole detector."""
    residual = np.array([[0.05e6, 0.0], [0.0, -0.05e6], [0.0, 0.0]])
    variances = np.full(3, 0.05**2)
    values = {k: NATURAL[k] for k in hyper.mixture.hyper}
    terms = hyper.terms(hyper.point(values), residual, variances, variances)
    for name in ("loglik", "outlier", "pull", "weight", "safe_weight", "gradient", "cross"):
        assert np.isfinite(getattr(terms, name)).all(), name
    assert np.isfinite(terms.curvature).all()
    with np.errstate(divide="ignore"):
        expected = direct(hyper.mixture, values, residual, np.full((3, 2), 0.05))
    np.testing.assert_allclose(terms.loglik, expected, rtol=1e-12)


# -- priors ---------------------------------------------------------------------------------------

SINGLE = {
    "j": OutlierMixture("none"),
    "f": OutlierMixture("uniform", match_radius=1.0, jitter=0.0),
    "f, Beta(2, 30)": OutlierMixture(
        "uniform", match_radius=1.0, jitter=0.0, fraction_prior=(2.0, 30.0)
    ),
}
DOCUMENTED = {
    "j": stats.t(4, scale=SCALE),  # folded: half-Student-t
    "f": stats.beta(1, 9),
    "f, Beta(2, 30)": stats.beta(2, 30),
}


@pytest.mark.parametrize("name", SINGLE)
def test_priors_integrate_to_one_in_sampled_coordinates(name):
    hyper = SINGLE[name].bind(SCALE)
    total, _ = integrate.quad(
        lambda t: np.exp(hyper.log_prior(np.array([t]))), -60, 60, points=[-5, 0], limit=500
    )
    assert total == pytest.approx(1, abs=1e-8)


@pytest.mark.parametrize("name", SINGLE)
def test_priors_are_the_documented_ones(name):
    """Density of the natural value times the Jacobian of the sampled coordinate."""
    hyper = SINGLE[name].bind(SCALE)
    t = np.linspace(-8, 1, 30)
    if name == "j":
        natural = np.exp(t)
        expected = np.log(2) + DOCUMENTED[name].logpdf(natural) + np.log(natural)
    else:
        natural = expit(t)
        expected = DOCUMENTED[name].logpdf(natural) + np.log(natural * (1 - natural))
    np.testing.assert_allclose(hyper.log_prior(t[:, None]), expected, rtol=1e-9, atol=1e-9)


def s_out_prior(t):
    """Prior of log s_out alone: the joint one without that of f."""
    hyper = OutlierMixture("gaussian", jitter=0.0).bind(SCALE)
    f = OutlierMixture("uniform", match_radius=1.0, jitter=0.0).bind(SCALE)
    h = np.column_stack([np.zeros_like(t), t])
    return hyper.log_prior(h) - f.log_prior(h[:, :1])


def test_prior_of_the_outlier_scale():
    """s_out^2 is inverse gamma of shape 1; log s_out is most probable at five quoted errors."""
    total, _ = integrate.quad(lambda t: np.exp(s_out_prior(np.array([t]))[0]), -20, 40, points=[-1])
    assert total == pytest.approx(1, abs=1e-8)
    t = np.linspace(-4, 3, 7001)
    assert t[s_out_prior(t).argmax()] == pytest.approx(np.log(5 * SCALE), abs=1e-3)
    expected = stats.invgamma(1, scale=25 * SCALE**2).logpdf(np.exp(2 * t)) + np.log(2) + 2 * t
    np.testing.assert_allclose(s_out_prior(t), expected, atol=1e-9)


def test_draws_follow_the_priors():
    hyper = OutlierMixture("gaussian", fraction_prior=(2.0, 30.0)).bind(SCALE)
    draws = hyper.values(hyper.draw_prior(20_000, np.random.default_rng(3)))
    cdf = {
        "j": lambda x: 2 * DOCUMENTED["j"].cdf(x) - 1,
        "f": stats.beta(2, 30).cdf,
        "s_out": lambda x: stats.invgamma(1, scale=25 * SCALE**2).cdf(x**2),
    }
    for name, values in draws.items():
        assert stats.kstest(values, cdf[name]).pvalue > 1e-3, name
    assert OutlierMixture("none", jitter=0.0).bind(SCALE).draw_prior(
        7, np.random.default_rng(0)
    ).shape == (7, 0)


def test_prior_derivatives_by_differences(hyper):
    rng = np.random.default_rng(4)
    for _ in range(5):
        h = rng.uniform(-5, 1, len(hyper.names))
        gradient, curvature = hyper.prior_terms(h)
        if not len(h):
            assert gradient.size == 0
            continue
        np.testing.assert_allclose(
            gradient, numerical_gradient(hyper.log_prior, h, 1e-3), rtol=1e-7, atol=1e-8
        )
        numeric = numerical_gradient(lambda p: hyper.prior_terms(p)[0], h, 1e-3)
        np.testing.assert_allclose(np.diag(curvature), -numeric, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"model": "cauchy"}, "unknown outlier model 'cauchy'.*gaussian, uniform or none"),
        ({"model": "uniform"}, r"outliers\.match_radius"),
        ({"model": "uniform", "match_radius": 0.0}, r"outliers\.match_radius"),
        ({"model": "uniform", "match_radius": np.nan}, r"outliers\.match_radius"),
        ({"model": "uniform", "match_radius": np.inf}, r"outliers\.match_radius"),
        ({"jitter": -0.1}, r"outliers\.jitter"),
        ({"jitter": np.nan}, r"outliers\.jitter"),
        ({"fraction_prior": (0.0, 9.0)}, r"outliers\.fraction_prior"),
        ({"fraction_prior": (1.0, np.nan)}, r"outliers\.fraction_prior"),
    ],
    ids=str,
)
def test_errors(arguments, says):
    with pytest.raises(InputError, match=says):
        OutlierMixture(**arguments)
