"""The independence proposal: a normalised density, draws that follow it, and how good it is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

from bayesdist.infer import GaussianPriors, OutlierMixture, Rejection
from bayesdist.infer.density.grid import build_proposal
from bayesdist.infer.density.laplace import (
    Split,
    _expand,
    conditional_mode,
    expected_mode,
    inside,
    starting_point,
)
from bayesdist.infer.density.proposal import (
    GridProposal,
    Marginal,
    PiecewiseExponential,
    quality_of,
)
from bayesdist.model import Chip, TimeDependence
from tests.reduced import case_in_full

from ..oracle import JitterOracle
from ..support import UNCLIPPED, numerical_gradient, simulated, target_of

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
    return PiecewiseExponential(mesh, values, left_slope=1.0, right_slope=-7.0), mesh, values


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


@pytest.mark.parametrize("rise", [-800.0, -705.0, 700.0, 750.0, 1e6])
def test_piecewise_density_with_a_cliff(rise):
    """The cell of the cliff holds next to nothing: no overflow, and no mass that is not there."""
    values = np.array([0.0, rise, rise, rise - 3.0])
    density = PiecewiseExponential(np.arange(4.0), values, left_slope=1.0, right_slope=-1.0)
    x = density.quantile(np.linspace(1e-4, 1 - 1e-4, 2001))
    if rise > 0:  # 1 on the plateau, (1 - e^-3) / 3 beyond it, e^-3 in the tail
        total = 1 + (1 - np.exp(-3)) / 3 + np.exp(-3)
        assert np.mean(x < 1) < 1e-3
        assert np.mean(x < 2) == pytest.approx(1 / total, abs=2e-3)
        assert density.log_density(np.array([1.5]))[0] == pytest.approx(-np.log(total), abs=2e-3)
    else:  # all of it to the left
        assert x.max() < 0.02
        assert density.log_density(np.array([-1.0]))[0] == pytest.approx(-1.0, abs=2e-3)


# -- the marginal of a grid ---------------------------------------------------------------------


def bent(t, s):
    """A log density in log j and log s_out whose conditionals move, spread and have tails."""
    width = 0.8 + 0.1 * np.tanh(t)
    return -0.5 * ((s - 0.7 * np.sin(t / 2)) / width) ** 2 + t - 2 * np.log1p(np.exp(2 * t))


@pytest.fixture(scope="module")
def surface():
    axes = np.linspace(-6, 4, 41), np.linspace(-4, 5, 37)
    values = bent(*np.meshgrid(*axes, indexing="ij"))
    return Marginal.of(("j", "s_out"), axes, values)


def test_marginal_of_two_axes_integrates_to_one(surface):
    t, s = np.linspace(-30, 12, 3001), np.linspace(-10, 25, 2001)
    density = [surface.log_density(np.column_stack([np.full(len(s), x), s])) for x in t]
    total = np.trapezoid(np.trapezoid(np.exp(density), s, axis=1), t)
    assert total == pytest.approx(1, abs=2e-3)  # the second density changes in small steps


def test_marginal_of_two_axes_is_what_was_interpolated(surface):
    """But for the steps of the second density: a quarter of a per cent of the range each."""
    rng = np.random.default_rng(3)
    at = np.column_stack([rng.uniform(-4, 1, 400), rng.uniform(-1.5, 1.5, 400)])
    shift = surface.log_density(at) - bent(*at.T)
    assert np.ptp(shift) < 0.05
    assert shift.std() < 0.01


def test_draws_from_the_marginal_of_two_axes_follow_it(surface):
    n = 20_000
    at = surface.draw(np.random.default_rng(4).uniform(size=(n, 2)))
    t, s = np.linspace(-40, 12, 4001), np.linspace(-8, 12, 1001)
    density = np.exp(bent(*np.meshgrid(t, s, indexing="ij")))
    for k, (mesh, margin) in enumerate([(t, density.sum(1)), (s, density.sum(0))]):
        cdf = np.cumsum(margin) / margin.sum()
        assert stats.kstest(at[:, k], lambda x, m=mesh, c=cdf: np.interp(x, m, c)).pvalue > 1e-3
    assert abs(np.corrcoef(at.T)[0, 1]) > 0.05  # they do depend on each other


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
    "jitter fixed, no outliers": (OutlierMixture(jitter=0.02), {"fraction": 0.0, "jitter": 0.02}),
}


@pytest.fixture(scope="module", params=MIXTURES.values(), ids=MIXTURES)
def mixed(request):
    mixture, options = request.param
    options = {"fraction": 0.03} | options
    model, matches, _ = simulated(42, 1500, order=3, **options)
    target, fit = target_of(model, matches, mixture)
    return target, build_proposal(target, fit), options


def test_efficiency_of_the_mixture(mixed):
    target, proposal, _ = mixed
    assert efficiency(log_weights_of(target, proposal)[1]) > 0.9


def test_the_scale_of_the_outliers_is_on_the_grid_where_it_is_vague(mixed):
    target, proposal, options = mixed
    if 0 < options["fraction"] < 0.01:
        pytest.skip("four or five outliers: either way")
    held = tuple(name for name in target.mixture.hyper if name == "j")
    assert proposal.split.held == held + ("s_out",) * (options["fraction"] == 0)


def test_density_is_normalised_and_followed_by_the_draws(mixed):
    """For any normalised g that q covers, the mean of g / q over draws of q is 1."""
    _, proposal, _ = mixed
    psi = proposal.draw(4000, np.random.default_rng(6))
    ok = np.isfinite(psi).all(axis=1)
    centre = np.median(psi[ok], axis=0)
    # narrower than q, most of all in log j and log s_out, whose tails to the right are short
    shrink = np.full(len(centre), np.sqrt(0.7))
    shrink[proposal.split.n_theta :] = np.sqrt(0.3)
    cov = np.cov(psi[ok], rowvar=False) * np.outer(shrink, shrink)
    for shift in (-0.2, 0.0):
        g = stats.multivariate_normal(centre + shift * np.sqrt(np.diag(cov)), cov)
        ratio = np.zeros(len(psi))
        ratio[ok] = np.exp(g.logpdf(psi[ok]) - proposal.log_density(psi[ok]))
        assert abs(ratio.mean() - 1) < 4 * ratio.std() / np.sqrt(len(psi))
        assert ratio.std() / np.sqrt(len(psi)) < 0.1


def test_stored_proposals_are_the_same_bit_for_bit(mixed):
    target, proposal, _ = mixed
    arrays = {name: values.copy() for name, values in proposal.to_arrays().items()}
    again = GridProposal.from_arrays(target.n_theta, target.mixture.hyper, arrays)
    psi = proposal.draw(200, np.random.default_rng(7))
    np.testing.assert_array_equal(again.draw(200, np.random.default_rng(7)), psi)
    psi = psi[np.isfinite(psi).all(axis=1)]
    np.testing.assert_array_equal(again.log_density(psi), proposal.log_density(psi))


def test_proposals_of_mosaics_hold_blocks_of_chips_and_follow_the_posterior():
    chips = tuple(Chip(k, f"c{k}", (1000.0, 800.0), (500.0, 400.0)) for k in range(1, 6))
    model, matches, _ = simulated(
        5,
        1500,
        order=4,
        chips=chips,
        frames="shift",
        n_exposures=3,
        time=TimeDependence((("u", 1, 0),), (2020.0,)),
        epochs=[2019.0, 2020.5, 2022.0],
        jitter=0.01,
        fraction=0.05,
    )
    target, fit = target_of(model, matches, OutlierMixture())
    proposal = build_proposal(target, fit)
    # 15 terms on each axis and a rate; four shifts, and the two hyperparameters off the grid
    arrays = proposal.to_arrays()
    assert arrays["blocks"].shape[1:] == (5, 31, 31)
    assert arrays["border"].shape[1:] == (6, 6)
    psi, log_weights = log_weights_of(target, proposal, n=500)
    assert efficiency(log_weights) > 0.8
    again = GridProposal.from_arrays(target.n_theta, target.mixture.hyper, arrays)
    np.testing.assert_array_equal(again.draw(500, np.random.default_rng(0)), psi)


def density_of(target, split, y, at) -> float:
    """Log posterior in the coordinates of the proposal: the change of variables by differences."""
    n = target.n_theta
    psi = split.to_psi(y, at)
    out = float(target.log_density(psi[None])[0])
    for k, column in enumerate(split.columns[1]):
        step = 1e-5 * y[n + k]
        ends = []
        for sign in (-1, 1):
            there = y.copy()
            there[n + k] += sign * step
            ends.append(split.to_psi(there, at)[n + column])
        out += np.log(abs(ends[1] - ends[0]) / (2 * step))
    return out


def test_the_mode_is_a_mode(mixed):
    """No step along any coordinate of the mode raises the density (in its own coordinates)."""
    target, proposal, _ = mixed
    node, split = proposal.best, proposal.split
    sigma = np.sqrt(np.diag(node.factor.covariance()))
    top = density_of(target, split, node.mode, node.at)
    for k, s in enumerate(sigma):
        for step in (-0.1, 0.1):
            y = node.mode.copy()
            y[k] += step * s
            # a step of a tenth of a sigma costs 0.005 at least
            assert density_of(target, split, y, node.at) < top


# -- along log j and log s_out ------------------------------------------------------------------

ALONG = {
    "gaussian": (OutlierMixture(), "none", {}, ("j",)),
    "uniform": (OutlierMixture("uniform", match_radius=2.0), "shift_rotation", {}, ("j",)),
    "none": (OutlierMixture("none"), "none", {}, ("j",)),
    "frames and priors": (
        OutlierMixture(),
        "shift",
        {"u_1_1": (0.1, 0.03), "e2.shift_u": (0, 9)},
        ("j",),
    ),
    "scale of the outliers": (OutlierMixture(), "shift", {}, ("j", "s_out")),
    "jitter fixed": (OutlierMixture(jitter=0.04), "none", {}, ("s_out",)),
}
CENTRES = {"j": np.log(0.035), "s_out": np.log(0.4)}


@pytest.fixture(scope="module", params=ALONG.values(), ids=ALONG)
def along(request):
    """Modes at five values on the last axis, each searched to the last digits."""
    mixture, frames, named, held = request.param
    model, matches, _ = simulated(
        43,
        400,
        frames=frames,
        n_exposures=2,
        fraction=0.06 if mixture.model != "none" else 0.0,
        jitter=0.04,
        outlier_scale=0.5,
    )
    target, fit = target_of(model, matches, mixture, GaussianPriors.of(model, named))
    split = Split(target.n_theta, mixture.hyper, held)
    y, _ = split.from_psi(starting_point(target, fit))
    step = 0.02 * np.eye(len(held))[-1]
    centre = np.array([CENTRES[name] for name in held])
    places = [centre + k * step for k in range(-2, 3)]
    nodes = [conditional_mode(target, split, y, at, tolerance=1e-14) for at in places]
    return target, split, nodes, step


def differences(values, step):
    """First and second derivative in the middle of five, of fourth order."""
    a, b, c, d, e = (np.asarray(v) for v in values)
    return (8 * (d - b) - (e - a)) / (12 * step), (16 * (b + d) - a - e - 30 * c) / (12 * step**2)


def test_tangent_is_the_derivative_of_the_mode(along):
    target, split, nodes, step = along
    sigma = np.sqrt(np.diag(nodes[2].factor.covariance()))
    first, _ = differences([node.mode for node in nodes], step[-1])
    tangent = nodes[2].tangent[-1]
    np.testing.assert_allclose(tangent / sigma, first / sigma, rtol=1e-4, atol=2e-5)
    if len(nodes[2].mode) == target.n_theta:  # equal errors and no outliers: theta is held
        assert np.abs(tangent / sigma).max() < 1e-6
        return
    assert np.abs(tangent / sigma).max() > 0.01
    ahead = (expected_mode(split, nodes[2], step) - nodes[3].mode) / sigma
    held = (nodes[2].mode - nodes[3].mode) / sigma
    assert np.abs(ahead).max() < 0.05 * np.abs(held).max() + 1e-6


def test_the_search_never_begins_outside_the_support(along):
    """The tangent goes on for ever; a fraction does not."""
    target, split, nodes, step = along
    node, rest = nodes[2], split.rest

    def ahead(times: float):
        return node.mode + times * step @ node.tangent

    np.testing.assert_array_equal(expected_mode(split, node, step), ahead(1))
    for far in (-1e5, 1e5, -1e11, 1e11):
        start = expected_mode(split, node, far * step)
        assert inside(rest, start[target.n_theta :]) and np.isfinite(start).all()
        if rest and not inside(rest, ahead(far)[target.n_theta :]):
            np.testing.assert_array_equal(start, node.mode)
    if rest:  # it does happen
        assert not all(inside(rest, ahead(far)[target.n_theta :]) for far in (-1e11, 1e11))


def test_a_search_whose_tangent_leads_out_of_the_support():
    """Found by calibration: most of 300 matches false, at a scale not far above the core's."""
    model, matches, _ = simulated(44, 300, fraction=0.6, jitter=0.02, outlier_scale=0.25)
    target, fit = target_of(model, matches, OutlierMixture(), rejection=Rejection(clip_abs=None))
    proposal = build_proposal(target, fit)
    assert np.isfinite(log_weights_of(target, proposal, 500)[1]).mean() > 0.5


