"""Each move leaves the posterior invariant, shown on a posterior that is known in closed form.

Walkers start from exact draws.  If a move is right, they are exact draws after any number of steps:
walkers of the first two moves are even independent, so that their final positions are tested as an
independent sample.
"""

from __future__ import annotations

import emcee
import numpy as np
import pytest
from scipy import stats

from bayesdist.infer import OutlierMixture
from bayesdist.infer.proposal import GridProposal, build_proposal
from bayesdist.infer.sampler import Ensembles, Plan, Whitening, boundaries, plan_moves

from .oracle import JitterOracle
from .support import UNCLIPPED, simulated, target_of

pytestmark = pytest.mark.usefixtures("one_thread")

WALKERS, STEPS = 4000, 20
MOVES = {
    "independence": (1.0, 0.0, 0.0),
    "Crank-Nicolson": (0.0, 1.0, 0.0),
    "differential evolution": (0.0, 0.0, 1.0),
    "all": (0.3, 0.4, 0.3),
}


@pytest.fixture(scope="module", params=[0.0, 1.0], ids=["jitter at its bound", "skewed jitter"])
def known(request):
    """25 stars: log j has an exponential tail to the left, and theta wide tails."""
    model, matches, _ = simulated(51, 25, order=1, jitter=0.05 * request.param)
    target, fit = target_of(model, matches, OutlierMixture("none"), **UNCLIPPED)
    # every fourth node, shifted by half a sigma: an imperfect proposal, or accepting everything
    # would be right
    arrays = build_proposal(target, fit).to_arrays()
    coarse = {name: values[::4].copy() for name, values in arrays.items()}
    coarse["mode"] += 0.5 * fit.sigma
    coarse["log_j"] += 0.3
    proposal = GridProposal.from_arrays(target, coarse)
    return target, proposal, JitterOracle.of(1, matches)


def run(known, weights, seed):
    target, proposal, oracle = known
    rng = np.random.default_rng(seed)
    whitening = Whitening.of(target, proposal, oracle.draw(500, rng))
    plan = Plan("test", weights, WALKERS, 0, 0.5)
    runs = Ensembles(target, proposal, whitening, plan, (1,))
    first = oracle.draw(WALKERS, rng)
    state = emcee.State(whitening.to_white(first))
    state.random_state = np.random.RandomState(seed).get_state()
    return first, runs.block(0, state, 0, STEPS), oracle


def standardised(psi, oracle):
    """theta in units of its posterior sd, and log j."""
    sd = np.sqrt(oracle.expect(oracle.variance) * np.diag(oracle.unit_cov))
    return (psi[:, :-1] - oracle.centre) / sd, psi[:, -1]


@pytest.mark.parametrize("weights", MOVES.values(), ids=MOVES)
def test_moves_leave_a_skewed_posterior_invariant(known, weights):
    first, block, oracle = run(known, weights, seed=3)
    theta, log_j = standardised(block.psi[-1], oracle)

    target = known[0]
    np.testing.assert_allclose(block.log_prob[-1], target.log_density(block.psi[-1]), atol=1e-7)

    # the walkers have moved on: the test sees the move, not the start
    rate = block.accepted.mean() / STEPS
    assert 0.05 < rate < 0.999
    assert abs(np.corrcoef(first[:, -1], log_j)[0, 1]) < 0.6

    assert stats.kstest(log_j, oracle.cdf).pvalue > 1e-3
    root = np.sqrt(WALKERS)
    tail = np.interp(0.1, oracle.cdf(oracle.log_j), oracle.log_j)
    for function in (lambda t: t, np.square, lambda t: t**3, np.exp, lambda t: t < tail):
        exact = oracle.expect(function(oracle.log_j))
        values = function(log_j)
        assert abs(values.mean() - exact) < 4 * values.std() / root
    assert (np.abs(theta.mean(axis=0)) < 4 * theta.std(axis=0) / root).all()
    square = theta**2
    assert (np.abs(square.mean(axis=0) - 1) < 4 * square.std(axis=0) / root).all()
    # theta and j are dependent: wide where j is large
    v = oracle.variance
    exact = oracle.expect(v**2) / oracle.expect(v)
    product = square * (oracle.sigma**2 + np.exp(2 * log_j))[:, None]
    assert (np.abs(product.mean(axis=0) - exact) < 4 * product.std(axis=0) / root).all()


def test_whitening_is_undone_and_whitens():
    model, matches, _ = simulated(52, 300, order=2, frames="affine", n_exposures=3, fraction=0.05)
    target, fit = target_of(model, matches, OutlierMixture())
    proposal = build_proposal(target, fit)
    psi = proposal.draw(3000, np.random.default_rng(0))
    psi = psi[np.isfinite(psi).all(axis=1)]
    whitening = Whitening.of(target, proposal, psi)
    white = whitening.to_white(psi)
    np.testing.assert_allclose(whitening.to_psi(white), psi, rtol=1e-9, atol=1e-12)
    assert whitening.n_theta == model.n_params
    cov = np.cov(white, rowvar=False)
    np.testing.assert_allclose(np.diag(cov), 1, atol=0.4)
    off = cov - np.diag(np.diag(cov))
    assert np.abs(off).max() < 0.3


@pytest.mark.parametrize(
    ("every", "most"), [(200, 20_000), (1000, 3000), (30, 100), (50, 77), (7, 3)]
)
def test_boundaries(every, most):
    ends = list(boundaries(every, most))
    assert ends[-1] == most
    lengths = np.diff([0, *ends])
    assert (lengths > 0).all() and (lengths <= max(every, 1)).all()
    # whatever the total, a longer run passes through the same boundaries: resuming is possible
    longer = list(boundaries(every, 2 * most))
    assert ends[:-1] == longer[: len(ends) - 1]


def test_boundaries_are_those_documented():
    assert list(boundaries(200, 1000)) == [50, 100, 200, 400, 600, 800, 1000]


def test_plan_falls_back_as_the_proposal_gets_worse():
    good = plan_moves(0.95, 0.2, 45)
    fair = plan_moves(0.3, 0.6, 45)
    poor = plan_moves(0.01, 1.2, 45)
    assert good.weights[0] > fair.weights[0] > poor.weights[0] > 0
    assert good.weights[2] == fair.weights[2] == 0 < poor.weights[2]
    # emcee's red-blue moves refuse fewer walkers than twice the parameters
    assert poor.walkers >= 2 * 45
    # a tail that the proposal misses shows in k while the efficiency looks fine
    assert plan_moves(0.9, 1.5, 45) == plan_moves(0.01, 1.5, 45)
    for plan in (good, fair, poor):
        assert sum(plan.weights) == pytest.approx(1)
