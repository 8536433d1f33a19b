"""Sampling until convergence: pilot, choice of moves, blocks of steps, checks, and restarts.

The quality of the proposal is estimated from the importance weights of all proposals so far, and
updated after every block.  If it is worse than the pilot indicated, the chains are restarted with
moves that depend less on the proposal.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.convergence import (
    Convergence,
    Limits,
    diagnose,
)
from bayesdist.infer.density.proposal import (
    Proposal,
    Quality,
    draws_per_effective,
    quality_of,
    warmup_steps,
)
from bayesdist.infer.density.target import Density
from bayesdist.infer.posterior import SamplerInfo
from bayesdist.infer.sampler.ensembles import (
    Block,
    Ensembles,
    ProposalBatch,
    Walkers,
    Whitening,
    pilot_batch,
)
from bayesdist.infer.sampler.schedule import (
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
from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import PARETO_K

log = logging.getLogger("bayesdist")
LEAST_ROWS = 10  # minimum number of stored steps for convergence diagnostics

EVERY_S = 10.0  # seconds between two lines


@dataclass(frozen=True)
class ChainSettings:
    """Settings of a sampling run."""

    seeds: tuple[int, ...]  # one per ensemble
    n_stars: int  # number of stars, which determines the cost of a pass
    walkers: int | None = None  # walkers per ensemble; None to choose them with the moves
    limits: Limits = field(default_factory=Limits)  # convergence criteria
    max_steps: int = 20_000  # maximum number of steps of each ensemble
    checkpoint_every: int = 200  # maximum number of steps between checkpoints
    folder: Path | None = None  # folder of the checkpoints; None for no checkpoints
    fingerprint: str = ""  # hash of data and settings, stored in the checkpoints
    progress: Callable[[int, int], None] | None = None  # called with (steps, max_steps)
    judged_first: int = 30  # number of worst parameters that are checked before all parameters are


@dataclass(frozen=True, eq=False)
class Chains:
    """Draws after warm-up, and statistics of the run."""

    psi: Float  # (ensembles, steps stored, walkers, D)
    log_prob: Float  # (ensembles, steps stored, walkers)
    verdict: Convergence
    plan: Plan
    steps: int  # total number of steps of each ensemble, including warm-up
    warmup: int  # number of warm-up steps, which are not in `psi`
    passes: int  # number of evaluations of the posterior density
    acceptance: float  # accepted fraction of the proposals

    @property
    def draws(self) -> Float:
        """Draws (ensembles, walkers * steps stored, D), ordered walker by walker."""
        E, T, W, D = self.psi.shape
        return np.swapaxes(self.psi, 1, 2).reshape(E, W * T, D)

    @property
    def log_densities(self) -> Float:
        """Log posterior density (ensembles, walkers * steps stored) of the draws."""
        return np.swapaxes(self.log_prob, 1, 2).reshape(len(self.log_prob), -1)

    def info(self, seed: int, started: float) -> SamplerInfo:
        """Record of the run with this seed; `started` is its start as given by `time.monotonic`."""
        return SamplerInfo(
            method=f"emcee {self.plan.method}",
            ensembles=len(self.psi),
            walkers=self.plan.walkers,
            steps=self.steps,
            warmup=self.warmup,
            passes=self.passes,
            acceptance=self.acceptance,
            wall_s=time.monotonic() - started,
            seed=seed,
        )


def ensemble_seeds(seed: int, ensembles: int) -> tuple[int, ...]:
    """Seed of each ensemble, derived from the seed of the run.

    Raises InputError if there are fewer than two ensembles, which could not be compared.
    """
    if ensembles < 2:
        raise InputError(
            f"{ensembles} ensemble cannot show convergence", where="sampler.ensembles", do="use 4"
        )
    return tuple(int(s) for s in np.random.SeedSequence(seed).generate_state(ensembles))


@dataclass(eq=False)
class _History:
    """Accumulated blocks of the ensembles since the first step of a plan."""

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
        s: ChainSettings,
    ) -> Iterator[tuple[StepRange, list[Block]]]:
        """Advance the ensembles over a schedule; yield each range of steps with its blocks."""
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
        """Draws and log densities without the first `warmup` stored steps."""
        psi = np.concatenate(self.psi, axis=1)[:, warmup:]
        return psi, np.concatenate(self.log_prob, axis=1)[:, warmup:]

    def chains(self, warmup: int, verdict: Convergence, passes: int) -> Chains:
        plan, (psi, log_prob) = self.runs.plan, self.after(warmup)
        n_proposals = len(self.runs.seeds) * plan.walkers * self.rows
        return Chains(
            psi=psi,
            log_prob=log_prob,
            verdict=verdict,
            plan=plan,
            steps=self.end,
            warmup=self.begin + warmup * plan.thin,
            passes=passes,
            acceptance=self.accepted / n_proposals,
        )


def run_chains(density: Density, proposal: Proposal, settings: ChainSettings) -> Chains:
    """Sample a density until the convergence criteria are met or the number of steps is exhausted.

    Raises DegenerateError if hardly any proposal is inside the support, and InputError if
    checkpoints cannot be read or written.
    """
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


def pilot_of(target: Density, proposal: Proposal, s: ChainSettings) -> ProposalBatch:
    """Draw and evaluate the first batch of proposals of a run; see `pilot_batch`."""
    walkers = s.walkers or walkers_for(s.n_stars)
    n = walkers * (pilot_steps(len(s.seeds), walkers) + 1)
    return pilot_batch(target, proposal, s.seeds, n, s.folder, s.fingerprint)


def plan_of(target: Density, quality: Quality, s: ChainSettings) -> Plan:
    """Choose the moves for a proposal of the given quality, from the settings `s` of the run."""
    q, n_proposals = quality, len(quality.log_weights) + quality.n_outside
    return plan_moves(q.efficiency, q.k, len(target.names), s.n_stars, s.walkers, n_proposals)


def _given_up(chains: Chains) -> Chains:
    """Mark the chains as not converged, because no move samples the posterior efficiently."""
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
    """Diagnostics with the reason why sampling was stopped before the maximum number of steps."""
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
    """Mark diagnostics as not converged for a reason, which is also logged."""
    log.warning("sample: %s", reason)
    return replace(verdict, converged=False, reasons=(reason, *verdict.reasons))


def _drawn_ahead(
    target: Density, runs: Ensembles, s: ChainSettings, passes: int
) -> tuple[Chains | None, Quality, int, int]:
    """Sample with independence moves only.

    Returns the chains, or None if the proposal is worse than the pilot indicated; the updated
    quality of the proposal; and the numbers of passes and steps so far.
    """
    pilot, W, total = runs.pilot, runs.plan.walkers, len(s.seeds) * runs.plan.walkers
    first = pilot.psi.shape[1] // W - 1
    states, used_as_start, further = runs.starts()
    unused = pilot.without(used_as_start, first * W)
    history, weights = _History(runs, 0), [pilot.log_weights]
    worst: tuple[str, ...] = ()
    passes += further
    warmup = warmup_steps(pilot.log_weights)
    cost = draws_per_effective(pilot.log_weights)
    wanted = first_check(s.limits, cost, len(target.names), len(s.seeds), W)
    wanted = max(wanted, total * LEAST_ROWS)
    schedule = block_schedule(first, s.checkpoint_every, s.max_steps, s.n_stars)
    for span, blocks in history.walk(states, schedule, unused, s):
        if span.begin >= first:
            weights.append(np.array([block.log_weights for block in blocks]))
            passes += int((~np.isnan(weights[-1])).sum())
        # checked at each block independent of the criteria, which may differ in a resumed run
        quality = quality_of(np.concatenate(weights, axis=1))
        last = span.end == s.max_steps
        if not plan_of(target, quality, s).independent and not last:
            return None, quality, passes, span.end
        dropped = min(warmup, history.rows // 2)
        n_draws = total * (history.rows - dropped)
        trusted = quality.efficiency > EFFICIENT and quality.k < PARETO_K.value
        if (n_draws < wanted or not trusted) and not last:
            continue
        verdict = _verdict(target, history, dropped, quality, s.limits, () if last else worst)
        if not trusted:
            verdict = _distrusted(verdict, quality)
        if verdict.converged or last:
            break
        wanted, worst = (
            next_check(n_draws, verdict, s.n_stars, total),
            verdict.worst(s.judged_first),
        )
    return history.chains(dropped, verdict, passes), quality, passes, history.end


def _distrusted(verdict: Convergence, quality: Quality) -> Convergence:
    reason = (
        "the proposal misses part of the posterior (importance efficiency "
        f"{quality.efficiency:.2g}, Pareto k {quality.k:.2g}) and no steps are left for other moves"
    )
    return replace(verdict, converged=False, reasons=(*verdict.reasons, reason))


def _state_dependent(
    target: Density, runs: Ensembles, s: ChainSettings, quality: Quality, passes: int, begin: int
) -> tuple[Chains, bool]:
    """Sample with moves that depend on the state; the first half of the steps is warm-up.

    Returns the chains, and False if Crank-Nicolson moves turned out not to mix.
    """
    if s.max_steps - begin < 10 * runs.plan.thin:  # too few steps for thinning
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
        n_draws = total * (history.rows - warmup)
        # at a step independent of the criteria, which may differ in a resumed run
        trial = not plan.coupled and span.begin < begin + mixed <= span.end
        quarter = begin + JUDGED_AFTER * (s.max_steps - begin)
        judged = trial or span.begin < quarter <= span.end
        if n_draws < max(wanted, total * LEAST_ROWS) and not last and not judged:
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
        wanted, worst = (
            next_check(n_draws, verdict, s.n_stars, total),
            verdict.worst(s.judged_first),
        )
    return history.chains(warmup, verdict, passes), True


def _verdict(
    target: Density,
    history: _History,
    warmup: int,
    quality: Quality,
    limits: Limits,
    worst: tuple[str, ...],
) -> Convergence:
    """Convergence diagnostics without the first `warmup` stored steps.

    `worst` are the parameters that were farthest from convergence at the last check.  As long as
    they have not converged, only they are checked, since the diagnostics of thousands of parameters
    take longer than sampling.
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
        of_worst = of(worst, draws[..., [target.names.index(name) for name in worst]])
        if not of_worst.converged:
            return of_worst
    return of(target.names, draws)


# -- progress in the log ---------------------------------------------------------------------------


@dataclass(eq=False)
class Heartbeat:
    """Wrapper of a density that counts its evaluations and logs them every ten seconds.

    Since all moves evaluate the density, progress is reported for each of them.
    """

    density: Density
    n_stars: int
    clock: Callable[[], float] = time.monotonic  # seconds
    method: str = "pilot"  # moves of the current plan
    passes: int = 0  # number of points evaluated
    _started: float = field(init=False)
    _last: float = field(init=False)

    def __post_init__(self) -> None:
        self._started = self._last = self.clock()

    @property
    def n_theta(self) -> int:
        """Number of parameters in theta, that is, without the hyperparameters."""
        return self.density.n_theta

    @property
    def names(self) -> tuple[str, ...]:
        """Names of psi."""
        return self.density.names

    def log_density(self, psi: Float) -> Float:
        """Log density (n,) of points (n, D); minus infinity outside the support."""
        values = self.density.log_density(psi)
        self.passes += len(psi)
        now = self.clock()
        if now - self._last >= EVERY_S:
            self._last = now
            log.info(
                "sample: %s, %d passes over %d stars in %.0f s",
                self.method,
                self.passes,
                self.n_stars,
                now - self._started,
            )
        return values