def test_slope_and_curvature_are_derivatives_of_the_profile(along):
    """Of the log posterior at the mode of everything else, as a function of the last axis."""
    target, split, nodes, step = along
    profile = [_expand(target, split, node.mode, node.at).value for node in nodes]
    first, second = differences(profile, step[-1])
    curvature = nodes[2].curvature[-1, -1]
    assert nodes[2].slope[-1] == pytest.approx(first, rel=1e-5, abs=1e-5)
    assert curvature == pytest.approx(-second, rel=1e-3, abs=1e-3)
    assert curvature > 1  # a peak that is worth the name
    # one side rises, the other falls
    assert nodes[0].slope[-1] > nodes[2].slope[-1] > nodes[4].slope[-1]


def test_slope_of_a_search_that_stops_early(along):
    """The last step is made without another pass: the slope is that of where it leads."""
    target, split, nodes, _ = along
    node = nodes[2]
    tangent = node.tangent[-1]
    length = np.sqrt(tangent @ node.factor.matrix.dense() @ tangent)
    if length < 1e-6:
        pytest.skip("the mode does not depend on log j")
    for step in (-0.05, 0.05):
        begin = node.mode + step * tangent / length
        early = conditional_mode(target, split, begin, node.at, tolerance=0.01)
        # at the beginning it is another: by step times length, to first order
        there = _expand(target, split, begin, node.at).slope[-1]
        assert there - node.slope[-1] == pytest.approx(step * length, rel=0.2)
        assert early.slope[-1] == pytest.approx(node.slope[-1], abs=0.1 * abs(step) * length)


