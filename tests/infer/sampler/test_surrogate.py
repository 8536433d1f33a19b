"""The surrogate follows densities of known moments, and the certificate knows when it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate, special, stats
from threadpoolctl import threadpool_limits

from bayesdist.errors import InputError, NotConvergedError
from bayesdist.infer import OutlierMixture
from bayesdist.infer.density.grid import build_proposal
from bayesdist.infer.sampler import surrogate as surrogate_module
from bayesdist.infer.sampler.surrogate import LEAST_HELD_OUT, Surrogate, certify, draw_surrogate
from tests.reduced import case_in_full

from ..support import simulated, target_of

pytestmark = pytest.mark.usefixtures("one_thread")

N_PILOTS = 300


@pytest.fixture(autouse=True, scope="module")
def one_blas_thread():
    """As in a run: matrices are small, and more threads only get in each other's way."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield


def gaussian(D: int):
    """A proposal that is a standard normal in D dimensions."""
    return lambda n, rng: rng.standard_normal((n, D))


def certified(log_ratio, D: int, n_hyper: int, seed: int, n: int = N_PILOTS):
    """Pilots of a standard normal q, judged for the log density ratio of p to it."""
    rng = np.random.default_rng(seed)
    white = rng.standard_normal((n, D))
    return certify(white, log_ratio(white), n_hyper, rng=rng)


# -- densities of known moments -------------------------------------------------------------------

SHAPE = 30.0  # of a gamma variable: its logarithm is skewed by -1 / sqrt(30)
COUPLING = 0.2  # log of the scale of the coefficients, for each unit of the first hyperparameter
K, H = 10, 2


def log_gamma_ratio(u):
    """Log p - log q of u = sqrt(a) (log G - log a), G gamma of shape a, over a standard normal."""
    x = u / np.sqrt(SHAPE)
    return -SHAPE * (np.expm1(x) - x - x**2 / 2)


def skewed(white):
    """Two log-gamma hyperparameters; the first scales all coefficients, normal given it."""
    t, u = white[:, :K], white[:, K:]
    log_scale = COUPLING * u[:, 0] / np.sqrt(SHAPE)
    spread = (t**2).sum(axis=1)
    given = -K * log_scale - np.expm1(-2 * log_scale) * spread / 2
    return log_gamma_ratio(u).sum(axis=1) + given


def test_draws_of_the_surrogate_have_the_known_moments_and_those_of_the_proposal_do_not():
    surrogate, certificate = certified(skewed, K + H, H, seed=1)
    n = 40_000
    draws, _ = draw_surrogate(gaussian(K + H), lambda x: x, surrogate, n, np.random.default_rng(2))
    raw = np.random.default_rng(3).standard_normal((n, K + H))
    a, c = SHAPE, 2 * COUPLING
    mean = np.sqrt(a) * (special.digamma(a) - np.log(a))
    sd = np.sqrt(a * special.polygamma(1, a))
    power = np.exp(special.gammaln(a + c) - special.gammaln(a) - c * np.log(a))  # E scale^2
    tilted = np.sqrt(a) * (special.digamma(a + c) - np.log(a)) * power  # E u scale^2
    functions = [
        (lambda w: w[:, K], mean, True),
        (lambda w: w[:, K + 1], mean, True),
        (lambda w: (w[:, K] - mean) ** 2, sd**2, False),
        (lambda w: w[:, K] * ((w[:, :K] ** 2).mean(axis=1) - 1), tilted - mean, True),
        (lambda w: (w[:, :K] ** 2).mean(axis=1), power, False),
        (lambda w: w[:, 0], 0.0, False),
    ]
    for function, exact, missed_by_q in functions:
        values, plain = function(draws), function(raw)
        error = values.std() / np.sqrt(n)
        assert abs(values.mean() - exact) < 4 * error
        if missed_by_q:
            assert abs(plain.mean() - exact) > 8 * error
    assert certificate.remainder_sd < certificate.raw_sd / 4


def test_variance_over_pilots_held_out_is_unbiased():
    """Against the remainder at a great many other points; over pilots learnt from it is low."""
    white = np.random.default_rng(5).standard_normal((10_000, K + H))
    excess, true = [], []
    for seed in range(40):
        surrogate, certificate = certified(skewed, K + H, H, seed=100 + seed)
        true.append(np.var(skewed(white) - surrogate.log_weight(white)))
        excess.append(certificate.remainder_sd**2 - true[-1])
    assert abs(np.mean(excess)) < 4 * np.std(excess) / np.sqrt(40)
    assert abs(np.mean(excess)) < 0.3 * np.mean(true)


# -- exactly, by quadrature in one dimension ------------------------------------------------------

GRID = np.linspace(-9.0, 9.0, 5_001)


REACH = 3.0  # beyond lie 0.3 % of q: far less than pilots can see


