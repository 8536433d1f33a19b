"""Means and variances of known densities come out within three Monte-Carlo errors.

Three densities, three moves.  The Monte-Carlo errors come from the effective sample size, so that
chains that claim more than they know fail as much as chains that are wrong; three standard errors
hold for all parameters of a run together.  That the test can fail is shown with moves that are
wrong in the usual ways.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from emcee.moves import DEMove, MHMove
from scipy import special, stats

from bayesdist.infer import Limits, OutlierMixture
from bayesdist.infer.convergence import diagnose
from bayesdist.infer.density.grid import build_proposal
from bayesdist.infer.density.proposal import GridProposal
from bayesdist.infer.sampler import chains as sampling
from bayesdist.infer.sampler import ensembles as sampler
from bayesdist.infer.sampler.chains import ChainSettings, run_chains
from bayesdist.infer.sampler.schedule import mixing_steps
from tests.reduced import case_in_full, only_in_full

from ..fakes import FakeTarget, advanced, ensembles_of, gaussian_proposal
from ..oracle import JitterOracle
from ..support import UNCLIPPED, simulated, target_of

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

MOVES = {"independence": (1.0, 0.0, 0.0), "pCN": (0.0, 1.0, 0.0), "DE": (0.0, 0.0, 1.0)}
STEPS = {"independence": 600, "pCN": 2000, "DE": 2000}
WALKERS, SEEDS = 48, (1, 2, 3, 4)


@dataclass(frozen=True)
class Known:
    target: object
    proposal: GridProposal
    mean: np.ndarray
    sd: np.ndarray
    checked: np.ndarray  # parameters with known moments


def correlated_gaussian() -> Known:
    """Ten dimensions, correlations up to 0.9; the proposal is shifted and a third too wide."""
    n = 10
    sd = np.geomspace(0.1, 10.0, n)
    corr = 0.9 ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    cov, mean = corr * np.outer(sd, sd), np.linspace(-5, 5, n)
    precision = np.linalg.inv(cov)

    def log_density(x):
        return -0.5 * np.einsum("ni,ij,nj->n", x - mean, precision, x - mean)

    target = FakeTarget(log_density, n)
    proposal = gaussian_proposal(mean + 0.3 * sd, 1.35 * cov)
    return Known(target, proposal, mean, sd, np.arange(n))


def skewed() -> Known:
    """Skew-normal marginals (Azzalini 1985), then mixed linearly."""
    alpha, n = np.array([4.0, -3.0, 2.0]), 3
    delta = alpha / np.sqrt(1 + alpha**2)
    mix = np.array([[1.0, 0.0, 0.0], [0.7, 0.5, 0.0], [-0.4, 0.3, 2.0]])
    inverse = np.linalg.inv(mix)
    own_mean, own_var = delta * np.sqrt(2 / np.pi), 1 - 2 * delta**2 / np.pi

    def log_density(y):
        x = y @ inverse.T
        return (-0.5 * x**2 + special.log_ndtr(alpha * x)).sum(axis=1)

    target = FakeTarget(log_density, n)
    proposal = gaussian_proposal(mix @ (0.5 * own_mean), mix @ mix.T)
    sd = np.sqrt((mix**2) @ own_var)
    return Known(target, proposal, mix @ own_mean, sd, np.arange(n))


def jitter_at_its_bound() -> Known:
    """25 stars whose quoted errors are right: log j by quadrature, theta by the closed form."""
    model, matches, _ = simulated(51, 25, order=1)
    target, fit = target_of(model, matches, OutlierMixture("none"), **UNCLIPPED)
    arrays = build_proposal(target, fit).to_arrays()
    coarse = {k: v.copy() if k == "held" else v[::4].copy() for k, v in arrays.items()}
    coarse["mode"] += 0.4 * fit.sigma
    coarse["at"] += 0.3
    oracle = JitterOracle.of(1, matches)
    t = oracle.log_j
    mean_t = oracle.expect(t)
    sd = np.sqrt(oracle.expect(oracle.variance) * np.diag(oracle.unit_cov))
    sd_t = np.sqrt(oracle.expect((t - mean_t) ** 2))
    mean = np.append(oracle.centre, mean_t)
    proposal = GridProposal.from_arrays(target.n_theta, ("j",), coarse)
    return Known(target, proposal, mean, np.append(sd, sd_t), np.arange(len(mean)))


DENSITIES = {
    "correlated Gaussian": correlated_gaussian,
    "skewed": skewed,
    "jitter at its bound": jitter_at_its_bound,
}


# each move and each density once, with these steps: what the other pairs show these show as well
REDUCED = {
    ("correlated Gaussian", "independence"): 300,
    ("skewed", "DE"): 500,
    ("jitter at its bound", "pCN"): 1000,
}


def deviations(known: Known, move: str, steps: int) -> SimpleNamespace:
    """Errors of mean and sd of every parameter, in Monte-Carlo errors."""
    rng = np.random.default_rng(9)
    first = known.proposal.draw(len(SEEDS) * WALKERS, rng)
    runs = ensembles_of(known.target, known.proposal, first, MOVES[move], WALKERS, SEEDS)
    blocks = advanced(runs, first.reshape(len(SEEDS), WALKERS, -1), steps)
    chains = np.array([runs.psi(block) for block in blocks])[:, steps // 5 :]
    coupled = move == "DE"
    c = diagnose(chains, known.target.names, np.zeros(100), Limits(), coupled=coupled)
    flat = chains.reshape(-1, chains.shape[-1])
    # the delta method knows the walkers only: where they are coupled, their ESS is scaled down
    inflate = 1.0
    if coupled:
        alone = diagnose(chains, known.target.names, np.zeros(100), Limits(), coupled=False)
        inflate = np.sqrt(alone.ess_bulk / c.ess_bulk)
    accepted = np.mean([block.accepted.mean() for block in blocks]) / steps
    return SimpleNamespace(
        mean=(flat.mean(axis=0) - known.mean) / c.mcse_mean,
        sd=(flat.std(axis=0) - known.sd) / (c.mcse_sd * inflate),
        ess=min(c.ess_bulk_min, c.ess_tail_min),
        accepted=accepted,
    )


def limit(n: int) -> float:
    """Three standard errors for n numbers together (Bonferroni)."""
    return float(stats.norm.isf(stats.norm.sf(3.0) / n))


@pytest.mark.parametrize("move", MOVES)
@pytest.mark.parametrize("density", DENSITIES)
def test_moments(density, move, full, capsys):
    if not full and (density, move) not in REDUCED:
        pytest.skip("each move and each density is run with others: set BAYESDIST_FULL=1")
    known = DENSITIES[density]()
    found = deviations(known, move, 10 * STEPS[move] if full else REDUCED[density, move])
    with capsys.disabled():
        print(
            f"\n{move}: ESS {found.ess:.0f}, acceptance {found.accepted:.2f}, largest deviation of "
            f"a mean {np.abs(found.mean).max():.2f}, of a sd {np.abs(found.sd).max():.2f} MCSE"
        )
    assert found.ess > 300
    assert 0.1 < found.accepted < 0.95  # no perfect proposal, which would need no correction
    most = limit(2 * len(known.mean))
    assert np.abs(found.mean).max() < most
    assert np.abs(found.sd).max() < most


# -- moves that are wrong --------------------------------------------------------------------------


class _Shrinking(DEMove):
    """Differential evolution that forgets nothing but likes the middle."""

    def get_proposal(self, s, c, random):
        q, _ = super().get_proposal(s, c, random)
        return q, 0.05 * ((s**2).sum(axis=1) - (q**2).sum(axis=1))


def _no_ratio(self, numbers, random):
    new, factors = _propose(self, numbers, random)
    return new, np.zeros_like(factors)


def _no_reference(step):
    return MHMove(lambda c, r: (np.sqrt(1 - step**2) * c + step * r.standard_normal(c.shape), 0.0))


_propose = sampler._Replay.propose
WRONG = {
    "independence": (sampler._Replay, "propose", _no_ratio),
    "pCN": (sampler, "_crank_nicolson", _no_reference),
    "DE": (sampler, "DEMove", _Shrinking),
}


@pytest.mark.parametrize(
    "move",
    [
        "independence",
        *(case_in_full(move, instead="one wrong move is run") for move in ("pCN", "DE")),
    ],
)
def test_wrong_moves_are_found(move, monkeypatch):
    known = correlated_gaussian()
    monkeypatch.setattr(*WRONG[move])
    # the error of differential evolution is small: it takes three times as long to stand out
    found = deviations(known, move, STEPS[move] * (3 if move == "DE" else 1))
    worst = max(np.abs(found.mean).max(), np.abs(found.sd).max())
    assert worst > 2 * limit(2 * len(known.mean))


@only_in_full("each move is run at its density, and high orders sample many parameters")
def test_many_parameters_are_sampled_from_a_proposal_that_is_worth_little():
    """120 dimensions, the proposal a sixth too wide in each: of a thousand draws ten count."""
    n = 120
    cov = 0.5 ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    precision = np.linalg.inv(cov)
    target = FakeTarget(lambda x: -0.5 * np.einsum("ni,ij,nj->n", x, precision, x), n)
    settings = ChainSettings(seeds=SEEDS, n_stars=5000, limits=Limits(400, 1.01))
    chains = run_chains(target, gaussian_proposal(np.zeros(n), 1.35 * cov), settings)
    assert chains.verdict.importance_efficiency < 0.05
    assert chains.plan.method == "pCN + independence"
    assert chains.verdict.converged and chains.steps <= mixing_steps(n) + 200
    ess = min(chains.verdict.ess_bulk_min, chains.verdict.ess_tail_min)
    z = chains.draws.mean(axis=(0, 1)) * np.sqrt(ess)
    assert np.abs(z).max() < 5.0
    # of all parameters together, whose variances have errors of 2 / ess each
    assert chains.draws.var(axis=(0, 1)).mean() == pytest.approx(1.0, abs=4 * np.sqrt(2 / ess / 40))


@only_in_full("what never mixes is not converged")
def test_a_funnel_of_many_parameters_is_given_up(caplog):
    """Neal's funnel (2003) in 120 dimensions: no step from a Gaussian reaches its neck."""
    n, stars = 120, 10_000

    def log_density(x):
        v, rest = x[:, 0], x[:, 1:]
        return -(v**2) / 18 - 0.5 * (rest**2).sum(axis=1) * np.exp(-v) - 0.5 * (n - 1) * v

    target = FakeTarget(log_density, n)
    settings = ChainSettings(seeds=SEEDS, n_stars=stars, limits=Limits(400, 1.01))
    proposal = gaussian_proposal(np.zeros(n), np.diag(np.append(9.0, np.ones(n - 1))))
    chains = run_chains(target, proposal, settings)
    assert chains.steps <= mixing_steps(n) + settings.checkpoint_every
    assert not chains.verdict.converged
    reason, *_ = chains.verdict.reasons
    assert "given up" in reason and "120 parameters" in reason and "lower model.order" in reason
    assert reason in caplog.text


def test_judging_the_worst_parameters_first_changes_no_decision(monkeypatch):
    n, judged = 60, []
    target = FakeTarget(lambda x: -0.5 * (x**2).sum(axis=1), n)
    proposal = gaussian_proposal(np.full(n, 0.02), 1.02 * np.eye(n))
    settings = ChainSettings(SEEDS, 25, WALKERS, Limits(400.0, 1.002))

    def counted(draws, names, *args, **options):
        judged.append(len(names))
        return diagnose(draws, names, *args, **options)

    monkeypatch.setattr(sampling, "diagnose", counted)
    some = run_chains(target, proposal, settings)
    assert settings.judged_first in judged
    assert judged[-1] == len(some.verdict.names) == n
    judged.clear()
    every = run_chains(target, proposal, replace(settings, judged_first=0))
    assert set(judged) == {n}
    assert some.steps == every.steps
    assert some.verdict.converged and every.verdict.converged
    assert np.array_equal(some.psi, every.psi)
