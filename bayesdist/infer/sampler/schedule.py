"""Schedule of the sampling: moves, walkers, lengths of blocks, and times of convergence checks.

The schedule depends on the number of stars, the importance weights and the settings, but not on
measured times, so that a repeated or resumed run makes identical steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bayesdist.infer.convergence import Convergence, Limits
from bayesdist.utils.checks import DRAWS_PER_WALKER, PARETO_K
from bayesdist.utils.distributions import chi2_isf

FIRST_CHECK = 50  # steps before the first convergence check of state-dependent moves
PILOT = 512  # minimum number of pilot proposals
MOST_PILOT = 4096  # maximum number of passes between two convergence checks
WORTH = 40_000_000  # stars times passes that take as long as one convergence check (0.1 s)
DEAR = 200_000  # number of stars above which a pass is expensive
FEWEST_WALKERS, MOST_WALKERS = 8, 64

EFFICIENT, USABLE = 0.5, 0.05  # limits of the importance efficiency for the choice of moves
NO_MEAN = 1.0  # Pareto k above which the weights have no mean: the proposal misses the posterior
# number of parameters above which differential evolution, with its two walkers per parameter,
# mixes more slowly than Crank-Nicolson moves with almost any proposal
MANY = 50
# limit of stars times passes (about a minute) above which differential evolution is not started if
# there are many parameters
MOST_WORK = 600 * WORTH
JUDGED_AFTER = 0.25  # fraction of the steps after which the rate of effective draws is checked
TOO_SLOW = 5.0  # factor by which that rate may be too low
PROBATION = 2048  # with fewer proposals, k is too uncertain (0.2 for 512) to reject a proposal


@dataclass(frozen=True)
class Plan:
    """Moves and walkers of the sampling, chosen from the quality of the proposal."""

    method: str  # name in reports
    # fractions of independence, Crank-Nicolson and differential-evolution moves
    weights: tuple[float, float, float]
    walkers: int  # walkers per ensemble
    step: float  # b of the Crank-Nicolson move
    thin: int = 1  # only every `thin`-th step is stored, to save memory with slow moves

    @property
    def independent(self) -> bool:
        """True if proposals do not depend on the walkers and can be drawn in advance."""
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
    """Choose the moves from the importance efficiency and the Pareto k of the proposal.

    `walkers` is the number of walkers per ensemble; it is chosen if it is None.

    The acceptance rate is not used, because it looks good even if the proposal misses a tail.
    `n_proposals` is the number of draws from which efficiency and k were estimated.  If there are
    few, a k above its limit does not yet exclude independence moves, since more proposals are
    cheaper than other moves.  An efficiency of zero means that Crank-Nicolson moves do not mix.
    """
    step = min(0.5, 2.0 / np.sqrt(n_params))
    dear = n_stars > DEAR  # few steps are affordable, so all of them are stored
    if efficiency > EFFICIENT and (k < PARETO_K.value or n_proposals < PROBATION):
        return Plan("independence", (1.0, 0.0, 0.0), walkers or walkers_for(n_stars), step)
    # local moves compensate for a tail that the proposal rarely reaches
    if efficiency > USABLE and (k < NO_MEAN or n_proposals < PROBATION):
        return Plan("independence + pCN", (0.6, 0.4, 0.0), walkers or 32, step, 1 if dear else 5)
    if n_params > MANY and efficiency > 0:
        # If the log weight is normal, its variance is -log(efficiency). With this step it changes
        # by sqrt(2), and two of five moves are accepted.
        step = float(np.clip(1 / np.sqrt(-np.log(efficiency)), step, 0.5))
        thin = 1 if dear else 5
        return Plan("pCN + independence", (0.2, 0.8, 0.0), walkers or 20, step, thin)
    # the red-blue moves of emcee need two walkers per parameter
    min_walkers = max(2 * (n_params + 1), 32)
    walkers, thin = max(walkers or 0, min_walkers), 1 if dear else 10
    return Plan("DE + pCN + independence", (0.2, 0.3, 0.5), walkers, step, thin)


def mixing_steps(n_params: int) -> int:
    """Number of steps after which the mixing of Crank-Nicolson moves is checked (`has_mixed`).

    With the step size of `plan_moves`, a walker decorrelates within about n_params / 2 steps.
    """
    return max(500, 10 * n_params)


def has_mixed(ess: float, n_params: int, walkers: int, *, hopeless: bool = False) -> bool:
    """True if Crank-Nicolson moves mix well enough: each walker has made enough effective draws.

    `ess` is the effective number of draws of all walkers, and `walkers` the total number of walkers
    of all ensembles.  With many parameters, one effective draw per walker is enough, since
    differential evolution would make fewer in the same number of passes.  If differential evolution
    is `hopeless` (see `is_hopeless`), two are required, because sampling would otherwise take more
    than about a minute.
    """
    if n_params <= MANY:
        return ess >= DRAWS_PER_WALKER.value * walkers
    return ess >= (2.0 if hopeless else 1.0) * walkers


def is_hopeless(n_params: int, n_stars: int, ensembles: int) -> bool:
    """True if differential evolution would be too slow to replace Crank-Nicolson moves.

    It decorrelates within three steps per parameter.  It has two walkers per parameter, each of
    which needs five effective draws and an equally long warm-up.
    """
    steps = 2 * DRAWS_PER_WALKER.value * 3 * n_params
    work = ensembles * 2 * (n_params + 1) * steps * n_stars
    return n_params > MANY and work > MOST_WORK


def is_too_slow(verdict: Convergence, made: int, most: int) -> bool:
    """True if the criteria cannot be met within `most` steps, as estimated after `made` steps.

    The rate of effective draws increases while the walkers forget their starting points.  It is
    therefore checked only after a quarter of the steps, and a run ends only if the rate is at least
    five times too low.
    """
    ess = min(verdict.ess_bulk_min, verdict.ess_tail_min)
    return made >= most * JUDGED_AFTER and ess * most / made < verdict.limits.ess / TOO_SLOW


# -- independence moves: sizes --------------------------------------------------------------------


def _worth(n_stars: int) -> int:
    """Number of passes that take about as long as one convergence check."""
    return int(min(WORTH // max(n_stars, 1), MOST_PILOT))


def walkers_for(n_stars: int) -> int:
    """Number of walkers per ensemble for independence moves.

    There are many walkers if a pass is cheap, to reduce the overhead of emcee's loop, and few if it
    is expensive, because each walker needs a start, a warm-up and five effective draws.
    """
    return int(np.clip(_worth(n_stars) // 64, FEWEST_WALKERS, MOST_WALKERS))


def pilot_steps(ensembles: int, walkers: int) -> int:
    """Number of steps for which the pilot provides proposals, not counting the starting points."""
    return max(15, -(-PILOT // (ensembles * walkers)) - 1)


@dataclass(frozen=True)
class StepRange:
    """Range of steps from `begin` to `end`; `full` is the end without the limit `max_steps`."""

    begin: int
    end: int
    full: int


def block_schedule(pilot: int, every: int, max_steps: int, n_stars: int) -> Iterator[StepRange]:
    """Yield the blocks of steps for independence moves.

    The pilot, of `pilot` steps, is divided into blocks of at most `every` steps.  Later blocks are
    1/8 (expensive passes) or 1/4 (cheap passes) of the number of steps so far, but at most `every`.
    The schedule does not depend on the convergence criteria.
    """
    growth = 1 / 8 if n_stars > DEAR else 1 / 4
    begin = 0
    while begin < max_steps:
        step = pilot - begin if begin < pilot else int(np.ceil(growth * begin))
        full = begin + min(step, every)
        yield StepRange(begin, min(full, max_steps), full)
        begin = full


# -- independence moves: when to check convergence ------------------------------------------------


def _chance_rhat(limits: Limits, n_params: int, ensembles: int) -> float:
    """Number of independent draws for which the R-hat of all parameters is below its limit.

    With c split chains of n draws, R-hat - 1 is distributed as (chi2_(c-1) / (c-1) - 1) / 2n.
    """
    chains = 2 * ensembles
    worst = float(chi2_isf(1 / (2 * n_params), chains - 1)) / (chains - 1)
    return chains * (worst - 1) / 2 / max(limits.rhat - 1, 1e-6)


def first_check(limits: Limits, cost: float, n_params: int, ensembles: int, walkers: int) -> float:
    """Number of draws after warm-up at the first check.

    `cost` is the number of draws per effective draw.  `n_params` and `ensembles` are numbers of
    parameters and of ensembles, and `walkers` is the number of walkers per ensemble.
    """
    slack = 1.05 + 3 / np.sqrt(max(limits.ess, 1.0))  # allows for the scatter of estimated ESS
    return max(
        slack * cost * limits.ess,
        1.1 * cost * DRAWS_PER_WALKER.value * ensembles * walkers,
        0.7 * cost * _chance_rhat(limits, n_params, ensembles),
    )


def next_check(made: int, verdict: Convergence, n_stars: int, walkers: int) -> float:
    """Number of draws at the next check, from the last diagnostics and their criteria, `verdict`.

    `made` is the number of draws at the last check, and `walkers` the total number of walkers of
    all ensembles.
    """
    ess = max(min(verdict.ess_bulk_min, verdict.ess_tail_min), 1e-3)
    lacking = max(
        verdict.limits.ess / ess,
        DRAWS_PER_WALKER.value * walkers / ess,
        (verdict.rhat_max - 1) / max(verdict.limits.rhat - 1, 1e-6),
    )
    # slightly early, because another check is cheaper than unnecessary passes
    return max(made + _worth(n_stars), min(0.85 * lacking, 2.0) * made)


def expected_passes(n_params: int, n_stars: int, limits: Limits, ensembles: int = 4) -> int:
    """Expected number of passes of a run with a good proposal, including pilot and warm-up.

    A pass is the evaluation of one proposal for all stars.
    """
    walkers = walkers_for(n_stars)
    draws = first_check(limits, 1.1, n_params, ensembles, walkers)
    draws = max(draws, 1.1 * _chance_rhat(limits, n_params, ensembles))
    pilot = ensembles * walkers * (pilot_steps(ensembles, walkers) + 1)
    return int(max(pilot, draws + 3 * ensembles * walkers))


# -- state-dependent moves ------------------------------------------------------------------------


def doubling_schedule(begin: int, every: int, max_steps: int, thin: int = 1) -> Iterator[StepRange]:
    """Yield blocks that end 50, 100, 200, ... steps after `begin`, then every `every` steps.

    The number of steps of each block is a multiple of `thin`; the last block ends at or before
    `max_steps`.
    """
    last, n_done = (max_steps - begin) // thin * thin, 0
    while n_done < last:
        step = min(max(n_done, FIRST_CHECK), every)
        end = min(n_done + step + -step % thin, last)
        yield StepRange(begin + n_done, begin + end, begin + end)
        n_done = end