def integral(values):
    return integrate.trapezoid(values, GRID)


def by_quadrature(log_ratio, surrogate, reach=np.inf):
    """Densities of p and s on the grid, where |w| < `reach`, and chi2(p || s)."""
    q = stats.norm.pdf(GRID) * (np.abs(GRID) < reach)
    p = q * np.exp(log_ratio(GRID[:, None]))
    s = q * np.exp(surrogate.log_weight(GRID[:, None]))
    p, s = p / integral(p), s / integral(s)
    return p, s, integral(p**2 / np.where(s > 0, s, 1.0)) - 1


# log density ratios in one hyperparameter, none of which a cubic can follow
RATIOS = {
    "log-gamma": lambda w: log_gamma_ratio(w[:, 0]),
    "wave": lambda w: 0.1 * np.sin(2 * w[:, 0]),
    "step": lambda w: 0.05 * (w[:, 0] > 0.7),
    "fifth power": lambda w: 0.05 * np.tanh(w[:, 0] ** 5 / 5),
    # its remainder lies where s has more mass than q
    "tilted": lambda w: 0.8 * w[:, 0] + 0.2 * np.sin(6 * w[:, 0]) * (w[:, 0] > 0.5),
    "strongly skewed": lambda w: -3 * (np.expm1(w[:, 0] / 2) - w[:, 0] / 2 - w[:, 0] ** 2 / 8),
}

REDUCED = ("log-gamma", "step", "tilted")


@pytest.mark.parametrize(
    "kind",
    [
        kind if kind in REDUCED else case_in_full(kind, instead="other ratios are run")
        for kind in RATIOS
    ],
)
def test_the_bound_holds(kind, full):
    """Shifts of mean, square, tail probability: by quadrature, in 95 of 100 certificates."""
    log_ratio = RATIOS[kind]
    failed, below, tight, n = 0, 0, [], 100 if full else 20
    for seed in range(n):
        surrogate, certificate = certified(log_ratio, 1, 1, seed)
        p, s, chi2 = by_quadrature(log_ratio, surrogate)
        worst = 0.0
        for f in (GRID, GRID**2, 1.0 * (GRID > 1.5)):
            shift = integral(f * p) - integral(f * s)
            sd = np.sqrt(integral(f**2 * s) - integral(f * s) ** 2)
            assert abs(shift) <= 1.0001 * sd * np.sqrt(chi2)  # the inequality itself
            worst = max(worst, abs(shift) / sd)
        variation = integral(np.abs(p - s)) / 2
        assert variation <= np.sqrt(chi2) / 2 * 1.0001
        failed += worst > certificate.mean_shift_bound or variation > certificate.tv_bound
        within = by_quadrature(log_ratio, surrogate, REACH)[2]
        below += certificate.chi2_upper < within
        tight.append(certificate.chi2 / within)
    most = stats.binom(n, 0.05).ppf(0.999)
    assert failed <= (5 if full else most)
    assert below <= most
    # and it is no empty phrase: the estimate of chi2 is about right
    assert 0.7 < np.median(tight) < 1.3


def test_draws_follow_the_surrogate():
    surrogate, _ = certified(RATIOS["strongly skewed"], 1, 1, seed=6)
    draws, acceptance = draw_surrogate(
        gaussian(1), lambda x: x, surrogate, 20_000, np.random.default_rng(7)
    )
    _, s, _ = by_quadrature(RATIOS["strongly skewed"], surrogate)
    cdf = integrate.cumulative_trapezoid(s, GRID, initial=0)
    assert stats.kstest(draws[:, 0], lambda x: np.interp(x, GRID, cdf)).pvalue > 1e-3
    # rejection keeps the mean of weight over envelope
    weight = np.exp(surrogate.log_weight(GRID[:, None]) - surrogate.upper)
    assert acceptance == pytest.approx(integral(stats.norm.pdf(GRID) * weight), abs=0.01)


# -- when it is granted, and when it is not -------------------------------------------------------


def test_a_perfect_proposal_is_certified():
    for noise in (0.0, 1e-9):  # constant, and rounding of a log density of 1e7
        rng = np.random.default_rng(8)
        white = rng.standard_normal((N_PILOTS, 45))
        log_weights = -1.2e7 + noise * rng.standard_normal(N_PILOTS)
        surrogate, certificate = certify(white, log_weights, 3, rng=rng)
        assert certificate.granted and "approximate" in certificate.statement
        assert certificate.remainder_sd < 1e-8 and certificate.mean_shift_bound < 1e-7
        assert certificate.efficiency == pytest.approx(1.0)
        np.testing.assert_allclose(surrogate.log_weight(white), -1.2e7, rtol=0, atol=1e-7)


def student(white):
    """Two degrees of freedom, in every coordinate."""
    return (stats.t(2).logpdf(white) - stats.norm.logpdf(white)).sum(axis=1)


