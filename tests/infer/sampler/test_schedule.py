"""Each move leaves the posterior invariant, shown on a posterior that is known in closed form.

Walkers start from exact draws.  If a move is right, they are exact draws after any number of steps:
walkers of the first two moves are even independent, so that their final positions are tested as an
independent sample.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

from bayesdist.infer import Limits, OutlierMixture
from bayesdist.infer.density.grid import build_proposal
from bayesdist.infer.density.proposal import GridProposal
from bayesdist.infer.sampler.ensembles import Whitening
from bayesdist.infer.sampler.schedule import (
    block_schedule,
    doubling_schedule,
    expected_passes,
    has_mixed,
    is_hopeless,
    mixing_steps,
    pilot_steps,
    plan_moves,
    walkers_for,
)

from ..fakes import advanced, ensembles_of
from ..oracle import JitterOracle
from ..support import UNCLIPPED, simulated, target_of

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
    coarse = {k: v.copy() if k == "held" else v[::4].copy() for k, v in arrays.items()}
    coarse["mode"] += 0.5 * fit.sigma
    coarse["at"] += 0.3
    proposal = GridProposal.from_arrays(target.n_theta, ("j",), coarse)
    return target, proposal, JitterOracle.of(1, matches)


def run(known, weights, seed):
    target, proposal, oracle = known
    rng = np.random.default_rng(seed)
    draws = oracle.draw(500, rng)
    first = oracle.draw(WALKERS, rng)
    runs = ensembles_of(target, proposal, draws, weights, WALKERS, (seed,))
    (block,) = advanced(runs, first[None], STEPS)
    return first, block, runs.psi(block), oracle


def standardised(psi, oracle):
    """theta in units of its posterior sd, and log j."""
    sd = np.sqrt(oracle.expect(oracle.variance) * np.diag(oracle.unit_cov))
    return (psi[:, :-1] - oracle.centre) / sd, psi[:, -1]


@pytest.mark.parametrize("weights", MOVES.values(), ids=MOVES)
def test_moves_leave_a_skewed_posterior_invariant(known, weights):
    first, block, psi, oracle = run(known, weights, seed=3)
    theta, log_j = standardised(psi[-1], oracle)

    target = known[0]
    np.testing.assert_allclose(block.log_prob[-1], target.log_density(psi[-1]), atol=1e-7)

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
def test_doubling_schedule(every, most):
    ends = [one.end for one in doubling_schedule(0, every, most)]
    assert ends[-1] == most
    lengths = np.diff([0, *ends])
    assert (lengths > 0).all() and (lengths <= max(every, 1)).all()
    # whatever the total, a longer run passes through the same boundaries: resuming is possible
    longer = [one.end for one in doubling_schedule(0, every, 2 * most)]
    assert ends[:-1] == longer[: len(ends) - 1]


def test_schedule_is_the_one_documented():
    assert [one.end for one in doubling_schedule(0, 200, 1000)] == [
        50,
        100,
        200,
        400,
        600,
        800,
        1000,
    ]


@pytest.mark.parametrize("n_stars", [100, 5_000, 1_000_000, 10**10])
@pytest.mark.parametrize(
    ("every", "most"), [(200, 20_000), (1000, 3000), (30, 100), (4, 77), (7, 3)]
)
def test_block_schedule(every, most, n_stars):
    pilot = 15
    rungs = list(block_schedule(pilot, every, most, n_stars))
    assert rungs[0].begin == 0 and rungs[-1].end == most
    for one, following in pairwise(rungs):
        assert one.end == one.full == following.begin
    for rung in rungs:
        assert 0 < rung.end - rung.begin <= every
        assert rung.end <= rung.full
        assert rung.full <= pilot or rung.begin >= pilot  # pilot and later batches are never mixed
        # what is added is in proportion to what there is
        assert rung.begin < pilot or rung.full - rung.begin <= 0.25 * rung.begin + 1
    longer = list(block_schedule(pilot, every, 2 * most, n_stars))
    assert [(r.begin, r.full) for r in rungs] == [(r.begin, r.full) for r in longer[: len(rungs)]]


def test_sizes_follow_the_price_of_a_pass():
    stars = [10, 1_000, 5_000, 50_000, 1_000_000, 10**10]
    walkers = [walkers_for(n) for n in stars]
    assert walkers == sorted(walkers, reverse=True)
    assert walkers[0] >= 64 and walkers[-1] == 8
    for ensembles in (2, 4, 8):
        for w in (*walkers, 1, 1000):
            # enough proposals to tell how good they are, and steps to make something of them
            assert ensembles * w * (pilot_steps(ensembles, w) + 1) >= 512
            assert pilot_steps(ensembles, w) >= 15
    # hundreds of passes where they are dear
    for n_params in (20, 45, 400):
        assert 512 <= expected_passes(n_params, 10**7, Limits()) < 1500


def test_plan_falls_back_as_the_proposal_gets_worse():
    good = plan_moves(0.95, 0.2, 45, 5000)
    fair = plan_moves(0.3, 0.6, 45, 5000)
    poor = plan_moves(0.01, 1.2, 45, 5000)
    assert good.independent and good.weights[0] > fair.weights[0] > poor.weights[0] > 0
    assert good.weights[2] == fair.weights[2] == 0 < poor.weights[2]
    assert poor.coupled and not fair.coupled
    # emcee's red-blue moves refuse fewer walkers than twice the parameters
    assert poor.walkers >= 2 * 45
    # a tail that the proposal misses shows in k while the efficiency looks fine
    assert plan_moves(0.9, 1.5, 45, 5000) == plan_moves(0.01, 1.5, 45, 5000)
    # ... but few proposals do not tell
    assert plan_moves(0.9, 1.5, 45, 5000, n_proposals=512).independent
    assert not plan_moves(0.4, 1.5, 45, 5000, n_proposals=512).independent
    # and a tail that is somewhat long is what local moves are for: the others cost a hundred times
    # as many passes
    for k, n_proposals in ((0.73, 4096), (1.5, 512)):
        assert plan_moves(0.47, k, 45, 1_000_000, n_proposals=n_proposals).method == fair.method
    # of many parameters differential evolution is the last resort
    many = plan_moves(0.01, 1.4, 184, 5000)
    assert not many.coupled and many.weights[1] > fair.weights[1]
    # the worse the proposal, the shorter the steps from it
    steps = [plan_moves(e, 1.4, 184, 5000).step for e in (0.04, 1e-3, 1e-9, 1e-300)]
    assert 0.5 == steps[0] > steps[1] > steps[2] > steps[3] == 2 / np.sqrt(184)
    assert plan_moves(0.0, np.inf, 184, 5000).coupled
    # ... and one effective draw of each walker is asked for before it, of few parameters five
    assert mixing_steps(45) == 500 and mixing_steps(184) == 1840
    assert has_mixed(130, 184, 128) and not has_mixed(120, 184, 128)
    assert has_mixed(160, 184, 80, hopeless=True) and not has_mixed(150, 184, 80, hopeless=True)
    assert has_mixed(650, 45, 128) and not has_mixed(630, 45, 128)
    # ... nor is it begun where a minute would not do
    assert is_hopeless(184, 5000, 4) and is_hopeless(60, 10**6, 4)
    assert not is_hopeless(60, 5000, 4) and not is_hopeless(45, 10**6, 4)
    for plan in (good, fair, poor, many):
        assert sum(plan.weights) == pytest.approx(1)
