"""Schedule of sampling: moves, walkers, and the steps at which blocks end and are judged.

All of it follows from the number of stars, from the importance weights and from the settings, never
from measured times: a run that is repeated or resumed makes identical steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bayesdist.infer.convergence import Convergence, Limits
from bayesdist.utils.distributions import chi2_isf
from bayesdist.utils.limits import DRAWS_PER_WALKER, PARETO_K

FIRST_CHECK = 50  # steps after which state-dependent moves are first judged
PILOT = 512  # smallest number of proposals that judge the proposal
MOST_PILOT = 4096
WORTH = 40_000_000  # evaluations of one star that cost about as much as one diagnosis: 0.1 s
DEAR = 200_000  # stars above which passes are counted one by one
FEWEST_WALKERS, MOST_WALKERS = 8, 64

EFFICIENT, USABLE = 0.5, 0.05  # importance efficiency
NO_MEAN = 1.0  # Pareto k beyond which weights have no mean: the proposal misses the posterior
# parameters from which differential evolution, with two walkers for each, mixes later than
# Crank-Nicolson moves do from next to any proposal
MANY = 50
# evaluations of one star, about a minute's: beyond them differential evolution of many parameters
# is not begun
MOST_WORK = 600 * WORTH
JUDGED_AFTER = 0.25  # fraction of the steps after which the rate of effective draws is judged
TOO_SLOW = 5.0  # factor by which that rate may be too low
PROBATION = 2048  # proposals below which k scatters too much (by about 0.2 at 512) to reject one


@dataclass(frozen=True)
class Plan:
    """Plan of sampling, chosen from the quality of the proposal and never from its acceptance."""

    method: str  # name in reports
    # fractions of independence, Crank-Nicolson and differential evolution
    weights: tuple[float, float, float]
    walkers: int  # of one ensemble
    step: float  # b of the Crank-Nicolson move
    thin: int = 1  # one in so many steps is stored: slow moves would only fill the memory

    @property
    def independent(self) -> bool:
        """True if no proposal depends on the walkers, so that they can be drawn ahead."""
        return self.weights[0] == 1.0

    @property
    def coupled(self) -> bool:
        """True if the walkers of an ensemble influence each other."""
        return self.weights[2] > 0


def plan_moves(
    efficiency: float,
    k: float,
    n_params: int,
    n_stars: int,
    walkers: int | None = None,
    n_proposals: int = PROBATION,
) -> Plan:
    """Moves chosen from the importance efficiency and the Pareto k of the proposal.

    Acceptance is not used: it looks fine on proposals that miss a tail.  `n_proposals` gave
    efficiency and k; while they are few, a k above its limit is checked by further proposals, which
    cost less than the other moves.  An efficiency of zero stands for a proposal from which
    Crank-Nicolson moves do not mix.
    """
    step = min(0.5, 2.0 / np.sqrt(n_params))
    dear = n_stars > DEAR  # every step counts, and there are few of them
    if efficiency > EFFICIENT and (k < PARETO_K.value or n_proposals < PROBATION):
        return Plan("independence", (1.0, 0.0, 0.0), walkers or walkers_for(n_stars), step)
    # local moves compensate for a tail that the proposal reaches too seldom
    if efficiency > USABLE and (k < NO_MEAN or n_proposals < PROBATION):
        return Plan("independence + pCN", (0.6, 0.4, 0.0), walkers or 32, step, 1 if dear else 5)
    if n_params > MANY and efficiency > 0:
        # the log weight, of variance -log(efficiency) if it is normal, then changes by sqrt(2), and
        # two of five moves are accepted
        step = float(np.clip(1 / np.sqrt(-np.log(efficiency)), step, 0.5))
        thin = 1 if dear else 5
        return Plan("pCN + independence", (0.2, 0.8, 0.0), walkers or 20, step, thin)
    # emcee's red-blue moves need two walkers for each parameter
    least = max(2 * (n_params + 1), 32)
    walkers, thin = max(walkers or 0, least), 1 if dear else 10
    return Plan("DE + pCN + independence", (0.2, 0.3, 0.5), walkers, step, thin)


def mixing_steps(n_params: int) -> int:
    """Steps after which `has_mixed` is asked of Crank-Nicolson moves.

    A walker is independent after some n_params / 2 of them, the step being what it is.
    """
    return max(500, 10 * n_params)


def has_mixed(ess: float, n_params: int, walkers: int, *, hopeless: bool = False) -> bool:
    """True if Crank-Nicolson moves are to go on: every walker has made enough effective draws.

    Of many parameters one is enough, since the other moves make fewer in as many passes.  Where
    these are `hopeless` it is two: with fewer, sampling would take more than about a minute.
    `walkers` are those of all ensembles together.
    """
    if n_params <= MANY:
        return ess >= DRAWS_PER_WALKER.value * walkers
    return ess >= (2.0 if hopeless else 1.0) * walkers


def is_hopeless(n_params: int, n_stars: int, ensembles: int) -> bool:
    """True if differential evolution is too slow to help where Crank-Nicolson moves do not mix.

    It forgets in three steps for each parameter, and every one of its walkers, two for each
    parameter, makes five effective draws after as many steps of warm-up.
    """
    steps = 2 * DRAWS_PER_WALKER.value * 3 * n_params
    work = ensembles * 2 * (n_params + 1) * steps * n_stars
    return n_params > MANY and work > MOST_WORK


def is_too_slow(verdict: Convergence, made: int, most: int) -> bool:
    """True if the targets are far out of reach within `most` steps, judged after `made` steps.

    The rate of effective draws rises while walkers forget their start. It is therefore judged after
    a quarter of the steps, and only a rate five times too low ends a run: what may still converge
    goes on.
    """
    ess = min(verdict.ess_bulk_min, verdict.ess_tail_min)
    return made >= most * JUDGED_AFTER and ess * most / made < verdict.limits.ess / TOO_SLOW


# -- independence: sizes --------------------------------------------------------------------------


def _worth(n_stars: int) -> int:
    """Number of passes that cost about as much as one diagnosis."""
    return int(min(WORTH // max(n_stars, 1), MOST_PILOT))


def walkers_for(n_stars: int) -> int:
    """Walkers of one ensemble of independence chains.

    Many where a pass is cheap, so that emcee's loop is shared by many; few where it is expensive,
    as each walker needs a start, a warm-up and five effective draws.
    """
    return int(np.clip(_worth(n_stars) // 64, FEWEST_WALKERS, MOST_WALKERS))


def pilot_steps(ensembles: int, walkers: int) -> int:
    """Steps for which the pilot's proposals suffice, after one of them for each walker's start."""
    return max(15, -(-PILOT // (ensembles * walkers)) - 1)


@dataclass(frozen=True)
class StepRange:
    """Steps from `begin` to `end`; without the limit `max_steps` they would end at `full`."""

    begin: int
    end: int
    full: int


def block_schedule(pilot: int, every: int, max_steps: int, n_stars: int) -> Iterator[StepRange]:
    """Blocks of the independence plan, independent of the targets.

    The pilot is cut into pieces of `every` steps at most; then blocks grow with the steps made, by
    1/8 where passes are expensive and 1/4 where they are cheap, up to `every`.
    """
    growth = 1 / 8 if n_stars > DEAR else 1 / 4
    begin = 0
    while begin < max_steps:
        step = pilot - begin if begin < pilot else int(np.ceil(growth * begin))
        full = begin + min(step, every)
        yield StepRange(begin, min(full, max_steps), full)
        begin = full


# -- independence: when to look -------------------------------------------------------------------


def _chance_rhat(limits: Limits, n_params: int, ensembles: int) -> float:
    """Independent draws after which R-hat of all parameters is below its limit by chance.

    With c split chains of n draws R-hat - 1 is (chi2_(c-1) / (c-1) - 1) / 2n.
    """
    chains = 2 * ensembles
    worst = float(chi2_isf(1 / (2 * n_params), chains - 1)) / (chains - 1)
    return chains * (worst - 1) / 2 / max(limits.rhat - 1, 1e-6)


def first_check(limits: Limits, cost: float, n_params: int, ensembles: int, walkers: int) -> float:
    """Draws after warm-up at the first check of convergence; `cost` is draws per effective draw."""
    slack = 1.05 + 3 / np.sqrt(max(limits.ess, 1.0))  # the estimate of the ESS scatters
    return max(
        slack * cost * limits.ess,
        1.1 * cost * DRAWS_PER_WALKER.value * ensembles * walkers,
        0.7 * cost * _chance_rhat(limits, n_params, ensembles),
    )


def next_check(made: int, verdict: Convergence, n_stars: int, walkers: int) -> float:
    """Draws at which to judge again, from the distance of the last verdict from its targets.

    `made` draws were judged; `walkers` are those of all ensembles together.
    """
    ess = max(min(verdict.ess_bulk_min, verdict.ess_tail_min), 1e-3)
    lacking = max(
        verdict.limits.ess / ess,
        DRAWS_PER_WALKER.value * walkers / ess,
        (verdict.rhat_max - 1) / max(verdict.limits.rhat - 1, 1e-6),
    )
    # a little early: another check costs less than passes that were not needed
    return max(made + _worth(n_stars), min(0.85 * lacking, 2.0) * made)


def expected_passes(n_params: int, n_stars: int, limits: Limits, ensembles: int = 4) -> int:
    """Passes of a run with a good proposal, including pilot, start and warm-up."""
    walkers = walkers_for(n_stars)
    draws = first_check(limits, 1.1, n_params, ensembles, walkers)
    draws = max(draws, 1.1 * _chance_rhat(limits, n_params, ensembles))
    pilot = ensembles * walkers * (pilot_steps(ensembles, walkers) + 1)
    return int(max(pilot, draws + 3 * ensembles * walkers))


# -- state-dependent moves ------------------------------------------------------------------------


def doubling_schedule(begin: int, every: int, max_steps: int, thin: int = 1) -> Iterator[StepRange]:
    """Blocks that end 50, 100, 200, ... then every `every` steps after `begin`, up to `max_steps`.

    All have a multiple of `thin` steps, so that every stored row represents as many.
    """
    last, made = (max_steps - begin) // thin * thin, 0
    while made < last:
        step = min(max(made, FIRST_CHECK), every)
        end = min(made + step + -step % thin, last)
        yield StepRange(begin + made, begin + end, begin + end)
        made = end
