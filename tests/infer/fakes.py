"""Densities with known moments that stand in for a posterior, and Gaussian proposals for them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bayesdist.infer import OutlierMixture
from bayesdist.infer.density.laplace import Node, Split
from bayesdist.infer.density.proposal import GridProposal
from bayesdist.infer.equations.arrow import Arrow
from bayesdist.infer.sampler.ensembles import Ensembles, ProposalBatch, Walkers, Whitening
from bayesdist.infer.sampler.schedule import Plan, StepRange


class FakeTarget:
    """What the sampler asks of a target; counts what it is asked."""

    mixture = OutlierMixture("none", jitter=0.0)
    hyper = mixture.bind(1.0)

    def __init__(self, log_density: Callable[[np.ndarray], np.ndarray], n_params: int) -> None:
        self.function, self.n_theta = log_density, n_params
        self.names = tuple(f"p{k}" for k in range(n_params))
        self.calls, self.points = 0, 0

    def log_density(self, psi: np.ndarray) -> np.ndarray:
        self.calls, self.points = self.calls + 1, self.points + len(psi)
        return self.function(psi)


def gaussian_proposal(mean, cov) -> GridProposal:
    """One node, no hyperparameters."""
    n = len(mean)
    curvature = Arrow(np.linalg.inv(cov), np.zeros((0, n, 0)), np.zeros((0, 0, 0)))
    node = Node(np.zeros(0), np.asarray(mean), curvature.factor(), 0.0)
    return GridProposal(Split(n, (), ()), (node,))


def empty_page(ensembles: int, n_params: int) -> ProposalBatch:
    return ProposalBatch(np.empty((ensembles, 0, n_params)), *np.empty((2, ensembles, 0)))


def ensembles_of(target, proposal, draws, weights, walkers, seeds, step=0.5) -> Ensembles:
    """Ensembles with the moves that are asked for, whatever the proposal is worth."""
    return Ensembles(
        target,
        proposal,
        empty_page(len(seeds), draws.shape[-1]),
        Whitening.of(target, proposal, draws),
        Plan("test", weights, walkers, step),
        tuple(seeds),
    )


def advanced(runs: Ensembles, first: np.ndarray, steps: int):
    """Blocks of all ensembles from walkers at psi (ensembles, walkers, D)."""
    states = []
    for seed, psi in zip(runs.seeds, first, strict=True):
        coords = psi if runs.plan.independent else runs.whitening.to_white(psi)
        log_prob, log_q = runs.target.log_density(psi), runs.proposal.log_density(psi)
        random = np.random.RandomState(seed).get_state()
        states.append(Walkers(coords, log_prob, log_q, random))
    return runs.advance(states, StepRange(0, steps, steps), runs.pilot)