def test_values_of_the_expansion_are_the_density(along):
    target, split, nodes, _ = along
    for node in nodes[::2]:
        y = node.mode
        found = _expand(target, split, y, node.at).value
        assert found == pytest.approx(density_of(target, split, y, node.at), abs=1e-6)


def test_curvature_at_the_mode_by_differences(along):
    """Of the factor that draws and densities come from, cube-root coordinates included."""
    target, split, nodes, _ = along
    node = nodes[2]
    if target.model.frames == "shift_rotation":
        pytest.skip("rotations have second derivatives, which Gauss-Newton leaves out")
    sigma = np.sqrt(np.diag(node.factor.covariance()))
    numeric = -numerical_gradient(
        lambda y: _expand(target, split, y, node.at).gradient, node.mode, 1e-3 * sigma
    )
    unit = np.outer(sigma, sigma)
    found = node.factor.matrix.dense()
    np.testing.assert_allclose(found * unit, numeric * unit, rtol=0, atol=3e-5)


def test_laplace_marginal_is_value_minus_half_the_log_determinant(along):
    target, split, nodes, _ = along
    for node in nodes[::2]:
        dense = node.factor.matrix.dense()
        expected = density_of(target, split, node.mode, node.at) - 0.5 * np.linalg.slogdet(dense)[1]
        assert node.log_marginal == pytest.approx(expected, abs=1e-5)


