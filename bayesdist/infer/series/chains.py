"""Markov chains run in parallel: starting states, warm-up, and draws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.infer.convergence import Convergence, Limits, diagnose
from bayesdist.infer.kernel import precisions
from bayesdist.infer.series.breaks import BreakMoves
from bayesdist.infer.series.gibbs import draw_trend, sweep
from bayesdist.infer.series.problem import Problem, State, break_likelihood
from bayesdist.infer.series.scatter import FRACTION_PRIOR, KAPPA_RATE, MAX_FRACTION
from bayesdist.infer.series.series import MAD_TO_SIGMA
from bayesdist.utils.arrays import Float

ENSEMBLES = 4  # number of groups of chains that are compared to assess convergence
N_SCANS = 10  # number of warm-up sweeps in which breaks are drawn from all gaps
EQUAL_WEIGHTS = np.zeros(25)  # log importance weights, which a Gibbs sampler does not have


@dataclass(frozen=True, eq=False)
class Engine:
    """Problem and moves of a sweep, which are fixed after warm-up."""

    problem: Problem
    moves: BreakMoves | None

    def step(self, state: State, rng: np.random.Generator, included: Float | None = None) -> State:
        """Next state of all chains; see `sweep` for `included`."""
        return sweep(self.problem, state, rng, included=included, moves=self.moves)


@dataclass(frozen=True, eq=False)
class Draws:
    """Draws from T sweeps of C chains, in units of the spread of the series."""

    b: Float  # parameters (C, T, k, p) of the columns of the trend
    sigma: Float  # intrinsic covariance (C, T, k, k)
    fraction: Float  # fraction of outliers (C, T)
    kappa2: Float  # factor (C, T) on the covariance of outliers
    breaks: Float  # dates of breaks to be found (C, T, B)
    drift: Float  # amplitude (C, T, k) of the random part of the trend
    outlier_probability: Float  # mean outlier probability (E,) of the exposures

    def state(self, draws: slice) -> State:
        """Selected draws (of all chains, concatenated) as the state of as many chains.

        The state has no memberships.
        """

        def some(values: Float) -> Float:
            return values.reshape(self.fraction.size, *values.shape[2:])[draws]

        fraction = some(self.fraction)
        nothing = np.zeros((len(fraction), 0))
        return State(
            b=some(self.b),
            sigma=some(self.sigma),
            off=nothing.astype(bool),
            probability=nothing,
            fraction=fraction,
            kappa2=some(self.kappa2),
            breaks=some(self.breaks),
            drift=some(self.drift),
        )

    def judged(self, problem: Problem, limits: Limits) -> Convergence:
        """Convergence diagnostics of all reported quantities."""
        n_chains, n_steps = self.fraction.shape
        names = problem.series.coefficients
        k = len(names)
        design = problem.design
        parts = [self.b[..., : design.n_fixed].reshape(n_chains, n_steps, -1)]
        labels = [f"{c}, column {a + 1}" for c in names for a in range(design.n_fixed)]
        if problem.sigma is None:
            sd = np.sqrt(np.diagonal(self.sigma, axis1=2, axis2=3))
            correlation = self.sigma / sd[..., :, None] / sd[..., None, :]
            row, column = np.tril_indices(k, -1)
            parts += [np.log(sd), correlation[..., row, column]]
            labels += [f"scatter of {c}" for c in names]
            labels += [
                f"correlation of {names[i]} and {names[j]}"
                for i, j in zip(row, column, strict=True)
            ]
        if problem.outliers:
            parts += [self.fraction[..., None], np.log(self.kappa2)[..., None]]
            labels += ["fraction of outliers", "inflation of outliers"]
        if design.trend.find:
            parts.append(self.breaks)
            labels += [f"break {i + 1}" for i in range(design.trend.find)]
        if design.drift:
            parts.append(np.log(self.drift))
            labels += [f"drift of {c}" for c in names]
        values = np.concatenate(parts, axis=-1)
        chains = values.reshape(ENSEMBLES, n_chains // ENSEMBLES, n_steps, -1)
        return diagnose(
            np.swapaxes(chains, 1, 2), tuple(labels), EQUAL_WEIGHTS, limits, coupled=False
        )


def starting_state(
    problem: Problem, moves: BreakMoves | None, n_chains: int, rng: np.random.Generator
) -> State:
    """Starting states that are widely dispersed in the scatter and in the outliers.

    The scatter is estimated from differences between consecutive exposures, which are insensitive
    to breaks and slopes.
    """
    k, n = problem.y.shape
    order = np.argsort(problem.series.epoch, kind="stable")
    step = np.diff(problem.y[:, order], axis=1)
    scale = np.maximum(MAD_TO_SIGMA * np.median(np.abs(step), axis=1) / np.sqrt(2), 0.05)
    if problem.sigma is None:
        stretch = np.exp(0.5 * rng.standard_normal((n_chains, k)))
        sigma = np.eye(k) * (scale * stretch)[:, :, None] ** 2
    else:
        sigma = np.tile(problem.sigma, (n_chains, 1, 1))
    precision = precisions(problem.formal, sigma)
    breaks = np.zeros((n_chains, 0))
    if moves is not None:
        breaks = moves.start(n_chains, break_likelihood(problem, precision), rng)
    fraction = np.zeros(n_chains)
    if problem.outliers:
        fraction = np.clip(rng.beta(*FRACTION_PRIOR, size=n_chains), 1e-6, MAX_FRACTION)
    state = State(
        b=np.zeros((n_chains, k, problem.design.n_columns)),
        sigma=sigma,
        off=np.zeros((n_chains, n), bool),
        probability=np.zeros((n_chains, n)),
        fraction=fraction,
        kappa2=np.full(n_chains, KAPPA_RATE),
        breaks=breaks,
        drift=np.exp(rng.standard_normal((n_chains, k))),
    )
    return draw_trend(problem, state, precision, rng, included=np.ones((n_chains, n)))


def warm_up(
    problem: Problem, n_chains: int, sweeps: int, rng: np.random.Generator
) -> tuple[Engine, State]:
    """Run the warm-up; return the engine, with moves that are fixed from now on, and the state."""
    moves = BreakMoves(problem.design) if problem.design.trend.find else None
    state = starting_state(problem, moves, n_chains, rng)
    for t in range(sweeps):
        scan = moves is not None and t < N_SCANS
        state = sweep(problem, state, rng, moves=moves, scan=scan)
        if moves is not None and t + 1 == N_SCANS:
            moves.learn()
    return Engine(problem, moves), state


def run(
    problem: Problem,
    rng: np.random.Generator,
    *,
    chains: int,
    warmup: int,
    sweeps: int,
    most: int,
    limits: Limits,
) -> tuple[Engine, State, Draws, Convergence]:
    """Warm up, then sample until the convergence criteria are met.

    `warmup` is the number of sweeps of the warm-up and `sweeps` that of the first attempt.  Each
    further attempt has twice as many sweeps, but at most `most`; earlier attempts count as warm-up.
    """
    engine, state = warm_up(problem, chains, warmup, rng)
    while True:
        states: list[State] = []
        for _ in range(sweeps):
            state = engine.step(state, rng)
            states.append(state)
        draws = _collected(states)
        convergence = draws.judged(problem, limits)
        if convergence.converged or 2 * sweeps > most:
            return engine, state, draws, convergence
        sweeps *= 2


def _collected(states: list[State]) -> Draws:
    def stacked(name: str) -> Float:
        return np.stack([getattr(s, name) for s in states], axis=1)

    probability = np.mean([s.probability.mean(axis=0) for s in states], axis=0)
    names = ("b", "sigma", "fraction", "kappa2", "breaks", "drift")
    return Draws(**{n: stacked(n) for n in names}, outlier_probability=probability)
