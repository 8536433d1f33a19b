"""Chains until convergence: pilot, plan, blocks, verdicts, and a restart if the proposal is poor.

The proposal is judged by the importance weights of everything that was proposed, again after every
block.  When it is worse than the pilot showed, the chains start again with moves that do not depend
on it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.convergence import (
    Convergence,
    Limits,
    diagnose,
)
from bayesdist.infer.density.importance import (
    Quality,
    draws_per_effective,
    quality_of,
    warmup_steps,
)
from bayesdist.infer.density.proposal import Proposal
from bayesdist.infer.density.target import Density
from bayesdist.infer.posterior import SamplerInfo
from bayesdist.infer.sampler.checkpoints import Block, Walkers
from bayesdist.infer.sampler.heartbeat import Heartbeat
from bayesdist.infer.sampler.move_schedule import (
    EFFICIENT,
    JUDGED_AFTER,
    Plan,
    StepRange,
    block_schedule,
    doubling_schedule,
    first_check,
    has_mixed,
    is_hopeless,
    is_too_slow,
    mixing_steps,
    next_check,
    pilot_steps,
    plan_moves,
    walkers_for,
)
from bayesdist.infer.sampler.proposal_batch import ProposalBatch, pilot_batch
from bayesdist.infer.sampler.whitening import Whitening
from bayesdist.utils.arrays import Float
from bayesdist.utils.limits import PARETO_K

if TYPE_CHECKING:
    from bayesdist.infer.sampler.ensembles import Ensembles

log = logging.getLogger("bayesdist")

LEAST_ROWS = 10  # rows of a chain that diagnostics need at least
HARDEST = 30  # parameters that are judged before all of them are


@dataclass(frozen=True)
class Settings:
    """Settings of a sampling run."""

    seeds: tuple[int, ...]  # one for each ensemble
    n_stars: int  # cost of a pass
    walkers: int | None = None  # of one ensemble; None leaves it to the plan
    limits: Limits = field(default_factory=Limits)
    max_steps: int = 20_000
    checkpoint_every: int = 200
    folder: Path | None = None
    fingerprint: str = ""
    progress: Callable[[int, int], None] | None = None


@dataclass(frozen=True, eq=False)
class Chains:
    """Draws after warm-up, and statistics of the run."""

    psi: Float  # (ensembles, steps stored, walkers, D)
    log_prob: Float  # (ensembles, steps stored, walkers)
    verdict: Convergence
    plan: Plan
    steps: int  # of each ensemble, in all
    warmup: int  # steps that were dropped
    passes: int  # evaluations of the posterior density
    acceptance: float

    @property
    def draws(self) -> Float:
        """Draws (ensembles, walkers * steps stored, D), walker after walker."""
        E, T, W, D = self.psi.shape
        return np.swapaxes(self.psi, 1, 2).reshape(E, W * T, D)

    @property
    def log_densities(self) -> Float:
        """Log posterior density (ensembles, walkers * steps stored) of the draws."""
        return np.swapaxes(self.log_prob, 1, 2).reshape(len(self.log_prob), -1)

    def info(self, seed: int, started: float, *, exact: bool = True) -> SamplerInfo:
        """Record of the run, which began at `started` by `time.monotonic`."""
        method = self.plan.method
        return SamplerInfo(
            method=f"emcee {method}" if exact else method,
            ensembles=len(self.psi),
            walkers=self.plan.walkers,
            steps=self.steps,
            warmup=self.warmup,
            passes=self.passes,
            acceptance=self.acceptance,
            wall_s=time.monotonic() - started,
            seed=seed,
            exact=exact,
        )


def ensemble_seeds(seed: int, ensembles: int) -> tuple[int, ...]:
    """Seed of each ensemble; InputError for fewer than two, which cannot show convergence."""
    if ensembles < 2:
        raise InputError(
            f"{ensembles} ensemble cannot show convergence", where="sampler.ensembles", do="use 4"
        )
    return tuple(int(s) for s in np.random.SeedSequence(seed).generate_state(ensembles))


@dataclass(eq=False)
class _History:
    """Blocks of one plan since its first step."""

    runs: Ensembles
    begin: int
    psi: list[Float] = field(default_factory=list)
    log_prob: list[Float] = field(default_factory=list)
    accepted: float = 0.0
    rows: int = 0
    end: int = 0

    def walk(
        self,
        states: list[Walkers],
        schedule: Iterable[StepRange],
        rest: ProposalBatch,
        s: Settings,
    ) -> Iterator[tuple[StepRange, list[Block]]]:
        """Steps and blocks of all ensembles one after another, as they are made and added."""
        for span in schedule:
            blocks = self.runs.advance(states, span, rest)
            states = [block.end for block in blocks]
            self.psi.append(np.array([self.runs.psi(b) for b in blocks]))
            self.log_prob.append(np.array([b.log_prob for b in blocks]))
            self.accepted += float(sum(b.accepted.sum() for b in blocks))
            self.rows += self.psi[-1].shape[1]
            self.end = span.end
            if s.progress is not None:
                s.progress(span.end, s.max_steps)
            yield span, blocks

    def after(self, warmup: int) -> tuple[Float, Float]:
        """Draws and log densities after some rows."""
        psi = np.concatenate(self.psi, axis=1)[:, warmup:]
        return psi, np.concatenate(self.log_prob, axis=1)[:, warmup:]

    def chains(self, warmup: int, verdict: Convergence, passes: int) -> Chains:
        plan, (psi, log_prob) = self.runs.plan, self.after(warmup)
        made = len(self.runs.seeds) * plan.walkers * self.rows
        return Chains(
            psi=psi,
            log_prob=log_prob,
            verdict=verdict,
            plan=plan,
            steps=self.end,
            warmup=self.begin + warmup * plan.thin,
            passes=passes,
            acceptance=self.accepted / made,
        )


def run_chains(density: Density, proposal: Proposal, settings: Settings) -> Chains:
    """Sample until the targets are met or the steps are used up.

    DegenerateError when hardly a proposal falls inside the support; InputError for checkpoints that
    cannot be read or written.
    """
    from bayesdist.infer.sampler.ensembles import Ensembles  # emcee takes a second to import

    s, E = settings, len(settings.seeds)
    target = Heartbeat(density, s.n_stars)
    pilot = pilot_of(target, proposal, s)
    inside = np.isfinite(pilot.log_prob)
    if inside.sum() < 2:
        raise DegenerateError(
            "the Laplace approximation has no mass inside the support",
            where="posterior",
            do="check the match, the errors and the outlier model",
        )
    whitening = Whitening.of(target, proposal, pilot.psi[inside])

    def start(plan: Plan) -> Ensembles:
        target.method = plan.method
        return Ensembles(target, proposal, pilot, whitening, plan, s.seeds, s.folder, s.fingerprint)

    quality, passes, steps = quality_of(pilot.log_weights), pilot.n_evaluated, 0
    plan = plan_of(target, quality, s)
    if plan.independent:
        chains, quality, passes, steps = _drawn_ahead(target, start(plan), s, passes)
        if chains is not None:
            return chains
        plan = plan_of(target, quality, s)
    if not plan.coupled:
        moved, mixes = _state_dependent(target, start(plan), s, quality, passes, steps)
        if mixes:
            return moved
        if is_hopeless(len(target.names), s.n_stars, E):
            return _given_up(moved)
        passes, steps = moved.passes, moved.steps
        plan = plan_moves(0.0, np.inf, len(target.names), s.n_stars, s.walkers)
    return _state_dependent(target, start(plan), s, quality, passes, steps)[0]


def pilot_of(target: Density, proposal: Proposal, s: Settings) -> ProposalBatch:
    """First batch of proposals of a run with these settings; see `pilot_batch`."""
    walkers = s.walkers or walkers_for(s.n_stars)
    n = walkers * (pilot_steps(len(s.seeds), walkers) + 1)
    return pilot_batch(target, proposal, s.seeds, n, s.folder, s.fingerprint)


def plan_of(target: Density, quality: Quality, s: Settings) -> Plan:
    """Moves for a posterior of which the proposal is known to have this quality."""
    q, n_proposals = quality, len(quality.log_weights) + quality.n_outside
    return plan_moves(q.efficiency, q.k, len(target.names), s.n_stars, s.walkers, n_proposals)


def _given_up(chains: Chains) -> Chains:
    """Chains whose verdict says that no move reaches the posterior in reasonable time."""
    v = chains.verdict
    draws = min(v.ess_bulk_min, v.ess_tail_min)
    reason = (
        f"sampling was given up after {chains.steps} steps with {draws:.0f} effective draws: the "
        f"Laplace approximation is too far from the posterior of {len(v.names)} parameters "
        f"(importance efficiency {v.importance_efficiency:.2g}, Pareto k {v.pareto_k:.2g}); lower "
        "model.order, or give the coefficients priors"
    )
    return replace(chains, verdict=_not_converged(v, reason))


def _too_slow(verdict: Convergence, steps: int, max_steps: int) -> Convergence:
    """Verdict that says why sampling ended before the last step."""
    v = verdict
    draws = min(v.ess_bulk_min, v.ess_tail_min)
    reason = (
        f"sampling was given up after {steps} steps with {draws:.0f} effective draws of "
        f"{v.limits.ess:g}: at this rate sampler.max_steps = {max_steps} would not be enough; "
        "lower model.order, add stars where there are none, give the coefficients priors, or "
        "raise sampler.max_steps"
    )
    return _not_converged(v, reason)


def _not_converged(verdict: Convergence, reason: str) -> Convergence:
    """Verdict of sampling that is given up for a reason, which is logged."""
    log.warning("sample: %s", reason)
    return replace(verdict, converged=False, reasons=(reason, *verdict.reasons))


def _drawn_ahead(
    target: Density, runs: Ensembles, s: Settings, passes: int
) -> tuple[Chains | None, Quality, int, int]:
    """Chains by pure independence, or None when the proposal is worse than the pilot showed.

    Also the quality of the proposal as known then, and the passes and steps made.
    """
    pilot, W, total = runs.pilot, runs.plan.walkers, len(s.seeds) * runs.plan.walkers
    first = pilot.psi.shape[1] // W - 1
    states, taken, further = runs.starts()
    rest = pilot.without(taken, first * W)
    history, weights = _History(runs, 0), [pilot.log_weights]
    worst: tuple[str, ...] = ()
    passes += further
    warmup = warmup_steps(pilot.log_weights)
    cost = draws_per_effective(pilot.log_weights)
    wanted = first_check(s.limits, cost, len(target.names), len(s.seeds), W)
    wanted = max(wanted, total * LEAST_ROWS)
    schedule = block_schedule(first, s.checkpoint_every, s.max_steps, s.n_stars)
    for span, blocks in history.walk(states, schedule, rest, s):
        if span.begin >= first:
            weights.append(np.array([block.log_weights for block in blocks]))
            passes += int((~np.isnan(weights[-1])).sum())
        # judged at each block for any targets: a resumed run may have others
        quality = quality_of(np.concatenate(weights, axis=1))
        last = span.end == s.max_steps
        if not plan_of(target, quality, s).independent and not last:
            return None, quality, passes, span.end
        dropped = min(warmup, history.rows // 2)
        made = total * (history.rows - dropped)
        trusted = quality.efficiency > EFFICIENT and quality.k < PARETO_K.value
        if (made < wanted or not trusted) and not last:
            continue
        verdict = _verdict(target, history, dropped, quality, s.limits, () if last else worst)
        if not trusted:
            verdict = _distrusted(verdict, quality)
        if verdict.converged or last:
            break
        wanted, worst = next_check(made, verdict, s.n_stars, total), verdict.worst(HARDEST)
    return history.chains(dropped, verdict, passes), quality, passes, history.end


def _distrusted(verdict: Convergence, quality: Quality) -> Convergence:
    reason = (
        "the proposal misses part of the posterior (importance efficiency "
        f"{quality.efficiency:.2g}, Pareto k {quality.k:.2g}) and no steps are left for other moves"
    )
    return replace(verdict, converged=False, reasons=(*verdict.reasons, reason))


def _state_dependent(
    target: Density, runs: Ensembles, s: Settings, quality: Quality, passes: int, begin: int
) -> tuple[Chains, bool]:
    """Chains by moves that are evaluated one by one, and whether Crank-Nicolson moves mix.

    The first half of the steps is warm-up.
    """
    if s.max_steps - begin < 10 * runs.plan.thin:  # too few steps to leave any out
        runs = replace(runs, plan=replace(runs.plan, thin=1))
    plan, total = runs.plan, len(s.seeds) * runs.plan.walkers
    mixed = mixing_steps(len(target.names))
    states, _, further = runs.starts()
    passes += further
    history, wanted, nothing = _History(runs, begin), 0.0, runs.pilot[slice(0, 0)]
    worst: tuple[str, ...] = ()
    schedule = doubling_schedule(begin, s.checkpoint_every, s.max_steps, plan.thin)
    for span, _ in history.walk(states, schedule, nothing, s):
        passes += total * (span.end - span.begin)
        warmup, last = history.rows // 2, span.end + plan.thin > s.max_steps
        made = total * (history.rows - warmup)
        # at the same step for any targets, as a resumed run may have others
        trial = not plan.coupled and span.begin < begin + mixed <= span.end
        quarter = begin + JUDGED_AFTER * (s.max_steps - begin)
        judged = trial or span.begin < quarter <= span.end
        if made < max(wanted, total * LEAST_ROWS) and not last and not judged:
            continue
        verdict = _verdict(
            target, history, warmup, quality, s.limits, () if last or judged else worst
        )
        if verdict.converged or last:
            break
        if is_too_slow(verdict, span.end - begin, s.max_steps - begin):
            verdict = _too_slow(verdict, span.end, s.max_steps)
            break
        ess = min(verdict.ess_bulk_min, verdict.ess_tail_min)
        hopeless = is_hopeless(len(target.names), s.n_stars, len(s.seeds))
        if trial and not has_mixed(ess, len(target.names), total, hopeless=hopeless):
            return history.chains(warmup, verdict, passes), False
        wanted, worst = next_check(made, verdict, s.n_stars, total), verdict.worst(HARDEST)
    return history.chains(warmup, verdict, passes), True


def _verdict(
    target: Density,
    history: _History,
    warmup: int,
    quality: Quality,
    limits: Limits,
    worst: tuple[str, ...],
) -> Convergence:
    """Convergence after some rows.

    `worst`: parameters that were farthest from it before. Where these are not converged yet, it is
    theirs alone: judging thousands of parameters costs more than their draws.
    """
    draws = history.after(warmup)[0]

    def of(names: tuple[str, ...], draws: Float) -> Convergence:
        return diagnose(
            draws,
            names,
            quality.log_weights,
            limits,
            coupled=history.runs.plan.coupled,
            n_outside=quality.n_outside,
        )

    if 0 < len(worst) < len(target.names):
        found = of(worst, draws[..., [target.names.index(name) for name in worst]])
        if not found.converged:
            return found
    return of(target.names, draws)
