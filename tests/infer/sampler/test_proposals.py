"""Proposals drawn ahead: one chain by two routes, few sweeps, and what follows when they fail."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from scipy import optimize, stats

from bayesdist.infer import Limits, OutlierMixture
from bayesdist.infer.density.grid import build_proposal
from bayesdist.infer.density.proposal import (
    draws_per_effective,
    quality_of,
    rejection,
    warmup_steps,
)
from bayesdist.infer.sampler.chains import ChainSettings, run_chains
from bayesdist.infer.sampler.ensembles import ProposalBatch, Walkers, draw_batch, replay
from bayesdist.infer.sampler.schedule import expected_passes
from tests.reduced import case_in_full, only_in_full

from ..fakes import FakeTarget, gaussian_proposal
from ..support import simulated, target_of

pytestmark = pytest.mark.usefixtures("one_thread")

MANY, FEW = 10_000_000, 5_000  # stars, as far as the plan knows
MISLED = {"n_stars": MANY, "seed": 4}  # the pilot of this seed sees nothing wrong, or too little


def settings(n_stars=MANY, seed=1, **options) -> ChainSettings:
    return ChainSettings(tuple(range(10 * seed, 10 * seed + 4)), n_stars, **options)


def nearly_gaussian(n: int = 12):
    target = FakeTarget(lambda x: -0.5 * (x**2).sum(axis=1) + 0.1 * np.cos(x[:, 0]), n)
    return target, gaussian_proposal(np.zeros(n), np.eye(n))


# -- replay ----------------------------------------------------------------------------------------


def test_replay_is_metropolis_hastings_over_the_given_proposals():
    """A loop over steps and walkers, written down from the definition, gives the same chain."""
    rng = np.random.default_rng(3)
    W, T, D = 5, 40, 3
    psi, start = rng.normal(size=(1, T * W, D)), rng.normal(size=(W, D))
    log_prob, log_q = rng.normal(size=(2, 1, T * W))
    log_prob[0, [3, 17]] = np.nan  # outside the support
    log_prob[0, 40] = -np.inf
    log_q[np.isnan(log_prob)] = np.nan
    at_start = rng.normal(size=(2, W))
    random = np.random.RandomState(8).get_state()
    block = replay(Walkers(start, *at_start, random), ProposalBatch(psi, log_prob, log_q), 0)

    stream = np.random.RandomState(8)
    here = [(start[w], *at_start[:, w]) for w in range(W)]
    for t in range(T):
        stream.uniform()  # emcee chooses among its moves, of which there is one
        u = stream.rand(W)
        for w in range(W):
            k = t * W + w
            if np.isfinite(log_prob[0, k]):
                new_weight = log_prob[0, k] - log_q[0, k]
                if np.log(u[w]) < new_weight - (here[w][1] - here[w][2]):
                    here[w] = (psi[0, k], log_prob[0, k], log_q[0, k])
            np.testing.assert_array_equal(block.coords[t, w], here[w][0])
            assert block.log_prob[t, w] == here[w][1]
    np.testing.assert_array_equal(block.end.log_q, [h[2] for h in here])
    assert 0.1 < block.accepted.mean() / T < 0.9


@pytest.mark.parametrize("rows", [1, 7, 100_000])
def test_how_many_are_evaluated_at_a_time_does_not_matter(rows):
    model, matches, _ = simulated(81, 400, n_exposures=3, frames="shift", fraction=0.05)
    target, fit = target_of(model, matches, OutlierMixture())
    proposal = build_proposal(target, fit)
    expected = draw_batch(target, proposal, (1, 2), (5,), 60)
    batch = draw_batch(target, proposal, (1, 2), (5,), 60, rows_at_once=rows)
    for name in ("psi", "log_prob", "log_q"):
        np.testing.assert_allclose(
            getattr(batch, name), getattr(expected, name), rtol=1e-12, atol=1e-9
        )
    part = draw_batch(target, proposal, (1, 2), (5,), 60, 20)
    np.testing.assert_array_equal(part.psi, expected.psi[:, :20])
    one = draw_batch(target, proposal, (2,), (5,), 60)  # each ensemble has its own numbers
    np.testing.assert_array_equal(one.psi[0], expected.psi[1])
    other = draw_batch(target, proposal, (1, 2), (6,), 60)
    assert not np.isin(other.psi[..., 0], expected.psi[..., 0]).any()


# -- few sweeps, and nothing twice -----------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_few_passes_in_few_sweeps_where_a_pass_is_dear(seed):
    target, proposal = nearly_gaussian(33)
    found = run_chains(target, proposal, settings(seed=seed))
    assert found.verdict.converged
    assert found.passes == target.points  # every one counted, none made twice
    assert found.passes < 1600
    assert target.calls < 15
    typical = expected_passes(33, MANY, Limits())
    assert 0.5 < found.passes / typical < 2


def test_walkers_share_the_loop_where_a_pass_is_cheap():
    target, proposal = nearly_gaussian()
    found = run_chains(target, proposal, settings(FEW))
    assert found.verdict.converged and found.plan.walkers >= 64
    assert found.steps < 40 and target.calls < 10
    assert found.passes == target.points


def test_the_pilot_is_the_beginning_of_the_chains():
    target, proposal = nearly_gaussian()
    seen = []
    target.function, inner = lambda x: (seen.append(x.copy()), inner(x))[1], target.function
    found = run_chains(target, proposal, settings(max_steps=15))
    assert len(seen) == 1 and found.passes == len(seen[0])
    drawn = {row.tobytes() for row in seen[0]}
    assert {row.tobytes() for row in found.psi.reshape(-1, 12)} <= drawn
    # nearly all of it: what is left out are starts, warm-up and rejections
    assert len({row.tobytes() for row in found.psi.reshape(-1, 12)}) > 0.8 * len(drawn)


# -- what weights say ------------------------------------------------------------------------------


@pytest.fixture(params=[0.2, 1.0, 2.0])
def discrete(request):
    """Forty states proposed with equal probability: the chain is a matrix."""
    rng = np.random.default_rng(5)
    log_w = request.param * rng.normal(size=40)
    log_w[:3] = -np.inf
    w = np.exp(log_w)
    with np.errstate(divide="ignore", invalid="ignore"):
        accept = np.minimum(1.0, w[None, :] / w[:, None])
    moves = np.where(w[:, None] > 0, accept, 1.0) / 40
    np.fill_diagonal(moves, 0.0)
    np.fill_diagonal(moves, 1 - moves.sum(axis=1))
    return log_w, moves, w / w.sum()


def test_rejection_rates_are_those_of_the_chain(discrete):
    log_w, moves, posterior = discrete
    mass, rate = rejection(log_w)
    order = np.argsort(log_w)[3:]
    np.testing.assert_allclose(mass, posterior[order], rtol=1e-12)
    # of proposals other than the point itself
    stay = np.diag(moves)[order]
    np.testing.assert_allclose(rate, (stay - 1 / 40) * 40 / 39, atol=1e-12)


def test_warmup_ends_when_the_posterior_is_reached(discrete):
    log_w, moves, posterior = discrete
    state = np.where(posterior > 0, 1.0, 0.0) / (posterior > 0).sum()
    t = warmup_steps(np.tile(log_w, 50))
    for _ in range(t):
        state = state @ moves
    assert 0.5 * np.abs(state - posterior).sum() <= 0.021
    # a bound, but not an idle one
    assert t == 1 or 0.5 * np.abs(state - posterior).sum() > 1e-5


def test_autocorrelation_time_is_that_of_the_chain(discrete):
    """Each state comes twice, with opposite signs: the sign does not depend on the weight."""
    log_w, moves, posterior = discrete
    proposed = np.full((40, 40), 1 / 40) * (moves > 0)
    np.fill_diagonal(proposed, np.diag(moves))
    stay = np.diag(moves)
    accept_self = 1 / 40  # a proposal of the same pair: half of it changes the sign
    rate = np.where(posterior > 0, stay - accept_self, 0.0)
    exact = posterior @ (1 + 2 * rate / (1 - rate))  # lag t: E r^t, as accepted signs are fair
    assert draws_per_effective(np.tile(log_w, 200)) == pytest.approx(exact, rel=0.01)


def test_proposals_outside_the_support_have_weight_zero():
    log_w = np.random.default_rng(6).normal(size=1000) * 0.1
    some = np.concatenate([log_w, np.full(1000, np.nan)])
    assert quality_of(some).efficiency == pytest.approx(quality_of(log_w).efficiency / 2)
    assert quality_of(some).n_outside == 1000
    assert draws_per_effective(some) > 2.9
    assert quality_of(np.full(100, np.nan)).efficiency == 0
    assert quality_of(np.full(100, -np.inf)).k == np.inf


# -- posteriors built to break the proposal --------------------------------------------------------


def two_bumps(distance: float, n: int):
    def log_density(x):
        rest = -0.5 * (x[:, 1:] ** 2).sum(axis=1)
        return rest + np.logaddexp(-0.5 * x[:, 0] ** 2, -0.5 * (x[:, 0] - distance) ** 2)

    return log_density


def student(nu: float, n: int):
    return lambda x: -0.5 * (nu + n) * np.log1p((x**2).sum(axis=1) / nu)


def banana(x):
    """Gaussian in (x0, x1 - 0.5 (x0^2 - 1)): a bent ridge (Haario et al. 1999)."""
    bent = x[:, 1] - 0.5 * (x[:, 0] ** 2 - 1)
    return -0.5 * x[:, 0] ** 2 - 0.5 * (bent / 0.3) ** 2 - 0.5 * (x[:, 2:] ** 2).sum(axis=1)


def test_a_second_mode_is_found_out_and_sampled():
    """The proposal sits on one mode; its tail touches the other, and k shows it."""
    target = FakeTarget(two_bumps(3.5, 3), 3)
    found = run_chains(target, gaussian_proposal(np.zeros(3), np.eye(3)), settings(FEW))
    assert "DE" in found.plan.method
    assert found.verdict.converged, found.verdict.reasons
    first = found.psi[..., 0]
    assert abs(first.mean() - 1.75) < 4 * found.verdict.mcse_mean[0]
    assert abs((first > 1.75).mean() - 0.5) < 0.1
    assert found.passes == target.points


def test_tails_that_a_gaussian_misses():
    target = FakeTarget(student(3.0, 2), 2)
    found = run_chains(target, gaussian_proposal(np.zeros(2), np.eye(2)), settings(FEW))
    assert found.plan.method != "independence"
    assert found.verdict.pareto_k > 0.7
    assert found.verdict.converged, found.verdict.reasons
    x = found.psi[..., 0]
    for p in (0.05, 0.25, 0.75, 0.95):
        at = stats.t(3).ppf(p)
        # the tail ESS is that of the 5 % quantiles
        error = np.sqrt(p * (1 - p) / min(found.verdict.ess_tail_min, found.verdict.ess_bulk_min))
        assert abs((x < at).mean() - p) < 4 * error


@pytest.mark.slow
@only_in_full("other moves take over for a flaw of the proposal")
def test_a_banana():
    target = FakeTarget(banana, 3)
    cov = np.diag([1.0, 0.3**2, 1.0])
    found = run_chains(target, gaussian_proposal(np.zeros(3), cov), settings(FEW))
    assert "DE" in found.plan.method  # Crank-Nicolson was tried, and got nowhere
    assert found.warmup > 500
    assert found.verdict.converged, found.verdict.reasons
    variance = found.psi[..., 1].var()
    assert abs(variance - (0.09 + 0.5)) < 4 * 2 * np.sqrt(0.59) * found.verdict.mcse_sd[1]


def test_a_fair_proposal_is_mixed_with_crank_nicolson():
    """Too wide by half in eight dimensions: bounded weights, efficiency 0.3."""
    target = FakeTarget(lambda x: -0.5 * (x**2).sum(axis=1), 8)
    proposal = gaussian_proposal(np.zeros(8), 1.9 * np.eye(8))
    found = run_chains(target, proposal, settings(FEW))
    assert found.plan.method == "independence + pCN"
    assert found.verdict.converged, found.verdict.reasons
    sd = found.psi.reshape(-1, 8).std(axis=0)
    assert (np.abs(sd - 1) < 4 * found.verdict.mcse_sd).all()
    assert found.passes == target.points


@pytest.mark.parametrize("n_stars", [case_in_full(MANY, instead="few stars are run"), FEW])
def test_what_never_mixes_is_not_converged(n_stars):
    """Two modes thirty sigma apart: no move ever leads from one to the other."""
    n = 4
    target = FakeTarget(two_bumps(30.0, n), n)
    proposal = gaussian_proposal(np.array([15.0, 0.0, 0.0, 0.0]), 6.0 * np.eye(n))
    found = run_chains(target, proposal, settings(n_stars, max_steps=400))
    assert not found.verdict.converged and found.verdict.reasons
    assert "DE" in found.plan.method
    assert found.steps == 400
    assert found.passes == target.points


def misleading():
    """A second mode so far out that 512 proposals hardly touch it, and some thousands do."""
    target = FakeTarget(two_bumps(3.5, 2), 2)
    return target, gaussian_proposal(np.zeros(2), np.eye(2))


def test_a_flaw_that_the_pilot_did_not_see():
    """More proposals show it, other moves take over, and what was drawn until then is dropped."""
    target, proposal = misleading()
    found = run_chains(target, proposal, settings(**MISLED))
    assert "DE" in found.plan.method
    # no state-dependent step before the first block of proposals is through
    begin = found.steps - 2 * found.psi.shape[1] * found.plan.thin
    assert begin >= 15 and found.warmup > begin
    assert found.passes == target.points
    assert found.verdict.converged, found.verdict.reasons
    assert abs(found.psi[..., 0].mean() - 1.75) < 4 * found.verdict.mcse_mean[0]


def test_no_steps_left_for_other_moves_is_said():
    target, proposal = misleading()
    found = run_chains(
        target, proposal, settings(**MISLED, limits=Limits(ess=10, rhat=2.0), max_steps=15)
    )
    assert not found.verdict.converged
    assert any("Pareto k" in reason for reason in found.verdict.reasons)


def test_weakly_identified_jitter():
    """True j = 0.004 beside errors of 0.05, 5000 stars: one Gaussian fails, the grid does not."""
    model, matches, _ = simulated(82, 5000, order=2, fraction=0.03, jitter=0.004)
    target, fit = target_of(model, matches, OutlierMixture())
    proposal = build_proposal(target, fit)
    seeds = (1, 2)
    grid = quality_of(draw_batch(target, proposal, seeds, (0,), 1000).log_weights)
    assert grid.efficiency > 0.9 and grid.k < 0.7

    # plain Laplace: mode and curvature in all sampled coordinates, by differences
    draws = proposal.draw(2000, np.random.default_rng(0))
    centre, cov = draws.mean(axis=0), np.cov(draws, rowvar=False)
    root = np.linalg.cholesky(cov)

    def height(w):
        return target.log_density(centre + np.atleast_2d(w) @ root.T)

    mode = optimize.minimize(
        lambda w: -height(w)[0],
        np.zeros(len(centre)),
        method="BFGS",
        jac=lambda w: -_gradient(height, w),
        options={"gtol": 1e-3},
    ).x
    curvature = -_hessian(height, mode)
    values, vectors = np.linalg.eigh(curvature)
    assert (values > 0).all()
    cov_white = (vectors / values) @ vectors.T
    plain = stats.multivariate_normal(mode, cov_white)
    w = plain.rvs(4000, random_state=1)
    log_weights = height(w) - plain.logpdf(w)
    assert quality_of(log_weights).efficiency < 0.5
    # while the acceptance of the chain looks fine
    mass, rate = rejection(log_weights)
    assert 1 - mass @ rate > 0.3


def _gradient(height, w, step=1e-3):
    e = step * np.eye(len(w))
    return (height(w + e) - height(w - e)) / (2 * step)


def _hessian(height, w, step=0.02):
    e = step * np.eye(len(w))
    rows = [(_gradient(height, w + d) - _gradient(height, w - d)) / (2 * step) for d in e]
    return (np.array(rows) + np.array(rows).T) / 2


# -- resuming --------------------------------------------------------------------------------------


def independent():
    return nearly_gaussian(6)


LONG = {"limits": Limits(ess=1e9), "max_steps": 160, "checkpoint_every": 30, **MISLED}


@pytest.fixture(scope="module", params=[independent, misleading])
def whole(request, tmp_path_factory):
    """A kind of problem, its chains, and the folder of their checkpoints."""
    kind, folder = request.param, tmp_path_factory.mktemp("chains")
    alone = run_chains(*kind(), settings(**LONG))
    saved = run_chains(*kind(), settings(folder=folder, fingerprint="x", **LONG))
    np.testing.assert_array_equal(saved.psi, alone.psi)
    assert (alone.plan.method == "independence") == (kind is independent)
    return kind, alone, folder


@pytest.mark.parametrize(
    "keep",
    [
        *("all", "odd"),
        *(
            case_in_full(keep, instead="all or half of the files are kept")
            for keep in ("none of the pilot", "first", "every third")
        ),
    ],
)
def test_killed_runs_end_as_if_nothing_had_happened(whole, keep, tmp_path):
    kind, whole, folder = whole
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    files = sorted(tmp_path.glob("*.h5"))
    assert len(files) > 12 and (tmp_path / "chain-0-pilot.h5") in files
    for k, path in enumerate(files):
        lost = {
            "all": False,
            "none of the pilot": "pilot" in path.name,
            "first": not ("pilot" in path.name or path.name.startswith("chain-1")),
            "every third": k % 3 == 0,
            "odd": k % 2 == 1,
        }[keep]
        if lost:
            path.unlink()
    target, proposal = kind()
    again = run_chains(target, proposal, settings(folder=tmp_path, fingerprint="x", **LONG))
    np.testing.assert_array_equal(again.psi, whole.psi)
    np.testing.assert_array_equal(again.log_prob, whole.log_prob)
    for name in ("steps", "warmup", "passes", "acceptance"):
        assert getattr(again, name) == getattr(whole, name), name
    np.testing.assert_array_equal(again.verdict.rhat, whole.verdict.rhat)
    assert again.verdict.pareto_k == whole.verdict.pareto_k
    if keep == "all":
        assert target.points == 0


def test_a_raised_target_goes_on_from_what_there_is(tmp_path):
    target, proposal = nearly_gaussian(6)
    first = run_chains(target, proposal, settings(folder=tmp_path))
    before = target.points
    more = run_chains(target, proposal, settings(folder=tmp_path, limits=Limits(ess=1500)))
    assert first.verdict.converged and more.verdict.converged
    assert more.steps > first.steps
    assert target.points == more.passes > before  # nothing was made twice
    n = min(first.psi.shape[1], more.psi.shape[1])
    np.testing.assert_array_equal(more.psi[:, :n], first.psi[:, :n])
