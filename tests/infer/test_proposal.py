"""The independence proposal: a normalised density, draws that follow it, and how good it is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

from bayesdist.infer import OutlierMixture
from bayesdist.infer.proposal import GridProposal, _PiecewiseExponential, build_proposal

from .oracle import JitterOracle
from .support import UNCLIPPED, simulated, target_of

pytestmark = pytest.mark.usefixtures("one_thread")


def efficiency(log_weights: np.ndarray) -> float:
    w = np.exp(log_weights - log_weights[np.isfinite(log_weights)].max())
    return float(w.sum() ** 2 / (w**2).sum() / len(w))


def log_weights_of(target, proposal, n=4000, seed=0):
    psi = proposal.draw(n, np.random.default_rng(seed))
    ok = np.isfinite(psi).all(axis=1)
    out = np.full(n, -np.inf)
    out[ok] = target.log_density(psi[ok]) - proposal.log_density(psi[ok])
    return psi, out


# -- the piecewise exponential density ----------------------------------------------------------


@pytest.fixture(params=[0, 1, 2])
def piecewise(request):
    rng = np.random.default_rng(request.param)
    mesh = np.sort(rng.uniform(-3, 3, 12))
    values = 100 - 2 * (mesh - 0.3) ** 2 + 0.3 * rng.standard_normal(12)
    values[5] = values[4]  # a flat piece
    return _PiecewiseExponential(mesh, values, left_slope=1.0, right_slope=-7.0), mesh, values


def test_piecewise_density_integrates_to_one(piecewise):
    density, mesh, _ = piecewise
    total, _ = integrate.quad(
        lambda x: np.exp(density.log_density(np.array([x]))[0]), -40, 10, points=mesh, limit=500
    )
    assert total == pytest.approx(1, abs=1e-8)


def test_piecewise_density_is_linear_between_the_points_and_beyond(piecewise):
    density, mesh, values = piecewise
    x = np.linspace(mesh[0], mesh[-1], 500)
    found = density.log_density(x) - density.log_density(mesh[:1])
    np.testing.assert_allclose(found, np.interp(x, mesh, values) - values[0], atol=1e-12)
    ends = density.log_density(np.array([mesh[0] - 2, mesh[0], mesh[-1], mesh[-1] + 1]))
    assert ends[1] - ends[0] == pytest.approx(2.0)
    assert ends[3] - ends[2] == pytest.approx(-7.0)


def test_piecewise_quantiles_invert_the_distribution(piecewise):
    density, mesh, _ = piecewise
    p = np.concatenate([[1e-12, 1e-5], np.linspace(0.001, 0.999, 41), [1 - 1e-5, 1 - 1e-10]])
    for probability, x in zip(p, density.quantile(p), strict=True):
        below, _ = integrate.quad(
            lambda t: np.exp(density.log_density(np.array([t]))[0]),
            -60,
            x,
            points=[m for m in mesh if m < x],
            limit=500,
        )
        assert below == pytest.approx(probability, rel=1e-6, abs=1e-12)


def test_piecewise_draws_follow_the_density(piecewise):
    density, *_ = piecewise
    x = density.quantile(np.random.default_rng(4).uniform(size=20_000))
    fine = np.linspace(-30, 6, 100_001)
    cdf = integrate.cumulative_trapezoid(np.exp(density.log_density(fine)), fine, initial=0)
    assert stats.kstest(x, lambda t: np.interp(t, fine, cdf)).pvalue > 1e-3


# -- against the closed form --------------------------------------------------------------------

CASES = {
    # true jitter over quoted error, number of stars
    "errors right, few stars": (0.0, 25),
    "errors right": (0.0, 400),
    "errors half": (1.7, 60),
    "errors far too small": (20.0, 200),
}


@pytest.fixture(scope="module", params=CASES.values(), ids=CASES)
def known(request):
    jitter, n = request.param
    model, matches, _ = simulated(41, n, order=1, jitter=0.05 * jitter)
    target, fit = target_of(model, matches, OutlierMixture("none"), **UNCLIPPED)
    return target, build_proposal(target, fit), JitterOracle.of(1, matches)


def test_marginal_of_the_jitter_is_the_closed_form(known):
    """Draws, weighted by target over proposal, against the integral over theta done by hand."""
    target, proposal, oracle = known
    psi, log_weights = log_weights_of(target, proposal, 20_000)
    w = np.exp(log_weights - oracle.log_evidence)
    # the mean weight is the evidence: target and proposal are normalised
    assert abs(w.mean() - 1) < 4 * w.std() / np.sqrt(len(w)) + 1e-6
    for function in (lambda t: t, np.square, lambda t: t < np.log(0.01), np.exp):
        values = function(psi[:, -1])
        exact = oracle.expect(function(oracle.log_j))
        influence = w * (values - exact)
        assert abs(influence.mean()) < 4 * influence.std() / np.sqrt(len(w)) + 1e-6
    # and that of theta: its variance is the mean of v times (X^T X)^-1
    d2 = (psi[:, :-1] - oracle.centre) ** 2 / np.diag(oracle.unit_cov)
    influence = w[:, None] * (d2 - oracle.expect(oracle.variance))
    assert (np.abs(influence.mean(0)) < 4 * influence.std(0) / np.sqrt(len(w))).all()


def test_draws_of_the_jitter_follow_the_closed_form(known):
    """In a model that is linear the grid is all but exact: no weights are needed."""
    _, proposal, oracle = known
    psi = proposal.draw(4000, np.random.default_rng(5))
    assert stats.kstest(psi[:, -1], oracle.cdf).pvalue > 1e-3


def test_tails_of_the_jitter(known):
    """To the left both densities fall as j itself; to the right the proposal falls no faster."""
    target, proposal, oracle = known
    steps = np.arange(30.0)
    left = oracle.log_j[np.searchsorted(oracle.cdf(oracle.log_j), 1e-4)] - 0.2 * steps
    if left.max() > np.log(oracle.sigma) - 2:
        left = np.log(oracle.sigma) - 2 - 0.2 * steps  # where the likelihood still feels j
    right = oracle.log_j[np.searchsorted(oracle.cdf(oracle.log_j), 1 - 1e-4)] + 0.02 * steps
    excess = []
    for log_j in (left, right):
        psi = np.column_stack([np.tile(oracle.centre, (30, 1)), log_j])
        excess.append(target.log_density(psi) - proposal.log_density(psi))
    assert np.diff(excess[0])[-10:].max() < 0.01
    for log_weight in excess:  # bounded
        assert log_weight.max() - log_weight[0] < 1


def test_efficiency_is_high_also_where_the_jitter_piles_up_at_its_bound(known):
    target, proposal, _ = known
    assert efficiency(log_weights_of(target, proposal)[1]) > 0.9


# -- the whole mixture --------------------------------------------------------------------------

MIXTURES = {
    "well-behaved": (OutlierMixture(), {"jitter": 0.05}),
    "jitter at its bound": (OutlierMixture(), {"jitter": 0.0}),
    "uniform": (
        OutlierMixture("uniform", match_radius=2.0),
        {"jitter": 0.02, "outliers": "uniform", "outlier_scale": 2.0},
    ),
    "few outliers": (OutlierMixture(), {"fraction": 0.003, "jitter": 0.05}),
    "no outliers": (OutlierMixture(), {"fraction": 0.0, "jitter": 0.0}),
    "jitter fixed": (OutlierMixture(jitter=0.02), {"jitter": 0.02}),
}


@pytest.fixture(scope="module", params=MIXTURES.values(), ids=MIXTURES)
def mixed(request):
    mixture, options = request.param
    options = {"fraction": 0.03} | options
    model, matches, _ = simulated(42, 1500, order=3, **options)
    target, fit = target_of(model, matches, mixture)
    return target, build_proposal(target, fit), options


def test_efficiency_of_the_mixture(mixed):
    target, proposal, options = mixed
    # without outliers their scale is known from its prior only
    least = 0.9 if options["fraction"] > 0.01 else 0.5
    assert efficiency(log_weights_of(target, proposal)[1]) > least


def test_density_is_normalised_and_followed_by_the_draws(mixed):
    """For any normalised g that q covers, the mean of g / q over draws of q is 1."""
    _, proposal, _ = mixed
    psi = proposal.draw(4000, np.random.default_rng(6))
    ok = np.isfinite(psi).all(axis=1)
    centre = np.median(psi[ok], axis=0)
    # narrower than q, most of all in log j and log s_out, whose tails to the right are short
    shrink = np.full(len(centre), np.sqrt(0.7))
    shrink[proposal.target.n_theta :] = np.sqrt(0.3)
    cov = np.cov(psi[ok], rowvar=False) * np.outer(shrink, shrink)
    for shift in (-0.2, 0.0):
        g = stats.multivariate_normal(centre + shift * np.sqrt(np.diag(cov)), cov)
        ratio = np.zeros(len(psi))
        ratio[ok] = np.exp(g.logpdf(psi[ok]) - proposal.log_density(psi[ok]))
        assert abs(ratio.mean() - 1) < 4 * ratio.std() / np.sqrt(len(psi))
        assert ratio.std() / np.sqrt(len(psi)) < 0.1


def test_stored_proposals_are_the_same_bit_for_bit(mixed):
    target, proposal, _ = mixed
    again = GridProposal.from_arrays(target, {k: v.copy() for k, v in proposal.to_arrays().items()})
    psi = proposal.draw(200, np.random.default_rng(7))
    np.testing.assert_array_equal(again.draw(200, np.random.default_rng(7)), psi)
    psi = psi[np.isfinite(psi).all(axis=1)]
    np.testing.assert_array_equal(again.log_density(psi), proposal.log_density(psi))


def test_the_mode_is_a_mode(mixed):
    """No step along any coordinate of the mode raises the density (in its own coordinates)."""
    from bayesdist.infer.laplace import _value

    target, proposal, _ = mixed
    node = proposal.best
    sigma = np.sqrt(np.diag(node.factor.covariance()))
    top = _value(target, node.mode, node.log_j)
    for k, s in enumerate(sigma):
        for step in (-0.1, 0.1):
            y = node.mode.copy()
            y[k] += step * s
            # a step of a tenth of a sigma costs 0.005 at least
            assert _value(target, y, node.log_j) < top
