"""emcee's ensembles: the stock stretch move with plain numpy, and DEMove with the fused kernel.

One effective sample costs tau evaluations.  The seconds of a step are measured with the density in
question.  tau belongs to the move and the posterior, whoever evaluates it: where the plain density
would take hours to reach 50 tau, the same move is run on the library's evaluation of the same
density (their difference is measured), and where even that is too short, tau is taken from fewer
stars.  Both are flagged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import emcee
import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.effective import LONG_ENOUGH, Tau, autocorrelation
from tests.benchmarks.plain import PlainDensity
from tests.benchmarks.problem import Problem
from tests.benchmarks.timing import Deadline

__all__ = ["Ensemble", "White", "differential_evolution", "run_ensemble", "stock"]

Float = NDArray[np.float64]

BURN_IN = 0.2  # share of a chain that is dropped


@dataclass(frozen=True, eq=False)
class White:
    """Linear coordinates in which the posterior has mean zero and unit covariance."""

    centre: Float
    root: Float

    @classmethod
    def of(cls, draws: Float) -> White:
        """From posterior draws (chains, n, D)."""
        flat = draws.reshape(-1, draws.shape[-1])
        return cls(flat.mean(axis=0), np.linalg.cholesky(np.cov(flat, rowvar=False)))

    def to_psi(self, w: Float) -> Float:
        """Sampled coordinates (n, D)."""
        return self.centre + w @ self.root.T


@dataclass(frozen=True, eq=False)
class Ensemble:
    """A chain after burn-in, and what its steps cost.

    Parameters
    ----------
    chain : ndarray, shape (rows, walkers, D)
    thin : int
        Steps between two rows.
    steps : int
        Burn-in included.
    seconds : float
    """

    chain: Float
    thin: int
    steps: int
    seconds: float

    @property
    def seconds_per_step(self) -> float:
        """Mean over the run."""
        return self.seconds / self.steps


def run_ensemble(
    log_density: Callable[[Float], Any],
    start: Float,
    density: Float,
    move: emcee.moves.Move,
    *,
    vectorize: bool,
    rows: int,
    thin: int,
    seconds: float,
    seed: int,
) -> Ensemble:
    """Run emcee until it has made so many rows or the time is up.

    Parameters
    ----------
    log_density : callable
    start : ndarray, shape (walkers, D)
    density : ndarray, shape (walkers,)
        Log density there: evaluated before the clock starts, which touches everything once.
    move : emcee.moves.Move
    vectorize : bool
    rows, thin : int
    seconds : float
    seed : int

    Returns
    -------
    Ensemble
    """
    sampler = emcee.EnsembleSampler(*start.shape, log_density, moves=move, vectorize=vectorize)
    state = emcee.State(start, log_prob=density)
    state.random_state = np.random.RandomState(seed).get_state()
    limit = Deadline(seconds)
    for _ in sampler.sample(state, iterations=rows, thin_by=thin):
        if limit.over:
            break
    made = sampler.iteration
    elapsed = limit.elapsed
    kept = sampler.backend.chain[:made][int(BURN_IN * made) :]
    return Ensemble(kept, thin, made * thin, elapsed)


def _ball(problem: Problem, walkers: int, rng: np.random.Generator) -> Float:
    """Walkers around the linear fit: formal sigmas, and tenths for the hyperparameters.

    Wider than users take it, which spares the chain the time to grow.
    """
    centre = problem.truth
    centre[: problem.model.n_params] = problem.fit.mean
    width = np.concatenate([problem.fit.sigma, np.full(problem.dim - problem.fit.mean.size, 0.1)])
    return centre + width * rng.standard_normal((walkers, problem.dim))


def _row(tau: Tau, n: int, walkers: int, step_s: float, what: str) -> dict[str, Any]:
    """Rates that follow from the autocorrelation time, and what was extrapolated."""
    flags = []
    if tau.n_stars != n:
        flags.append(f"tau from N = {tau.n_stars:,}")
    if not tau.long_enough:
        flags.append(f"chain of {tau.lengths:.0f} < {LONG_ENOUGH} tau: extrapolated")
    return {
        "tau_bulk": tau.bulk,
        "tau_tail": tau.tail,
        "tau_lengths": tau.lengths,
        "walkers": walkers,
        "seconds_per_step": step_s,
        "rate": walkers / tau.worst / step_s,
        "per_pass": 1 / tau.worst,
        "setting": what,
        "flags": flags,
    }


def _better(tau: Tau | None, other: Tau | None) -> Tau:
    """The one of the chain that is longer in its own autocorrelation times."""
    known = [t for t in (tau, other) if t is not None]
    return max(known, key=lambda t: (t.long_enough, t.lengths if not t.long_enough else t.n_stars))


def stock(
    problem: Problem, known: Tau | None, *, plain_s: float, chain_s: float, rows: int, thin: int
) -> tuple[dict[str, Any], Tau, Float | None]:
    """emcee as users run it: StretchMove, numpy, 2 D + 2 walkers, one process.

    Parameters
    ----------
    problem : Problem
    known : Tau or None
        Of fewer stars.
    plain_s : float
        Seconds for the plain chain, which gives the seconds per step.
    chain_s : float
        Seconds for the chain of the same move that gives tau; 0 for none.
    rows, thin : int
        Most rows of that chain.

    Returns
    -------
    row : dict
    tau : Tau
    draws : ndarray (rows, walkers, D) or None
    """
    walkers = 2 * problem.dim + 2
    rng = np.random.default_rng(1)
    start = _ball(problem, walkers, rng)
    density, fast = PlainDensity(problem), problem.log_density(start)
    apart = np.array([density(point) for point in start[:6]]) - fast[:6]
    plain = run_ensemble(
        density,
        start,
        fast + apart[0],  # of a million stars each evaluation takes a tenth of a second
        emcee.moves.StretchMove(),
        vectorize=False,
        rows=rows,
        thin=1,
        seconds=plain_s,
        seed=1,
    )
    own = autocorrelation(plain.chain, 1, len(problem)) if len(plain.chain) >= 100 else None
    tau, draws = None, None
    if chain_s:
        run = run_ensemble(
            problem.log_density,
            start,
            fast,
            emcee.moves.StretchMove(),
            vectorize=True,
            rows=rows,
            thin=thin,
            seconds=chain_s,
            seed=2,
        )
        tau, draws = autocorrelation(run.chain, thin, len(problem)), run.chain
    tau = _better(tau, known if known is not None else own)
    row = _row(tau, len(problem), walkers, plain.seconds_per_step, "numpy, Legendre, stretch move")
    row |= {
        "plain_steps": plain.steps,
        "plain_tau": None if own is None else own.worst,
        "seconds": plain.seconds,
        "density_difference": np.ptp(apart),
    }
    return row, tau, draws


def differential_evolution(
    problem: Problem, white: White, known: Tau | None, *, seconds: float, rows: int, thin: int
) -> tuple[dict[str, Any], Tau, Float]:
    """emcee's DEMove on the fused kernel, in whitened coordinates; parameters as for `stock`."""
    walkers = 2 * problem.dim + 2
    start = np.random.default_rng(3).standard_normal((walkers, problem.dim))
    run = run_ensemble(
        lambda w: problem.log_density(white.to_psi(w)),
        start,
        problem.log_density(white.to_psi(start)),
        emcee.moves.DEMove(),
        vectorize=True,
        rows=rows,
        thin=thin,
        seconds=seconds,
        seed=3,
    )
    flat = white.to_psi(run.chain.reshape(-1, problem.dim)).reshape(run.chain.shape)
    own = autocorrelation(flat, thin, len(problem)) if len(flat) >= 100 else None
    tau = _better(own, known)
    row = _row(tau, len(problem), walkers, run.seconds_per_step, "kernel, whitened, DEMove")
    return row | {"seconds": run.seconds, "steps": run.steps}, tau, flat
