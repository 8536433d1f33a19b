"""The scatter of the exposures: found, and in the errors of what is fitted jointly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from bayesdist.errors import DegenerateError, InputError
from bayesdist.files.hdf5 import record_from_arrays, record_to_arrays
from bayesdist.infer import GaussianPriors, OutlierMixture, Rejection, fit_linear, sample
from bayesdist.infer.equations.arrow import Arrow
from bayesdist.infer.exposures.alone import fit_exposures
from bayesdist.infer.exposures.hierarchy import fit_hierarchical, held_in_reference
from bayesdist.infer.exposures.scatter import Scatter
from bayesdist.infer.solution.transforms import lines, reference_gauge
from bayesdist.model import FRAME_KINDS
from bayesdist.model.frames import CHIP_DEVIATIONS
from tests.reduced import case_in_full, only_in_full

from ..small_campaign import LINEAR, campaign, campaign_model, seen_by, true_lines
from ..support import UNCLIPPED, columns_of, residual_of

pytestmark = pytest.mark.usefixtures("one_thread")

KINDS = ("scale", "shear_plus", "shear_cross")
TAU = np.array([7e-6, 5e-6, 3e-6])
OWN = np.array([2e-3, 2e-3, 2e-6, 4e-6, 4e-6, 2e-6])  # of WFC1: shifts (pixels), rotation, scale...
LINES = (
    *(f"WFC1.{t}" for t in ("A_1", "A_2", "A_3", "B_1", "B_2", "B_3")),
    *(f"WFC2.{t}" for t in ("A_2", "B_2", "B_3")),
)
# what is not fixed by the gauge or by the model
FREE = (
    *(f"WFC1.{t}.alpha" for t in ("A_1", "A_2", "A_3", "B_1", "B_2", "B_3")),
    *(f"WFC2.{t}.alpha" for t in ("A_2", "B_2", "B_3")),
    *(f"{c}.{t}.beta" for c in ("WFC1", "WFC2") for t in ("A_2", "B_2", "B_3")),
)


def deviation_priors(model, tau):
    named = {
        f"{e}.{kind}": (0.0, t)
        for e in model.exposures
        for kind, t in zip(KINDS, np.broadcast_to(tau, 3), strict=True)
    }
    return GaussianPriors.of(model, named)


@pytest.fixture(scope="module")
def some():
    model, matches, theta = campaign(5, 30, 200)
    return model, matches, theta, fit_hierarchical(matches, model)


# -- the scatter itself ---------------------------------------------------------------------------


def dense(kinds, kind, information, pull, scale):
    """A scatter of nothing but deviations."""
    n = len(kind)
    matrix = Arrow(information, np.zeros((0, n, 0)), np.zeros((0, 0, 0)))
    scales = np.full(len(kinds), scale)
    loose = np.zeros(n, bool)
    caution = np.ones(len(kinds))
    return Scatter(kinds, kind, np.arange(n), matrix, pull, np.zeros(n), scales, loose, caution)


def a_scatter(rng, n=6, k=2):
    """Any information matrix with a null direction, as deviations common to all have."""
    a = rng.standard_normal((n * k, n * k - 2)) * 1e6
    S = a @ a.T
    kind = np.repeat(np.arange(k), n)
    return dense(KINDS[:k], kind, S, S @ rng.standard_normal(n * k) * 1e-6, 1e-4)


@pytest.mark.parametrize("loose", [False, True])
def test_the_restricted_likelihood_is_the_integral_over_everything_else(loose):
    """Dense and by hand: data d = Z b + X beta + noise, beta flat."""
    rng = np.random.default_rng(1)
    X, Z = rng.standard_normal((40, 3)), rng.standard_normal((40, 8))
    Z[:, 0] = X[:, 0]  # one deviation is not told from the fixed part
    d = rng.standard_normal(40)
    kind, wide = np.repeat([0, 1], 4), np.zeros(8, bool)
    wide[6] = loose
    about = rng.standard_normal(11)  # a point to start from must not matter
    A = np.hstack([X, Z])
    scatter = Scatter(
        KINDS[:2],
        kind,
        3 + np.arange(8),
        Arrow(A.T @ A, np.zeros((0, 11, 0)), np.zeros((0, 0, 0))),
        A.T @ (d - A @ about),
        about,
        np.full(2, 30.0),
        wide,
        np.ones(2),
    )
    basis = np.linalg.svd(X, full_matrices=True)[0][:, 3:]  # contrasts that beta does not touch

    def variance(tau):
        return np.where(wide, 30.0, tau[kind]) ** 2

    def reml(tau):
        cov = basis.T @ (np.eye(40) + Z @ np.diag(variance(tau)) @ Z.T) @ basis
        prior = stats.t(4).logpdf(tau / 30.0).sum() + np.log(tau).sum()
        return stats.multivariate_normal(cov=cov).logpdf(basis.T @ d) + prior

    a, b = np.array([0.5, 1.5]), np.array([2.0, 0.1])
    found = scatter.log_density(a) - scatter.log_density(b)
    assert found == pytest.approx(reml(a) - reml(b), rel=1e-9)
    # conditional moments by the joint normal equations with the prior
    mean, factor = scatter.posterior(a)
    inverse = np.linalg.inv(A.T @ A + np.diag(np.concatenate([np.zeros(3), 1 / variance(a)])))
    np.testing.assert_allclose(factor.covariance(), inverse, atol=1e-12)
    np.testing.assert_allclose(mean, inverse @ (A.T @ d), atol=1e-12)


@pytest.mark.parametrize("size", [1e-9, 1e-6, 1e-3])
def test_gradient_by_differences(size):
    scatter = a_scatter(np.random.default_rng(2))
    tau, h = size * np.array([1.0, 2.0]), 1e-4
    for k, e in enumerate(np.eye(2)):
        up, down = (scatter.log_density(tau * np.exp(s * h * e)) for s in (1, -1))
        assert scatter.gradient(tau)[k] == pytest.approx((up - down) / (2 * h), rel=1e-5, abs=1e-5)


def test_draws_of_tau_are_its_posterior(full):
    """Against the density on a mesh, one kind of deviation: with scatter, and with none at all."""
    rng = np.random.default_rng(3)
    for true in (5e-6, 0.0):
        n = 12
        S = 1e12 * (np.eye(n) - 1 / n)  # each known to 1e-6, their mean not at all
        b = true * rng.standard_normal(n) + 1e-6 * rng.standard_normal(n)
        scatter = dense(("scale",), np.zeros(n, int), S, S @ b, 1e-4)
        x = np.linspace(-30, -5, 1501)
        density = scatter.log_densities(np.exp(x[:, None]))
        cdf = np.cumsum(np.exp(density - density.max()))
        draws = np.log(scatter.draws(4000 if full else 1500, rng)[:, 0])
        p = np.interp(draws, x, cdf / cdf[-1])
        # resampled points repeat: a sample of a few hundred independent ones at least
        assert stats.kstest(p, "uniform").statistic < 0.06
        # the mode is where the EM algorithm stands still, but for the prior
        mode = np.exp(scatter.mode())
        assert abs(scatter.gradient(mode)[0]) < 1e-2
        np.testing.assert_allclose(scatter.mode()[0], x[np.argmax(density)], atol=0.02)


def test_kinds_that_are_hard_to_tell_apart_are_sampled_by_a_chain():
    """Of two kinds only the sum is known well: against the density on a mesh of both."""
    rng, n = np.random.default_rng(5), 8
    both = np.kron([[1.0, 1.0], [1.0, 1.0]], np.eye(n)) * 1e12
    S = both + 4e8 * np.eye(2 * n)  # each by itself is known to 5e-5
    b = np.concatenate([2e-5 * rng.standard_normal(n), np.zeros(n)])
    scatter = dense(KINDS[:2], np.repeat([0, 1], n), S, S @ b, 1e-4)
    x = np.linspace(-20, -7, 90)
    mesh = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1)
    density = scatter.log_densities(np.exp(mesh.reshape(-1, 2))).reshape(len(x), len(x))
    weight = np.exp(density - density.max())
    # more than any proposals reach
    draws = np.log(scatter.draws(800, rng, least_efficiency=2.0))
    for axis in (0, 1):
        cdf = np.cumsum(weight.sum(axis=1 - axis))
        p = np.interp(draws[:, axis], x, cdf / cdf[-1])
        assert stats.kstest(p, "uniform").statistic < 0.1
    mean = [x @ weight.sum(axis=1 - a) / weight.sum() for a in (0, 1)]
    product = (x - mean[0]) @ weight @ (x - mean[1]) / weight.sum()
    assert np.cov(draws.T)[0, 1] == pytest.approx(
        product, abs=0.25 * np.sqrt(np.cov(draws.T)[0, 0])
    )


# -- against other routes -------------------------------------------------------------------------


def test_for_one_tau_it_is_the_fit_with_that_prior(some):
    """Moments of the deviations, from the wide fit alone, against a fit of the data."""
    model, matches, _, found = some
    for tau in (TAU, np.array([1e-6, 2e-5, 4e-5])):
        fit = fit_linear(matches, model, priors=deviation_priors(model, tau))
        mean, factor = found.scatter.posterior(tau)
        np.testing.assert_allclose((mean - fit.mean) / fit.sigma, 0, atol=2e-3)
        unit = np.outer(fit.sigma, fit.sigma)
        np.testing.assert_allclose(factor.covariance() / unit, fit.cov / unit, atol=1e-3)


def test_without_scatter_it_is_the_plain_joint_fit():
    """tau to zero: frames that only shift and rotate."""
    model, matches, _ = campaign(6, 12, 200, tau=(0.0, 0.0, 0.0))
    plain = fit_linear(matches, replace(model, frames="shift_rotation"))
    still = fit_linear(matches, model, priors=deviation_priors(model, 1e-10))
    n = model.n_distortion
    np.testing.assert_allclose((still.mean[:n] - plain.mean[:n]) / plain.sigma[:n], 0, atol=1e-3)
    np.testing.assert_allclose(still.sigma[:n] / plain.sigma[:n], 1, rtol=1e-4)
    # the posterior of tau then lies below what single exposures can tell, and costs little
    found = fit_hierarchical(matches, model)
    a, b = (lines(reference_gauge(s)).select(*FREE) for s in (found, plain))
    assert found.tau["scale"] < 1.5e-6
    assert (np.abs(a.values - b.values) < 1.5 * a.sigma).all()
    assert (a.sigma > 0.99 * b.sigma).all()


def free_monomials(view):
    """Matrix to the monomials (of half the detector) that the gauge of WFC2 does not fix."""
    model = view.model
    half = np.array([2048.0**i * 1024.0**j for i, j in model.basis().terms])
    rows, labels = [], []
    for chip in model.chips:
        for axis, letter in enumerate("AB"):
            matrix = np.zeros((model.n_terms, model.n_params))
            cols = model.coefficient_slice(chip.number, axis)
            matrix[:, cols] = half[:, None] * model.basis(chip.number).monomial_matrix
            rows.append(matrix)
            labels += [f"{chip.name}.{letter}_{k + 1}" for k in range(model.n_terms)]
    keep = [
        k for k, label in enumerate(labels) if label not in ("WFC2.A_1", "WFC2.B_1", "WFC2.A_3")
    ]
    return np.vstack(rows)[keep], [labels[k] for k in keep]


def test_jointly_is_alone_and_then_the_line():
    """Two steps, exactly: every exposure alone, then a line through all coefficients of all.

    The second step is generalised least squares with formal covariance plus known scatter.  It has
    the same information as the joint fit as long as it keeps the terms of higher order (constant in
    time) and the covariances with them.
    """
    model, matches, _ = campaign(7, 30, 300)
    joint = fit_linear(matches, model, priors=deviation_priors(model, TAU), **UNCLIPPED)
    alone = fit_exposures(matches, model, **UNCLIPPED)
    drifting = [f"{c}.{t}" for c in ("WFC1", "WFC2") for t in ("A_2", "B_2", "B_3")]
    T, labels = free_monomials(alone.views[0])
    k, drift = len(labels), [labels.index(x) for x in drifting]
    H, g = np.zeros((k + 6, k + 6)), np.zeros(k + 6)
    for name, t, view in zip(alone.names, alone.epoch, alone.views, strict=True):
        # how the coefficients of an exposure, in its own gauge, follow its deviations
        columns = []
        for kind in KINDS:
            h = np.zeros(model.n_params)
            h[model.names.index(f"{name}.{kind}")] = 1e-4
            up, down = (
                reference_gauge(seen_by(name, t, model, joint.mean + s * h)).mean for s in (1, -1)
            )
            columns.append(T @ (up - down) / 2e-4)
        G = np.array(columns).T
        W = np.linalg.inv(T @ view.cov @ T.T + G @ np.diag(TAU**2) @ G.T)
        X = np.hstack([np.eye(k), (t - 2004.5) * np.eye(k)[:, drift]])
        H += X.T @ W @ X
        g += X.T @ W @ (T @ view.mean)
    mean, cov = np.linalg.solve(H, g), np.linalg.inv(H)
    found = lines(reference_gauge(joint))
    pick = [labels.index(x) for x in LINES]
    unit = np.array(
        [2048.0 if x.endswith("2") else 1024.0 if x.endswith("3") else 1 for x in LINES]
    )
    alpha = found.select(*(f"{x}.alpha" for x in LINES))
    np.testing.assert_allclose((mean[pick] / unit - alpha.values) / alpha.sigma, 0, atol=0.02)
    np.testing.assert_allclose(np.sqrt(np.diag(cov))[pick] / unit / alpha.sigma, 1, rtol=2e-3)
    beta = found.select(*(f"{x}.beta" for x in drifting))
    unit = np.array([1024.0 if x.endswith("3") else 2048.0 for x in drifting])
    np.testing.assert_allclose((mean[k:] / unit - beta.values) / beta.sigma, 0, atol=0.02)
    np.testing.assert_allclose(np.sqrt(np.diag(cov))[k:] / unit / beta.sigma, 1, rtol=2e-3)
    # formal errors alone would be far too small
    formal = lines(reference_gauge(fit_linear(matches, replace(model, frames="shift_rotation"))))
    small = formal.select("WFC2.A_2.alpha", "WFC2.A_2.beta").sigma
    assert (small < 0.4 * found.select("WFC2.A_2.alpha", "WFC2.A_2.beta").sigma).all()


def named_by_chance(n, campaigns=20_000):
    """Sound exposures of n that chance makes more likely ten times as wide than not, at odds of 49.

    Of three perfectly measured deviations each, against the scatter of the other exposures; what is
    not known so well is named less often.
    """
    z = np.random.default_rng(1).normal(size=(campaigns, n, 3))
    others = np.sqrt(((z**2).sum(axis=1, keepdims=True) - z**2) / (n - 1))
    wide, narrow = (stats.norm.logpdf(z, scale=k * others).sum(axis=-1) for k in (10.0, 1.0))
    return (wide - narrow > np.log(49)).sum() / campaigns


@pytest.mark.slow
@only_in_full("tests/campaign/test_lines has such pulls")
@pytest.mark.parametrize(
    "own",
    [
        pytest.param(None, id="together"),
        pytest.param(OWN, id="apart"),
    ],
)
def test_scatter_and_lines_over_many_truths(own):
    """Pulls of alpha and beta, and where the true tau lies in its posterior."""
    n, exposures = 100, 40
    truth = TAU if own is None else np.concatenate([TAU, own])
    pulls, ranks, outlying = [], [], 0
    for seed in range(n):
        model, matches, theta = campaign(1000 + seed, exposures, 150, own=own)
        found = fit_hierarchical(matches, model, n_tau=128)
        outlying += len(found.outlying)
        a = lines(reference_gauge(found)).select(*FREE)
        d = a.values - true_lines(model, theta).select(*FREE).values
        pulls.append(d @ np.linalg.solve(a.cov, d))
        ranks.append((found.tau_draws < truth).mean(axis=0))
    assert outlying <= stats.poisson(n * named_by_chance(exposures)).isf(1e-3)
    # the covariance of the lines describes their errors
    assert stats.kstest(pulls, stats.chi2(len(FREE)).cdf).pvalue > 1e-3
    rms = np.sqrt(np.mean(pulls) / len(FREE))
    assert abs(rms - 1) < 4 / np.sqrt(2 * n * len(FREE))
    # kinds are nearly independent
    assert stats.kstest(np.ravel(ranks), "uniform").pvalue > 1e-3


@pytest.mark.slow
@only_in_full("tests/campaign/test_lines compares with the scatter")
def test_a_chip_that_scatters_by_itself_makes_no_rate_well_known():
    """Scale and shear of the frame act on the distance of the chips too, a lever of 2000 pixels.

    Held against that alone, the rates look better known than what single exposures say of them.
    """
    model, matches, _ = campaign(15, 30, 200, own=[0.03, 0.03, *OWN[2:]])
    apart = lines(reference_gauge(fit_hierarchical(matches, model)))
    together = replace(model, chip_deviations=False)
    naive = lines(reference_gauge(fit_hierarchical(matches, together)))
    # what nobody can beat who does not know the deviations: the scatter of B_3 about its line
    scatter = LINEAR[1]["B_3"][0] * np.sqrt(TAU[0] ** 2 + TAU[1] ** 2 + OWN[3] ** 2 + OWN[4] ** 2)
    epoch = np.array([matches.epoch[matches.exposure == e][0] for e in range(30)])
    least = scatter / np.sqrt(((epoch - epoch.mean()) ** 2).sum())
    of = "WFC1.B_3.beta"
    assert 0.8 * least < apart.select(of).sigma[0] < 1.6 * least  # tau is estimated too
    assert naive.select(of).sigma[0] < 0.6 * least


@pytest.mark.slow
@only_in_full("tests/campaign/test_lines compares with the scatter")
def test_a_gap_that_goes_with_the_shear_is_no_second_measurement_of_it():
    """Scale and shear act on the whole focal plane, as in a telescope that breathes.

    In the gauge of WFC2 its B_2 deviates by twice the shear, and no error of its rate can be below
    what that scatter leaves of a line through the exposures.
    """
    n, exposures = 60, 40
    pulls, ratio = [], []
    for seed in range(n):
        whole, matches, theta = campaign(2000 + seed, exposures, 150, tau=(5e-6, 5e-6, 5e-6))
        model = replace(whole, chips=whole.chips[::-1], chip_deviations=True)
        found = lines(reference_gauge(fit_hierarchical(matches, model, n_tau=128)))
        for of in ("WFC2.B_2.beta", "WFC1.B_2.beta", "WFC2.B_3.beta", "WFC2.A_2.beta"):
            d = found.select(of).values - true_lines(whole, theta).select(of).values
            pulls.append(float(d[0] / found.select(of).sigma[0]))
        epoch = np.array([matches.epoch[matches.exposure == e][0] for e in range(exposures)])
        least = 2 * 5e-6 / np.sqrt(((epoch - epoch.mean()) ** 2).sum())
        ratio.append(found.select("WFC2.B_2.beta").sigma[0] / least)
    assert np.median(ratio) > 0.9
    assert np.sqrt(np.mean(np.square(pulls))) < 1 + 3 / np.sqrt(2 * 2 * n)  # two are independent


def test_exposures_that_went_wrong_are_named_and_do_no_harm():
    wrong = {"j004.scale": 3e-4, "j011.shear_plus": -2e-4, "j011.WFC1.rotation": 1e-4}
    model, matches, theta = campaign(16, 30, 200, own=OWN, wrong=wrong)
    found = fit_hierarchical(matches, model)
    assert found.outlying == ("j004", "j011")
    assert not fit_hierarchical(*campaign(16, 30, 200, own=OWN)[1::-1]).outlying
    low, high = found.tau_interval(0.99)["scale"]
    assert low < TAU[0] < high < 2 * TAU[0]
    a = lines(reference_gauge(found)).select(*FREE)
    d = a.values - true_lines(model, theta).select(*FREE).values
    assert stats.chi2(len(FREE)).sf(d @ np.linalg.solve(a.cov, d)) > 1e-3
    k = model.names.index("j004.scale")
    assert found.mean[k] == pytest.approx(theta[k], abs=5 * found.sigma[k])


@pytest.mark.slow
@only_in_full("gross errors of two of thirty are named")
def test_two_of_few_exposures_that_went_wrong_are_named():
    """Not only gross ones: everything of ten times the usual size."""
    rng = np.random.default_rng(3)
    for seed in (18, 19, 20):
        wrong = {
            f"{e}.{kind}": 10 * t * rng.standard_normal()
            for e in ("j003", "j009")
            for kind, t in zip(
                (*KINDS, *(f"WFC1.{d}" for d in CHIP_DEVIATIONS)), (*TAU, *OWN), strict=True
            )
        }
        few = fit_hierarchical(*campaign(seed, 16, 400, own=OWN, wrong=wrong)[1::-1])
        assert few.outlying == ("j003", "j009")


@pytest.mark.slow
@only_in_full("gross errors of two of thirty are named")
def test_of_three_quarters_there_is_no_telling_who_went_wrong():
    wrong = {f"j{k:03d}.scale": 3e-4 * (-1) ** k for k in range(2, 25)}
    spread = fit_hierarchical(*campaign(16, 30, 200, own=OWN, wrong=wrong)[1::-1])
    assert not spread.outlying and spread.tau["scale"] > 1e-4


# -- the result as a solution ---------------------------------------------------------------------


def test_it_is_an_average_over_tau(some):
    """The law of total variance, by solutions at single values of tau."""
    model, matches, _, found = some
    some_tau = found.tau_draws[::64]
    fits = [fit_linear(matches, model, priors=deviation_priors(model, t)) for t in some_tau]
    means = np.array([f.mean for f in fits])
    cov = np.mean([f.cov for f in fits], axis=0) + np.cov(means.T, bias=True)
    mean_square = np.sqrt(np.mean(some_tau**2, axis=0))
    fit = fit_linear(matches, model, priors=deviation_priors(model, mean_square))
    part = replace(found, tau_draws=some_tau, fit=fit)
    sigma = np.sqrt(np.diag(cov))
    np.testing.assert_allclose((part.mean - means.mean(axis=0)) / sigma, 0, atol=5e-3)
    # within one tau the covariance is that of the root mean square: a little to the safe side
    ratio = part.sigma / sigma
    assert (ratio > 0.999).all() and (ratio < 1.02).all()


@pytest.mark.parametrize(
    "own",
    [
        pytest.param(None, id="together"),
        case_in_full(OWN, instead="chips that deviate together are run", id="apart"),
    ],
)
def test_draws_have_the_mean_and_the_covariance(some, own):
    found = some[3] if own is None else fit_hierarchical(*campaign(5, 30, 200, own=own)[1::-1])
    n = 4000
    draws = found.draws(n, np.random.default_rng(0))
    again = found.draws(n, np.random.default_rng(0))
    np.testing.assert_array_equal(draws, again)
    np.testing.assert_allclose((draws.mean(axis=0) - found.mean) / found.sigma, 0, atol=5 / n**0.5)
    ratio, error = draws.std(axis=0) / found.sigma, 6 / np.sqrt(2 * n)
    assert (ratio < 1 + error).all()
    # single deviations whose scatter is hardly known are quoted a little too large
    assert (ratio[: found.model.n_distortion] > 1 - error).all() and (ratio > 0.8).all()
    # correlations of the lines with the deviations too, which the gauge ties together
    few = np.r_[0:3, found.index[:3], found.index[-3:]]
    np.testing.assert_allclose(
        np.corrcoef(draws[:, few].T),
        found.cov[np.ix_(few, few)] / np.outer(found.sigma[few], found.sigma[few]),
        atol=6 / n**0.5,
    )


def test_settling_moves_no_star():
    """Constants and shifts of a chip are seen only as their sums; those of its chips are means."""
    model, matches, _ = campaign(17, 12, 200, own=OWN)
    found = fit_hierarchical(matches, model)
    rng = np.random.default_rng(2)
    theta = found.fit.draws(6, rng)
    settled = found.settling.draws(theta, found.tau_draws[:6], rng)
    rows = slice(None, None, 13)
    where = {k: v[rows] for k, v in columns_of(matches).items() if v is not None}
    place = (matches.x[rows], matches.y[rows])
    before, after = (model.predict(t, *place, **where) for t in (theta, settled))
    np.testing.assert_allclose(before, after, atol=2e-7)  # but for products of two deviations
    assert np.abs(settled - theta).max() > 1e-4
    still = found.settling.mean(theta)
    names = np.array(model.names)
    shifts = still[:, [k for k, n in enumerate(names) if n.endswith("WFC1.shift_v")]]
    np.testing.assert_allclose(shifts.mean(axis=1), 0.0, atol=1e-12)
    again = record_from_arrays(record_to_arrays(found.settling))
    np.testing.assert_array_equal(again.mean(theta), still)


def test_deviations_of_single_exposures_are_those_of_the_truth(some):
    """Their differences: what they have in common is in the polynomials as well."""
    _, _, theta, found = some
    for k, kind in enumerate(KINDS):
        rows = found.index[found.scatter.kind == k]
        e = np.eye(len(rows)) - 1 / len(rows)
        d = e @ (found.mean[rows] - theta[rows])
        cov = e @ found.cov[np.ix_(rows, rows)] @ e.T
        chi2 = d @ np.linalg.pinv(cov, rtol=1e-8) @ d
        assert stats.chi2(len(rows) - 1).sf(chi2) > 1e-3
        assert found.model.names[rows[3]] == f"j004.{kind}"


def test_its_priors_are_what_sample_wants():
    """With exact errors and no outliers the posterior is the linear fit at that tau."""
    model, matches, _ = campaign(8, 4, 60, order=2, time=False)
    found = fit_hierarchical(matches, model, rejection=Rejection(1e9, None))
    for kind, tau in zip(found.scatter.kinds, found.tau_draws.T, strict=True):
        k = model.names.index(f"j003.{kind}")
        assert found.priors.precision[k] == pytest.approx(1 / np.mean(tau**2))
    posterior = sample(
        found.fit,
        matches,
        outliers=OutlierMixture("none", jitter=0.0),
        priors=found.priors,
        target_ess=200,
        seed=3,
    )
    assert posterior.convergence.converged
    pull = (posterior.mean - found.fit.mean) / found.fit.sigma
    assert np.abs(pull).max() < 5 / np.sqrt(200)
    np.testing.assert_allclose(posterior.sigma / found.fit.sigma, 1, atol=0.25)
    assert found.uses(matches).all()


# -- the gauge ------------------------------------------------------------------------------------


@pytest.mark.parametrize("frames", ["shift_rotation_scale", "affine"])
def test_deviations_without_a_prior_are_refused_by_name(frames):
    """Exactly degenerate: all scales may grow while the polynomials shrink."""
    model, matches, _ = campaign(9, 4, 150, time=False, frames=frames)
    with pytest.raises(DegenerateError, match=r"j00\d\.s.*in the polynomials") as caught:
        fit_linear(matches, model)
    assert "Gaussian priors" in str(caught.value)
    timed, matches, _ = campaign(9, 6, 150, frames=frames)
    with pytest.raises(DegenerateError, match=r"j00\d\.s.*in the polynomials"):
        fit_linear(matches, timed)


@pytest.mark.parametrize("frames", [kind for kind in FRAME_KINDS if kind != "none"])
def test_the_gauge_changes_no_position(frames):
    """With a prior so wide that it says nothing, all that is seen is the same."""
    rolls = None if frames != "shift" else np.zeros(5)
    held, matches, _ = campaign(10, 5, 200, time=False, frames=frames, rolls=rolls)
    first = replace(held, gauge="first", held=(0.0, 0.0, 0.0), origin=(5000.0, 5000.0))
    priors = GaussianPriors.of(held, {n: (0.0, 0.01) for n in held.names if n.endswith(KINDS)})
    a, b = fit_linear(matches, held, priors=priors), fit_linear(matches, first)
    seen = [residual_of(s.model, s.mean, matches) for s in (a, b)]
    np.testing.assert_allclose(*seen, atol=1e-5)
    assert a.chi2 == pytest.approx(b.chi2, rel=1e-9)
    rows = slice(None, None, 97)
    where = {k: v[rows] for k, v in columns_of(matches).items() if v is not None}
    errors = []
    for s in (a, b):
        J = s.model.jacobian(s.mean, matches.x[rows], matches.y[rows], **where)
        errors.append(np.einsum("nap,pq,naq->na", J, s.cov, J))
    np.testing.assert_allclose(*errors, rtol=1e-4)


def test_held_in_reference_finds_pointing_and_roll_of_the_first_exposure():
    model, matches, _ = campaign(11, 3, 400, time=False)
    free = replace(model, gauge="first", held=(0.0, 0.0, 0.0), origin=(123.0, 456.0))
    found = held_in_reference(matches, free)
    assert found.gauge == "held" and found.origin == (0.0, 0.0)
    assert found.held[:2] == pytest.approx(model.held[:2], abs=0.02)
    assert found.held[2] == pytest.approx(model.held[2], abs=3e-5)
    # then the polynomials lie in the gauge of that chip, to the error of one exposure
    joint = fit_linear(matches, found, priors=deviation_priors(found, TAU))
    gauge = reference_gauge(joint).gauge
    assert abs(gauge.rotation) < 3e-5 and np.abs(gauge.shift).max() < 0.02
    other = held_in_reference(matches, free, chip=1)
    assert other.held[1] != found.held[1]
    with pytest.raises(DegenerateError, match=r"chip WFC2: exposure 'j001'.*no stars"):
        held_in_reference(matches.select((matches.exposure > 0) | (matches.chip == 0)), free)


def test_exposures_are_found_through_others_that_share_a_chip():
    """The first exposure has no star on WFC1: frames start from the exposures that have both."""
    rolls = [0.4, 2.0, -2.5, 1.0]
    model, matches, theta = campaign(12, 4, 300, time=False, rolls=rolls)
    keep = ~((matches.exposure == 0) & (matches.chip == 0)) & ~(
        (matches.exposure == 3) & (matches.chip == 1)
    )
    fit = fit_linear(matches.select(keep), model, priors=deviation_priors(model, TAU))
    assert fit.n_used > 0.99 * fit.n_rows and fit.chi2 < 1.2 * fit.dof
    for e in (1, 2, 3):
        k = model.names.index(f"j{e + 1:03d}.rotation")
        assert fit.mean[k] == pytest.approx(theta[k], abs=1e-4)


# -- what cannot be fitted ------------------------------------------------------------------------


def test_few_exposures_tell_little_of_a_scatter():
    """Two, badly: the posterior is wide.  One, nothing."""
    model, matches, _ = campaign(13, 2, 300, time=False)
    low, high = fit_hierarchical(matches, model).tau_interval()["scale"]
    assert high > 4 * low
    one, matches, _ = campaign(13, 1, 300, time=False)
    with pytest.raises(
        DegenerateError, match="not determined: the linear terms can fit 1 exposures"
    ):
        fit_hierarchical(matches, one)


def test_models_without_deviations_are_refused():
    _, matches, _ = campaign(14, 3, 100)
    for changes in (
        {"frames": "shift_rotation"},
        {"gauge": "first", "held": (0.0, 0.0, 0.0)},
    ):
        with pytest.raises(InputError, match="no deviations to estimate; choose"):
            fit_hierarchical(matches, replace(campaign_model(3), **changes))
