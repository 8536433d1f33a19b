"""The outlier mixture against scipy's densities, its derivatives by differences, its priors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats
from scipy.special import expit, logit

from bayesdist.errors import InputError
from bayesdist.infer import OutlierMixture, kernel

from ..oracle import StarTerms, star_terms
from ..support import draw_prior, numerical_gradient

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
        if name == "log s_out":  # beyond the core
            natural = np.sqrt(natural**2 - SCALE**2 - (hyper.mixture.jitter or wanted["j"]) ** 2)
        expected = np.log(natural / (1 - natural)) if name == "logit f" else np.log(natural)
        assert value == pytest.approx(expected, rel=1e-12)


def terms_of(mixture: OutlierMixture, values, residual, var_u, var_v) -> StarTerms:
    """The reference in numpy, at natural values of what is sampled."""
    values = {"j": mixture.jitter} | values
    return star_terms(
        mixture.model, residual, var_u, var_v, radius=mixture.match_radius or 1.0, **values
    )


NO_TURN = (np.zeros(0), np.zeros(0))  # errors that are not correlated


def by_kernel(hyper, values, residual, sigma) -> tuple[np.ndarray, np.ndarray]:
    """Outlier probability and log-likelihood of each star by the compiled pass.

    The model is zero: the residuals are the data.
    """
    n = len(residual)
    columns = (np.zeros(n), np.zeros(n), *residual.T, *(sigma**2).T, *NO_TURN)
    p, loglik, _ = kernel.memberships(
        kernel.pieces_of(np.array([0, n]), kernel.BLOCK),
        tuple(np.ascontiguousarray(c) for c in columns),
        np.zeros((1, 1, 2, 3)),
        1,
        hyper.constants(hyper.point(values)[None]),
        1,
    )[0]
    return p, loglik


def test_log_likelihood_is_the_formula(hyper):
    residual, sigma = some_stars()
    values = {k: NATURAL[k] for k in hyper.mixture.hyper}
    expected = direct(hyper.mixture, values, residual, sigma)
    _, loglik = by_kernel(hyper, values, residual, sigma)
    np.testing.assert_allclose(loglik, expected, rtol=1e-12, atol=1e-12)
    reference = terms_of(hyper.mixture, values, residual, *(sigma**2).T)
    np.testing.assert_allclose(reference.loglik, expected, rtol=1e-12, atol=1e-12)


def test_outlier_probability_is_bayes_theorem():
    residual, sigma = some_stars()
    hyper = MIXTURES["gaussian"].bind(SCALE)
    bad = 0.04 * stats.norm(scale=0.6).pdf(residual).prod(axis=1)
    good = 0.96 * stats.norm(scale=np.hypot(sigma, 0.03)).pdf(residual).prod(axis=1)
    p, _ = by_kernel(hyper, NATURAL, residual, sigma)
    np.testing.assert_allclose(p, bad / (bad + good), rtol=1e-10)
    assert p.min() < 0.01 and p.max() > 0.99
    reference = terms_of(hyper.mixture, NATURAL, residual, *(sigma**2).T)
    np.testing.assert_allclose(reference.outlier, bad / (bad + good), rtol=1e-10)


HYPER_ORDER = ("j", "f", "s_out")


def test_derivatives_of_the_reference_by_differences(hyper):
    """Of the log-likelihood of single stars; what the compiled sums are held against."""
    residual, sigma = some_stars(12)
    variances = (sigma**2).T
    names = hyper.mixture.hyper
    which = [HYPER_ORDER.index(k) for k in names]
    # the compiled sums are by log s_out itself, the sampled coordinate is its excess over the core
    h0 = np.array([logit(NATURAL[k]) if k == "f" else np.log(NATURAL[k]) for k in names])

    def at(h, residual, var_u, var_v):
        values = {k: expit(t) if k == "f" else np.exp(t) for k, t in zip(names, h, strict=True)}
        return terms_of(hyper.mixture, values, residual, var_u, var_v)

    def per_star(k, point):
        """log p and its gradient of star k at (r_u, r_v, h...)."""
        out = at(point[2:], point[None, :2], variances[0][k : k + 1], variances[1][k : k + 1])
        return out.loglik[0], np.concatenate([-out.pull[0], out.gradient[0][which]])

    terms = at(h0, residual, *variances)
    for k in range(12):
        point = np.concatenate([residual[k], h0])
        step = np.concatenate([1e-3 * sigma[k], np.full(len(h0), 1e-3)])
        gradient = numerical_gradient(lambda p, k=k: per_star(k, p)[0], point, step)
        scale = 1e-7 / step * 1e-3  # differences of numbers of order 1 to 100
        np.testing.assert_allclose(-terms.pull[k], gradient[:2], rtol=1e-6, atol=scale[0])
        np.testing.assert_allclose(terms.gradient[k][which], gradient[2:], rtol=1e-6, atol=1e-7)
        hessian = numerical_gradient(lambda p, k=k: per_star(k, p)[1], point, step)
        uu, uv, vv = terms.weight[k]
        np.testing.assert_allclose(
            [uu, uv, vv],
            [-hessian[0, 0], -hessian[0, 1], -hessian[1, 1]],
            rtol=1e-6,
            atol=1e-6 / SCALE**2 * 1e-3,
        )
        np.testing.assert_allclose(terms.cross[k][which], hessian[2:, :2], rtol=1e-6, atol=1e-5)
        np.testing.assert_allclose(
            terms.curvature[k][which][:, which], -hessian[2:, 2:], rtol=1e-6, atol=1e-6
        )
    assert (terms.safe_weight >= 0).all()


def test_extreme_residuals_stay_finite(hyper):
    """1e6 sigma: a false match across the whole detector."""
    residual = np.array([[0.05e6, 0.0], [0.0, -0.05e6], [0.0, 0.0]])
    sigma = np.full((3, 2), 0.05)
    values = {k: NATURAL[k] for k in hyper.mixture.hyper}
    with np.errstate(divide="ignore"):
        expected = direct(hyper.mixture, values, residual, sigma)
    p, loglik = by_kernel(hyper, values, residual, sigma)
    np.testing.assert_allclose(loglik, expected, rtol=1e-12)
    far = 0.0 if hyper.mixture.model == "none" else 1.0
    np.testing.assert_allclose(p[:2], far, atol=1e-12)
    moments = kernel.mixture_moments(
        np.array([[0, 0, 3]]),
        (*np.zeros((2, 3)), *np.ascontiguousarray(residual.T), *(sigma.T.copy() ** 2), *NO_TURN),
        np.zeros((1, 2, 3)),
        1,
        hyper.constants(hyper.point(values)[None]),
    )
    for name in ("weight", "right", "cross", "scalars"):
        assert np.isfinite(getattr(moments, name)).all(), name


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("point", [(400.0, 0.0, 1.0), (400.0, 0.0, 400.0), (-400.0, 0.0, -400.0)])
def test_where_numbers_overflow_there_is_no_density_and_no_warning(point):
    bound, h = OutlierMixture().bind(0.02), np.array([point])
    assert not (bound.log_prior(h) > -700).any()
    assert not np.isnan(bound.constants(h).j2).any() and "s_out" in bound.values(h)


def test_constants_are_those_of_the_values(hyper):
    """Each point by itself, and what is fixed stands in every row."""
    rng = np.random.default_rng(5)
    h = rng.uniform(-6, 1, (4, len(hyper.names)))
    constants, mixture = hyper.constants(h), hyper.mixture
    values = hyper.values(h)
    j = values.get("j", np.full(4, mixture.jitter))
    f = values.get("f", np.zeros(4))
    np.testing.assert_allclose(constants.j2, j**2, rtol=1e-14)
    np.testing.assert_allclose(np.exp(constants.log_f), f, rtol=1e-14)
    np.testing.assert_allclose(np.exp(constants.log_1_f), 1 - f, rtol=1e-14)
    if mixture.model == "gaussian":
        np.testing.assert_allclose(constants.out, values["s_out"] ** 2, rtol=1e-14)
    elif mixture.model == "uniform":
        np.testing.assert_allclose(constants.out, np.pi * 1.5**2)
    assert constants.unit2 == SCALE**2
    some = constants.of(slice(1, 3))
    again = hyper.constants(h[1:3])
    for one, two in zip(some, again, strict=True):
        np.testing.assert_array_equal(one, two)


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
    """w^2 is inverse gamma of shape 1; log w is most probable at five quoted errors."""
    total, _ = integrate.quad(lambda t: np.exp(s_out_prior(np.array([t]))[0]), -20, 40, points=[-1])
    assert total == pytest.approx(1, abs=1e-8)
    t = np.linspace(-4, 3, 7001)
    assert t[s_out_prior(t).argmax()] == pytest.approx(np.log(5 * SCALE), abs=1e-3)
    expected = stats.invgamma(1, scale=25 * SCALE**2).logpdf(np.exp(2 * t)) + np.log(2) + 2 * t
    np.testing.assert_allclose(s_out_prior(t), expected, atol=1e-9)


def test_scales_of_priors_are_those_that_are_given():
    hyper = OutlierMixture("gaussian", jitter_scale=0.3, outlier_scale=4.0).bind(SCALE)
    h = np.random.default_rng(2).uniform(-4, 3, (30, 3))
    log_j, f, log_s = h.T
    expected = np.log(2) + stats.t(4, scale=0.3).logpdf(np.exp(log_j)) + log_j
    expected += stats.beta(1, 9).logpdf(expit(f)) + np.log(expit(f) * expit(-f))
    expected += stats.invgamma(1, scale=16.0).logpdf(np.exp(2 * log_s)) + np.log(2) + 2 * log_s
    np.testing.assert_allclose(hyper.log_prior(h), expected, rtol=1e-9, atol=1e-9)
    gradient, _ = hyper.prior_terms(h[0])
    np.testing.assert_allclose(
        gradient, numerical_gradient(hyper.log_prior, h[0], 1e-3), rtol=1e-6, atol=1e-8
    )
    drawn = hyper.values(draw_prior(hyper, 20_000, np.random.default_rng(3)))
    assert stats.kstest(drawn["j"], lambda x: 2 * stats.t(4, scale=0.3).cdf(x) - 1).pvalue > 1e-3
    excess = np.sqrt(drawn["s_out"] ** 2 - SCALE**2 - drawn["j"] ** 2)
    assert np.median(excess) == pytest.approx(4 / np.sqrt(np.log(2)), rel=0.05)


def test_draws_follow_the_priors():
    hyper = OutlierMixture("gaussian", fraction_prior=(2.0, 30.0)).bind(SCALE)
    draws = hyper.values(draw_prior(hyper, 20_000, np.random.default_rng(3)))
    cdf = {
        "j": lambda x: 2 * DOCUMENTED["j"].cdf(x) - 1,
        "f": stats.beta(2, 30).cdf,
    }
    # in units of the core, to which it is added
    core2 = SCALE**2 + draws["j"] ** 2
    ratio = draws.pop("s_out") ** 2 / core2 - 1
    assert stats.kstest(ratio, stats.invgamma(1, scale=25).cdf).pvalue > 1e-3
    for name, values in draws.items():
        assert stats.kstest(values, cdf[name]).pvalue > 1e-3, name
    none = OutlierMixture("none", jitter=0.0).bind(SCALE)
    assert draw_prior(none, 7, np.random.default_rng(0)).shape == (7, 0)


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
        np.testing.assert_allclose(curvature, -numeric, rtol=1e-7, atol=1e-8)


def test_false_matches_are_never_narrower_than_true_ones():
    """Whatever is sampled; and natural values lead back to it."""
    hyper = OutlierMixture().bind(SCALE)
    h = np.random.default_rng(5).uniform(-8, 8, (200, 3))
    values = hyper.values(h)
    assert (values["s_out"] ** 2 >= SCALE**2 + values["j"] ** 2).all()
    np.testing.assert_allclose(hyper.constants(h).out, values["s_out"] ** 2, rtol=1e-12)
    seen = h[:, 2] > h[:, 0] - 3  # an excess of which doubles keep enough digits
    np.testing.assert_allclose(hyper.point(values)[seen], h[seen], atol=1e-6)


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
        ({"fraction_prior": (0.3, 9.0)}, r"outliers\.fraction_prior"),
        ({"fraction_prior": (1.0, np.nan)}, r"outliers\.fraction_prior"),
        ({"jitter_scale": 0.0}, r"outliers\.jitter_scale"),
        ({"jitter_scale": 0.1, "jitter": 0.0}, r"outliers\.jitter_scale.*not fitted"),
        ({"outlier_scale": np.inf}, r"outliers\.outlier_scale"),
        ({"outlier_scale": 1.0, "model": "none"}, r"outliers\.outlier_scale.*not fitted"),
    ],
    ids=str,
)
def test_errors(arguments, says):
    with pytest.raises(InputError, match=says):
        OutlierMixture(**arguments)