def test_the_search_ends_at_the_same_mode_from_afar(along):
    """From where the log density is lower by a hundred: EM steps first, then Newton's."""
    target, split, nodes, _ = along
    node = nodes[2]
    rng = np.random.default_rng(12)
    theta = slice(target.n_theta)
    for _ in range(4):
        z = rng.standard_normal(len(node.mode))
        y = node.mode.copy()
        y[theta] += node.factor.colour(14 * z / np.linalg.norm(z))[theta]
        y[target.n_theta :] *= rng.choice([0.5, 1.3])
        again = conditional_mode(target, split, y, node.at)
        white = node.factor.whiten(again.mode - node.mode)
        # the decrement at which it stops is 1e-9
        assert np.linalg.norm(white) < 1e-3
        assert again.log_marginal == pytest.approx(node.log_marginal, abs=1e-5)


# -- next to no false matches -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("n", "seed"),
    [
        *((2_000, k) for k in range(2)),
        *(case_in_full(2_000, k, instead="two tables are run") for k in range(2, 6)),
        case_in_full(100_000, 0, instead="fewer stars are run"),
    ],
)
def test_clean_tables_have_a_good_proposal(n, seed):
    """Right errors, no false match: fraction and scale of the outliers are a curved ridge.

    Along log j alone the efficiency is 0.5 to 0.8 here, and 0.1 where one star is doubtful, as it
    is in one of these tables.
    """
    model, matches, _ = simulated(seed, n)
    target, fit = target_of(model, matches, OutlierMixture())
    proposal = build_proposal(target, fit)
    quality = quality_of(log_weights_of(target, proposal, 2048)[1])
    assert quality.efficiency > 0.85
    assert quality.k < 0.7


@pytest.mark.parametrize(
    ("n", "jitter", "seed"),
    [
        *[(1000, 2.0, 2), (3000, 0.5, 2), (10_000, 0.1, 3)],
        *(
            case_in_full(n, jitter, seed, instead="others as much too small are run")
            for n, jitter, seed in ((1000, 2.0, 1), (10_000, 0.5, 2))
        ),
    ],
)
def test_clean_tables_with_errors_far_too_small(n, jitter, seed):
    """The outliers may then be *narrower* than the core, and most of the grid is empty."""
    model, matches, _ = simulated(seed, n, jitter=jitter)
    target, fit = target_of(model, matches, OutlierMixture())
    proposal = build_proposal(target, fit)
    psi, log_weights = log_weights_of(target, proposal, 2048)
    assert np.isfinite(psi).all(axis=1).mean() > 0.8
    assert efficiency(log_weights) > 0.005  # enough for the moves that do not rest on it alone