FAR = {
    "two modes": lambda w: (
        np.logaddexp(-0.5 * (w[:, 0] - 2) ** 2, -0.5 * (w[:, 0] + 2) ** 2) + 0.5 * w[:, 0] ** 2
    ),
    "two modes of a hyperparameter": lambda w: (
        np.log(
            np.exp(-0.5 * ((w[:, -1] - 1) / 0.2) ** 2) + np.exp(-0.5 * ((w[:, -1] + 1) / 0.2) ** 2)
        )
        + 0.5 * w[:, -1] ** 2
    ),
    "heavy tails": student,
    "heavy tail of a hyperparameter": lambda w: (
        stats.cauchy.logpdf(w[:, -1]) - stats.norm.logpdf(w[:, -1])
    ),
    "banana": lambda w: -0.5 * (w[:, 1] - w[:, 0] ** 2 + 1) ** 2 + 0.5 * w[:, 1] ** 2,
    "a wall": lambda w: np.where(w[:, 0] > -1.5, 0.0, -np.inf),
    "elsewhere": lambda w: -0.5 * ((w - 1) ** 2 - w**2).sum(axis=1),
}


@pytest.mark.parametrize("log_ratio", FAR.values(), ids=FAR)
def test_a_proposal_that_is_far_off_is_refused(log_ratio, full):
    for seed in range(20 if full else 5):
        _, certificate = certified(log_ratio, 12, 2, seed)
        assert not certificate.granted
        assert certificate.reasons and "refused" in certificate.statement


def test_too_few_pilots_are_refused():
    rng = np.random.default_rng(9)
    white = rng.standard_normal((2 * LEAST_HELD_OUT - 2, 5))
    _, certificate = certify(white, 1e-3 * white[:, 0], 2, rng=rng)
    assert certificate.reasons == (f"{LEAST_HELD_OUT - 1} pilots held out are fewer than 100",)


def test_a_bad_tail_is_a_reason(monkeypatch):
    _, good = certified(skewed, K + H, H, seed=10)
    monkeypatch.setattr(surrogate_module, "pareto_k", lambda log_weights: 0.8)
    _, bad = certified(skewed, K + H, H, seed=10)
    assert good.granted and not bad.granted and "Pareto k 0.80" in bad.statement
    assert replace(bad, pareto_k=good.pareto_k, reasons=()) == good


@pytest.mark.parametrize("D", [5, 45, case_in_full(420, instead="fewer dimensions are run")])
def test_noise_is_not_learnt(D):
    """Nothing can be predicted: what is held out keeps the noise, and not much more."""
    found = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        white = rng.standard_normal((N_PILOTS, D))
        noise = 0.02 * rng.standard_normal(N_PILOTS)
        found.append(certify(white, noise, 3, rng=rng)[1].remainder_sd)
        assert not certify(white, 25 * noise, 3, rng=rng)[1].granted
    assert 0.019 < np.mean(found) < 0.0225


def test_the_remainder_in_many_coefficients_is_found_among_few():
    """A gradient in 420 coefficients from 150 pilots: nothing is gained, and nothing is lost."""
    direction = np.random.default_rng(11).standard_normal(420) / np.sqrt(420)

    def log_ratio(w):
        return 0.03 * w[:, -1] ** 3 / np.sqrt(15) + 0.005 * w[:, :420] @ direction

    _, certificate = certified(log_ratio, 423, 3, seed=12)
    assert certificate.remainder_sd < 0.25 * certificate.raw_sd


# -- the form -------------------------------------------------------------------------------------


def test_surrogate_is_bounded_also_where_no_pilot_fell():
    surrogate, _ = certified(skewed, K + H, H, seed=13)
    far = 1e3 * np.random.default_rng(14).standard_normal((1000, K + H))
    value = surrogate.log_weight(far)
    assert (value <= surrogate.upper).all() and (value >= surrogate.lower).all()


def test_everything_follows_from_the_generator():
    first, again = (certified(skewed, K + H, H, seed=15) for _ in range(2))
    assert first[1] == again[1]
    np.testing.assert_array_equal(first[0].coefficients, again[0].coefficients)
    many, few = (
        draw_surrogate(gaussian(K + H), lambda x: x, first[0], n, np.random.default_rng(16))[0]
        for n in (9000, 100)
    )
    assert many.shape == (9000, K + H)
    np.testing.assert_array_equal(many[:100], few)


def test_whitening_of_the_hyperparameters_does_not_matter():
    """The surrogate turns and scales them itself."""
    rng = np.random.default_rng(17)
    white = rng.standard_normal((N_PILOTS, K + H))
    turned = white.copy()
    turned[:, K:] = white[:, K:] @ np.array([[2.0, 0.5], [-1.0, 0.7]]) + [3.0, -5.0]
    one, two = (
        certify(w, skewed(white), H, rng=np.random.default_rng(18)) for w in (white, turned)
    )
    assert two[1].remainder_sd == pytest.approx(one[1].remainder_sd, rel=0.05)


