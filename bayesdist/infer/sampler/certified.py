"""Sampling with few passes over the data: a surrogate, its certificate, and an exact second stage.

The surrogate (see `surrogate`) is built from pilots and is a better proposal than the one from
which the pilots were drawn.  If exact evaluations are affordable, they accept or reject its draws.
This is delayed acceptance, with rejection from the first proposal as the first stage.  Otherwise
the draws of the surrogate represent the posterior approximately, and the certificate bounds their
error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.errors import InputError
from bayesdist.infer.convergence import diagnose
from bayesdist.infer.density.laplace import Node
from bayesdist.infer.density.proposal import GridProposal, Random
from bayesdist.infer.density.target import Target
from bayesdist.infer.posterior import Certificate
from bayesdist.infer.sampler.chains import Chains, Settings, run_chains
from bayesdist.infer.sampler.move_schedule import Plan, expected_passes
from bayesdist.infer.sampler.proposal_batch import ProposalBatch, pilot_batch
from bayesdist.infer.sampler.surrogate import Surrogate, certify, draw_surrogate
from bayesdist.infer.sampler.whitening import Whitening
from bayesdist.utils.arrays import Float

SECOND_STAGES = ("auto", "always", "never")
PILOTS = 400  # number of pilots, each of which takes one pass over the data
AFFORDABLE = 1e11  # limit of stars times passes for the second stage; four minutes on two cores
LEAST_DRAWS = 1000  # minimum number of surrogate draws per ensemble; they need no pass
KEY = (1_000_000,)  # spawn key of the random numbers of the pilots


@dataclass(frozen=True, eq=False)
class SurrogateProposal:
    """Surrogate density q exp(g) as a proposal that can be sampled and evaluated."""

    first: GridProposal  # q
    whitening: Whitening
    surrogate: Surrogate  # g

    @property
    def best(self) -> Node:
        """Most probable node of the first proposal."""
        return self.first.best

    def draw(self, n: int, rng: Random) -> Float:
        """Points (n, D) in sampled coordinates."""
        return self.accepted(n, rng)[0]

    def accepted(self, n: int, rng: Random) -> tuple[Float, float]:
        """Points (n, D) in sampled coordinates, and the accepted fraction of draws of q."""
        return draw_surrogate(self.first.draw, self.whitening.to_white, self.surrogate, n, rng)

    def log_density(self, psi: Float) -> Float:
        """Log density (n,) of points (n, D), up to a constant."""
        return self.first.log_density(psi) + self.surrogate.log_weight(self.whitening.to_white(psi))


def has_second_stage(choice: str, passes: int, n_stars: int) -> bool:
    """True if an exact second stage follows the surrogate.

    `choice` is one of `SECOND_STAGES`, and `passes` the expected number of passes over the data.
    """
    affordable = float(passes) * n_stars <= AFFORDABLE
    return choice == "always" or (choice == "auto" and affordable)


def run_certified(
    target: Target, proposal: GridProposal, settings: Settings, second_stage: str = "auto"
) -> tuple[Chains, Certificate, bool]:
    """Sample by means of a surrogate.

    The second stage is used 'always', 'never', or ('auto') if the expected number of passes is
    affordable.  Without it, the draws count as converged only if the certificate is granted.
    Returns the chains, the certificate, and True if a second stage made the draws exact.

    Raises InputError if `second_stage` is unknown or there are too few pilots; see also
    `run_chains` (DegenerateError) and `draw_surrogate` (NotConvergedError).
    """
    if second_stage not in SECOND_STAGES:
        raise InputError(
            f"there is no second stage {second_stage!r}",
            where="sampler.second_stage",
            do=f"choose {', '.join(SECOND_STAGES)}",
        )
    s, E = settings, len(settings.seeds)
    batch = pilot_batch(
        target, proposal, s.seeds, -(-PILOTS // E), s.folder, s.fingerprint, "certificate", KEY
    )
    psi, log_weights = batch.psi.reshape(-1, batch.psi.shape[-1]), batch.log_weights.ravel()
    inside = np.isfinite(psi).all(axis=1)
    psi, log_weights = psi[inside], log_weights[inside]
    whitening = Whitening.of(target, proposal, psi)
    rng = np.random.default_rng(np.random.SeedSequence(s.seeds[0], spawn_key=KEY))
    n_hyper = len(target.names) - target.n_theta
    surrogate, certificate = certify(whitening.to_white(psi), log_weights, n_hyper, rng=rng)
    better = SurrogateProposal(proposal, whitening, surrogate)

    passes = expected_passes(len(target.names), s.n_stars, s.limits, E)
    if has_second_stage(second_stage, passes, s.n_stars):
        # without a certificate the surrogate is not a better proposal
        chains = run_chains(target, better if certificate.granted else proposal, s)
        method = f"delayed acceptance ({chains.plan.method} second stage)"
        plan = replace(chains.plan, method=method)
        return (
            replace(chains, plan=plan, passes=chains.passes + batch.n_evaluated),
            certificate,
            True,
        )
    return _approximate(target, better, certificate, batch, s), certificate, False


def _approximate(
    target: Target,
    proposal: SurrogateProposal,
    certificate: Certificate,
    batch: ProposalBatch,
    s: Settings,
) -> Chains:
    """Independent draws of the surrogate, arranged as ensembles of one walker."""
    n = max(LEAST_DRAWS, int(2 * s.limits.ess))
    psi, shares = [], []
    for seed in s.seeds:
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(*KEY, 1)))
        draws, share = proposal.accepted(n, rng)
        psi.append(draws[:, None])
        shares.append(share)
    all_psi = np.array(psi)
    log_prob = np.array([proposal.log_density(p[:, 0])[:, None] for p in psi])
    flat = batch.psi.reshape(-1, batch.psi.shape[-1])
    inside = np.isfinite(batch.log_prob.ravel())
    weights = batch.log_prob.ravel()[inside] - proposal.log_density(flat[inside])
    verdict = diagnose(all_psi, target.names, weights, s.limits, coupled=False)
    verdict = replace(
        verdict,
        pareto_k=certificate.pareto_k,
        importance_efficiency=certificate.raw_efficiency,
    )
    if not certificate.granted:
        reasons = (*verdict.reasons, certificate.statement)
        verdict = replace(verdict, converged=False, reasons=reasons)
    return Chains(
        psi=all_psi,
        log_prob=log_prob,
        verdict=verdict,
        plan=Plan("certified surrogate (approximate)", (1.0, 0.0, 0.0), 1, 0.0),
        steps=n,
        warmup=0,
        passes=batch.n_evaluated,
        acceptance=float(np.mean(shares)),
    )