@pytest.mark.parametrize(("K", "h"), [(0, 1), (0, 3), (6, 0), (1, 1)])
def test_any_number_of_hyperparameters(K, h):
    surrogate, certificate = certified(lambda w: 0.02 * w[:, -1], K + h, h, seed=19)
    assert certificate.granted and certificate.remainder_sd < 1e-3
    draws, _ = draw_surrogate(
        gaussian(K + h), lambda x: x, surrogate, 500, np.random.default_rng(20)
    )
    assert draws.shape == (500, K + h)


def test_draws_outside_the_support_are_left_out():
    surrogate, _ = certified(skewed, K + H, H, seed=21)

    def propose(n, rng):
        psi = rng.standard_normal((n, K + H))
        psi[psi[:, 0] > 0] = np.nan
        return psi

    draws, acceptance = draw_surrogate(
        propose, lambda x: x, surrogate, 1000, np.random.default_rng(22)
    )
    assert draws.shape == (1000, K + H) and (draws[:, 0] <= 0).all()
    assert acceptance < 0.5


def test_a_surrogate_that_accepts_nothing_says_so():
    surrogate = Surrogate(np.zeros(0), np.zeros((0, 0)), -20.0, np.zeros(4), -30.0, 0.0)
    with pytest.raises(NotConvergedError, match="accepts 0 of"):
        draw_surrogate(gaussian(2), lambda x: x, surrogate, 10, np.random.default_rng(23))


@pytest.mark.parametrize(
    ("n", "log_weight"),
    [(300, -np.inf), (10, 0.0)],
)
def test_pilots_that_cannot_be_used(n, log_weight):
    with pytest.raises(InputError, match="too few"):
        certify(np.zeros((n, 4)), np.full(n, log_weight), 2, rng=np.random.default_rng(0))


# -- a posterior ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def posterior():
    """20000 stars, order 3: target, proposal, and the map of white coordinates and its inverse."""
    model, matches, _ = simulated(11, 20_000, order=3, fraction=0.03, jitter=0.05)
    target, fit = target_of(model, matches, OutlierMixture())
    proposal = build_proposal(target, fit)
    n = target.n_theta
    hyper = proposal.draw(20_000, np.random.default_rng(1))[:, n:]
    centre = np.concatenate([proposal.best.mode[:n], hyper.mean(axis=0)])
    factor = proposal.best.factor.matrix.without_tail().factor()
    scale = hyper.std(axis=0)

    def colour(white):
        return centre + np.concatenate([factor.colour(white[:, :n]), scale * white[:, n:]], axis=1)

    def whiten(psi):
        shift = psi - centre
        return np.concatenate([factor.whiten(shift[:, :n]), shift[:, n:] / scale], axis=1)

    return target, proposal, colour, whiten


def test_remainder_of_a_posterior_over_plain_laplace(posterior):
    """One Gaussian for all: what it misses is smooth, and is learnt from 150 passes."""
    target, _, colour, _ = posterior
    white = np.random.default_rng(2).standard_normal((N_PILOTS, len(target.names)))
    log_weights = target.log_density(colour(white)) + 0.5 * (white**2).sum(axis=1)
    _, certificate = certify(white, log_weights, 3, rng=np.random.default_rng(3))
    assert certificate.granted
    assert certificate.remainder_sd < certificate.raw_sd / 4


def test_draws_of_a_certified_posterior_are_those_of_the_exact_one(posterior):
    """Against importance sampling with exact weights."""
    target, proposal, _, whiten = posterior
    pilots = proposal.draw(N_PILOTS, np.random.default_rng(4))
    log_weights = target.log_density(pilots) - proposal.log_density(pilots)
    surrogate, certificate = certify(whiten(pilots), log_weights, 3, rng=np.random.default_rng(5))
    assert certificate.granted
    assert certificate.remainder_sd < 1.1 * certificate.raw_sd
    n = 4000
    draws, _ = draw_surrogate(proposal.draw, whiten, surrogate, n, np.random.default_rng(6))
    exact = proposal.draw(n, np.random.default_rng(7))
    weight = np.exp(target.log_density(exact) - proposal.log_density(exact) - log_weights.max())
    mean = weight @ exact / weight.sum()
    sd = np.sqrt(weight @ (exact - mean) ** 2 / weight.sum())
    allowed = certificate.mean_shift_bound + 4.5 * np.sqrt(2 / n)
    assert (np.abs(draws.mean(axis=0) - mean) < allowed * sd).all()
    assert (np.abs(draws.std(axis=0) / sd - 1) < allowed).all()
