"""Gibbs sampler of the trend of a series, the scatter of its exposures, and outlying exposures.

    y_e = H(t_e) b + deviation,    deviation ~ N(0, w_e (S_e + Sigma)),    w_e = 1 or kappa^2

S_e is the formal and Sigma the intrinsic covariance.  An exposure is an outlier (w_e = kappa^2)
with probability f.  All quantities are in units of the spread of the series.  The priors are
proper:

    b        Gaussian with standard deviation `WIDE`, which is flat compared with any data
    Sigma    half-Student-t standard deviations and uniform correlations (see below)
    f        Beta(1, 9), truncated at 0.25
    kappa    at least 3; inverse gamma on kappa^2 with shape 1 and the mode of log kappa at log 5
    drift    half-Student-t standard deviation of each coefficient, two degrees of freedom
    breaks   uniform in time (see below)

A sweep draws the memberships with the deviations integrated out, then f and kappa conditional on
the memberships.  It continues with the breaks (b and deviations integrated out), b (deviations
integrated out), the amplitude of the drift, the deviations, and Sigma conditional on the
deviations.  If formal errors are large, Sigma conditional on the deviations moves slowly.
Therefore deviations and Sigma are first moved together by shears and scalings that leave the
posterior invariant (Liu and Sabatti 2000, Biometrika 87, 353).

Many chains run in parallel.  Exposures can be excluded from individual chains, which gives exact
posteriors without them.

The prior of the date of a break is uniform over the span of the series, with a minimum number of
exposures in each segment.  A break may be anywhere between two consecutive exposures, so that a
candidate is a random date in one of these gaps.  A new date is selected from the current date and
several candidates from a fixed density, with weights of likelihood times prior divided by that
density.  Exchanging the current date with a candidate leaves the joint density unchanged, so that
the posterior is invariant (as in Tjelmeland 2004).

The prior of Sigma is the hierarchical inverse Wishart distribution of Huang and Wand (2013,
Bayesian Analysis 8, 439) with nu = 2.  The standard deviation of each coefficient has a
half-Student-t prior with two degrees of freedom and the scale `PRIOR_SCALE`, in units of the spread
of the series; each correlation is uniform.  Conditional on half-normal scales, the covariance is
inverse Wishart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import betainc, betaincinv, gammainc, gammaincinv

from bayesdist.infer.convergence import Convergence, Limits, diagnose
from bayesdist.infer.kernel import densities, draw_deviations, gaussians, precisions, shear
from bayesdist.kinds.campaign.series.problem import (
    WIDE,
    SeriesProblem,
    State,
    normal_equations,
    trend_equations,
)
from bayesdist.kinds.campaign.series.series import MAD_TO_SIGMA, MIN_EXPOSURES_FOUND
from bayesdist.kinds.campaign.series.trend import Design
from bayesdist.utils.arrays import Bool, Float, Int

ENSEMBLES = 4  # number of groups of chains that are compared to assess convergence
N_SCANS = 10  # number of warm-up sweeps in which breaks are drawn from all gaps
EQUAL_WEIGHTS = np.zeros(25)  # log importance weights, which a Gibbs sampler does not have

DRIFT_NU, DRIFT_SCALE = 2.0, 1.0  # prior of the drift's amplitude: degrees of freedom, scale
N_DRIFT_MOVES = 2  # number of amplitudes per sweep that are moved with b integrated out

CANDIDATES_AT_ONCE = 8  # number of candidate break dates that are evaluated at a time

# log marginal likelihood (C, M) of dates (C, M, B), up to a constant for each chain
Likelihood = Callable[[Float], Float]
CANDIDATES = 8  # number of candidates per move
FROM_PRIOR = 0.25  # fraction of the prior in the density of the candidates

NU = 2.0  # degrees of freedom of the prior on the standard deviations
PRIOR_SCALE = 1.0  # scale of this prior, in units of the spread
FRACTION_PRIOR = (1.0, 9.0)  # Beta prior of the fraction of outliers
MAX_FRACTION = 0.25  # largest fraction of outliers
MIN_KAPPA = 3.0  # smallest inflation of the errors of outliers
KAPPA_SHAPE = 1.0  # shape of the inverse-gamma prior on kappa^2
KAPPA_RATE = KAPPA_SHAPE * 5.0**2  # rate of this prior, which puts the mode of log kappa at log 5


@dataclass(frozen=True, eq=False)
class Engine:
    """Problem and moves of a sweep, which are fixed after warm-up."""

    problem: SeriesProblem
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

    def judged(self, problem: SeriesProblem, limits: Limits) -> Convergence:
        """Convergence diagnostics of all reported quantities, for the criteria `limits`."""
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
    problem: SeriesProblem, moves: BreakMoves | None, n_chains: int, rng: np.random.Generator
) -> State:
    """Starting states of the chains, widely dispersed in the scatter and in the outliers.

    `moves` are those of the break dates, or None for a trend without unknown breaks.  The scatter
    is estimated from differences between consecutive exposures, which are insensitive to breaks and
    slopes.
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
    problem: SeriesProblem, n_chains: int, sweeps: int, rng: np.random.Generator
) -> tuple[Engine, State]:
    """Run the warm-up of some chains; return the engine and the state.

    The moves of the engine are fixed from now on.
    """
    moves = BreakMoves(problem.design) if problem.design.trend.find else None
    state = starting_state(problem, moves, n_chains, rng)
    for t in range(sweeps):
        scan = moves is not None and t < N_SCANS
        state = sweep(problem, state, rng, moves=moves, scan=scan)
        if moves is not None and t + 1 == N_SCANS:
            moves.learn()
    return Engine(problem, moves), state


def run(
    problem: SeriesProblem,
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


# -- Gibbs sampler for a trend, the scatter of the exposures about it, and outlying exposures ------


def sweep(
    problem: SeriesProblem,
    state: State,
    rng: np.random.Generator,
    *,
    included: Float | None = None,
    moves: BreakMoves | None = None,
    scan: bool = False,
) -> State:
    """State after drawing all quantities once.

    `included` (C, E) is 0 for exposures that are excluded from a chain, otherwise 1.  `moves` are
    those of unknown breaks.  If `scan` is True, breaks are drawn from all gaps, which is valid
    during warm-up only.
    """
    if included is None:
        included = np.ones(state.off.shape)
    if problem.outliers:
        state = _draw_memberships(problem, state, included, rng)
    precision = precisions(problem.formal, state.sigma)
    state = draw_trend(problem, state, precision, rng, included=included, moves=moves, scan=scan)
    if problem.sigma is None:
        state = _draw_sigma(problem, state, precision, included, rng)
    return state


def draw_trend(
    problem: SeriesProblem,
    state: State,
    precision: Float,
    rng: np.random.Generator,
    *,
    included: Float,
    moves: BreakMoves | None = None,
    scan: bool = False,
) -> State:
    """Draw breaks, parameters and amplitude of the trend, given scatter and memberships.

    `precision` (C, k, k, E) is the inverse covariance of the exposures if they are not outliers.
    See `sweep` for the other arguments.
    """
    weight = included / np.where(state.off, state.kappa2[:, None], 1.0)
    weighted = precision * weight[:, None, None]
    breaks = state.breaks
    if moves is not None:
        likelihood = break_likelihood(problem, weighted)
        breaks = (moves.scan if scan else moves.move)(breaks, likelihood, rng)
    columns = problem.columns(breaks)
    matrix, right = trend_equations(problem, weighted, columns, state.drift)
    if problem.design.drift is not None:
        matrix, drift = _move_drift_alone(problem, matrix, right, state.drift, rng)
        state = replace(state, drift=drift)
    b = gaussians(matrix, right, rng.standard_normal(right.shape))[0]
    state = replace(state, b=b.reshape(state.b.shape), breaks=breaks)
    if problem.design.drift is not None:
        state = _move_drift(problem, state, columns, weighted, rng)
    return state


def _draw_memberships(
    problem: SeriesProblem, state: State, included: Float, rng: np.random.Generator
) -> State:
    """Draw memberships given trend and scatter, then fraction and inflation of the outliers."""
    k = len(problem.y)
    residual = problem.residual(state.b, problem.columns(state.breaks))
    _, distance, probability = densities(
        problem.formal, state.sigma, residual, state.fraction, state.kappa2
    )
    off = rng.random(probability.shape) < probability
    count = (off * included).sum(axis=1)
    a, b = FRACTION_PRIOR
    of_good = b + included.sum(axis=1) - count
    below = np.maximum(betainc(a + count, of_good, MAX_FRACTION), 1e-290)
    fraction = betaincinv(a + count, of_good, below * rng.uniform(1e-12, 1.0, len(below)))
    fraction = np.clip(fraction, 1e-12, MAX_FRACTION)
    shape = KAPPA_SHAPE + k * count / 2
    rate = KAPPA_RATE + (off * included * distance).sum(axis=1) / 2
    # 1 / kappa^2 has a gamma distribution, truncated at the smallest kappa
    below = np.maximum(gammainc(shape, rate / MIN_KAPPA**2), 1e-290)
    inverse = gammaincinv(shape, below * rng.uniform(1e-12, 1.0, len(below))) / rate
    kappa2_new = np.maximum(1 / np.maximum(inverse, 1e-300), MIN_KAPPA**2)
    return replace(state, off=off, probability=probability, fraction=fraction, kappa2=kappa2_new)


def _draw_sigma(
    problem: SeriesProblem,
    state: State,
    precision: Float,
    included: Float,
    rng: np.random.Generator,
) -> State:
    """Draw the deviations given the residuals, then the intrinsic covariance given these."""
    residual = problem.residual(state.b, problem.columns(state.breaks))
    residual /= np.where(state.off, np.sqrt(state.kappa2)[:, None], 1.0)[:, None]
    scale = draw_scales(state.sigma, rng)
    deviation = draw_deviations(state.sigma, problem.root, precision, residual, rng)
    if problem.inverse is not None:
        prior = scale_prior(scale.shape[1])
        deviation, scale = shear(
            deviation, residual, problem.inverse, state.sigma, scale, prior, included, rng
        )
    scatter = (deviation * included[:, None]) @ np.swapaxes(deviation, 1, 2)
    sigma = draw_scatter(scale, scatter, included.sum(axis=1), rng)
    return replace(state, sigma=sigma)


def _drift_prior(drift: Float) -> Float:
    """Log prior density of the logarithms of amplitudes, up to a constant."""
    return np.asarray(np.log(drift) - 1.5 * np.log1p((drift / DRIFT_SCALE) ** 2 / 2))


def _move_drift_alone(
    problem: SeriesProblem, matrix: Float, right: Float, drift: Float, rng: np.random.Generator
) -> tuple[Float, Float]:
    """Draw the drift's amplitude for some coefficients, with its parameters integrated out.

    Conditional on the parameters, an amplitude that the data hardly determine would move slowly.
    Returns the updated matrix and the amplitudes (C, k).
    """
    n_chains, k = drift.shape
    n, p = problem.design.n_fixed, matrix.shape[1] // k
    chain, n_random = np.arange(n_chains), p - n

    def value(m: Float, d: Float) -> Float:
        evidence = gaussians(m, right, np.zeros_like(right))[1]
        return evidence + (_drift_prior(d) - n_random * np.log(d)).sum(axis=1)

    log_density = value(matrix, drift)
    for _ in range(min(k, N_DRIFT_MOVES)):
        j = rng.integers(k, size=n_chains)
        new = drift.copy()
        new[chain, j] *= np.exp(rng.standard_normal(n_chains))
        at = (j * p + n)[:, None] + np.arange(n_random)
        trial = matrix.copy()
        change = new[chain, j] ** -2 - drift[chain, j] ** -2
        trial[chain[:, None], at, at] += change[:, None]
        new_log_density = value(trial, new)
        accepted = np.log(rng.random(n_chains)) < new_log_density - log_density
        matrix = np.where(accepted[:, None, None], trial, matrix)
        drift = np.where(accepted[:, None], new, drift)
        log_density = np.where(accepted, new_log_density, log_density)
    return matrix, drift


def _move_drift(
    problem: SeriesProblem, state: State, columns: Float, precision: Float, rng: np.random.Generator
) -> State:
    """Draw the drift's amplitude given its parameters, then scale both together."""
    n = problem.design.n_fixed
    random = state.b[..., n:]
    shape = state.drift.shape
    scale = rng.gamma((DRIFT_NU + 1) / 2, size=shape)
    scale = scale / (DRIFT_NU / state.drift**2 + DRIFT_SCALE**-2)
    rate = DRIFT_NU * scale + 0.5 * (random**2).sum(axis=2)
    drift = np.sqrt(rate / rng.gamma((DRIFT_NU + random.shape[2]) / 2, size=shape))
    # the second move is accepted by its likelihood; the first one would be slow near zero
    b = state.b.copy()
    moving = random @ np.swapaxes(columns[..., n:], -1, -2)
    residual = problem.residual(b, columns)
    for j in range(b.shape[1]):
        step = rng.standard_normal(len(b))
        factor = np.exp(step)
        change = (1 - factor)[:, None] * moving[:, j]
        pull = np.einsum("cje,cje->ce", precision[:, j], residual)
        gain = -(change * pull).sum(axis=1)
        gain -= 0.5 * (change**2 * precision[:, j, j]).sum(axis=1)
        new = drift[:, j] * factor
        odds = gain + _drift_prior(new) - _drift_prior(drift[:, j])
        accepted = np.log(rng.random(len(b))) < odds
        factor = np.where(accepted, factor, 1.0)
        residual[:, j] += np.where(accepted[:, None], change, 0.0)
        moving[:, j] *= factor[:, None]
        b[:, j, n:] *= factor[:, None]
        drift[:, j] *= factor
    return replace(state, b=b, drift=drift)


# -- sampling of unknown break dates, with the parameters of the trend integrated out --------------


def break_likelihood(problem: SeriesProblem, precision: Float) -> Likelihood:
    """Make a function of dates (C, M, B) that returns log likelihoods (C, M).

    The likelihoods are integrated over the coefficients b of the trend.  `precision` has the
    precision matrices of the exposures.
    """

    def some(breaks: Float) -> Float:
        columns = problem.columns(breaks)
        matrix, right = normal_equations(precision, problem.y, columns)
        matrix = matrix + WIDE**-2 * np.eye(matrix.shape[-1])
        flat = right.reshape(-1, right.shape[-1])
        square = matrix.reshape(len(flat), *matrix.shape[-2:])
        return gaussians(square, flat, np.zeros_like(flat))[1].reshape(right.shape[:-1])

    def of(breaks: Float) -> Float:
        # a few candidates at a time, because their columns would exceed the cache or the memory
        places = range(0, breaks.shape[1], CANDIDATES_AT_ONCE)
        return np.concatenate([some(breaks[:, i : i + CANDIDATES_AT_ONCE]) for i in places], axis=1)

    return of


class BreakMoves:
    """Moves of the break dates of a trend with unknown breaks."""

    def __init__(self, design: Design) -> None:
        self.count = design.trend.find
        self.dates = np.unique(design.series.epoch)
        self.epoch = np.sort(design.series.epoch)
        self.width = np.diff(self.dates)
        self.prior = self.width / self.width.sum()
        self.density = np.tile(self.prior, (self.count, 1))
        self._seen = np.zeros_like(self.density)

    def possible(self, breaks: Float) -> Bool:
        """Boolean mask (...) that is True for possible dates (..., B) of breaks.

        Dates must ascend, with enough exposures in each segment.
        """
        place = np.searchsorted(self.epoch, breaks)
        shape = (*breaks.shape[:-1], 1)
        edges = np.concatenate([np.zeros(shape, int), place, np.full(shape, len(self.epoch))], -1)
        return np.all(np.diff(edges, axis=-1) >= MIN_EXPOSURES_FOUND, axis=-1)

    def _at(self, gap: Int, rng: np.random.Generator) -> Float:
        return self.dates[gap] + self.width[gap] * rng.random(gap.shape)

    def start(self, n_chains: int, likelihood: Likelihood, rng: np.random.Generator) -> Float:
        """Starting dates (C, B) of the breaks, found by adding one break after the other."""
        breaks = np.zeros((n_chains, 0))
        for _ in range(self.count):
            gap = np.broadcast_to(np.arange(len(self.width)), (n_chains, len(self.width)))
            new = self._at(gap, rng)[..., None]
            old = np.broadcast_to(breaks[:, None], (*gap.shape, breaks.shape[1]))
            trial = np.sort(np.concatenate([old, new], axis=-1), axis=-1)
            weight = np.where(self.possible(trial), likelihood(trial), -np.inf)
            weight += np.log(self.prior)
            if not np.isfinite(weight).any(axis=1).all():
                # no room for another break: distribute all breaks evenly over the exposures
                places = np.linspace(0, len(self.dates) - 1, self.count + 2)[1:-1].astype(int)
                return np.tile(self._at(places, rng), (n_chains, 1))
            breaks = _pick(trial, weight, rng)
        return breaks

    def scan(self, breaks: Float, likelihood: Likelihood, rng: np.random.Generator) -> Float:
        """Draw new dates (C, B) from all gaps between exposures, one break after the other.

        `breaks` (C, B) are the current dates.  The probabilities of the gaps are stored.
        """
        for b in range(self.count):
            gap = np.broadcast_to(np.arange(len(self.width)), (len(breaks), len(self.width)))
            trial = self._trial(breaks, b, self._at(gap, rng))
            weight = np.where(self.possible(trial), likelihood(trial), -np.inf)
            weight = weight + np.log(self.prior)
            weight -= weight.max(axis=1, keepdims=True)
            probability = np.exp(weight) / np.exp(weight).sum(axis=1, keepdims=True)
            self._seen[b] += probability.mean(axis=0)
            breaks = _pick(trial, weight, rng)
        return breaks

    def learn(self) -> None:
        """Set the density of the candidates from the stored scans; it is fixed afterwards."""
        total = self._seen.sum(axis=1, keepdims=True)
        self.density = (1 - FROM_PRIOR) * self._seen / total + FROM_PRIOR * self.prior

    def move(self, breaks: Float, likelihood: Likelihood, rng: np.random.Generator) -> Float:
        """Select new dates (C, B) from current dates `breaks` and candidates, break by break."""
        n = len(breaks)
        for b in range(self.count):
            gap = rng.choice(len(self.width), size=(n, CANDIDATES), p=self.density[b])
            dates = np.concatenate([breaks[:, b : b + 1], self._at(gap, rng)], axis=1)
            trial = self._trial(breaks, b, dates)
            gap_index = np.searchsorted(self.dates, dates, side="right") - 1
            gap_index = np.clip(gap_index, 0, len(self.width) - 1)
            weight = np.where(self.possible(trial), likelihood(trial), -np.inf)
            weight = weight + np.log(self.prior[gap_index] / self.density[b][gap_index])
            breaks = _pick(trial, weight, rng)
        return breaks

    @staticmethod
    def _trial(breaks: Float, b: int, dates: Float) -> Float:
        trial = np.repeat(breaks[:, None], dates.shape[1], axis=1)
        trial[..., b] = dates
        return trial


def _pick(trial: Float, log_weight: Float, rng: np.random.Generator) -> Float:
    """Draw one of the M candidates (C, M, B) of each chain, with log weights (C, M)."""
    noise = rng.gumbel(size=log_weight.shape)
    best = np.argmax(log_weight + noise, axis=1)
    return trial[np.arange(len(trial)), best]


# -- intrinsic covariance of the exposures: its prior, and draws given the deviations --------------


def draw_scales(sigma: Float, rng: np.random.Generator) -> Float:
    """Draw the scales (C, k) of the prior, given covariances (C, k, k)."""
    diagonal = np.diagonal(np.linalg.inv(sigma), axis1=1, axis2=2)
    # 1 / a of Huang and Wand has a gamma distribution
    inverse_a = rng.gamma((NU + sigma.shape[-1]) / 2, size=diagonal.shape)
    return np.sqrt(2 * NU * inverse_a / (NU * diagonal + PRIOR_SCALE**-2))


def scale_prior(k: int) -> tuple[float, float]:
    """Prior variance of the scales, and degrees of freedom of the inverse Wishart prior.

    `k` is the number of coefficients per exposure.
    """
    return NU * PRIOR_SCALE**2, NU + k - 1


def draw_scatter(scale: Float, scatter: Float, count: Float, rng: np.random.Generator) -> Float:
    """Draw covariances (C, k, k) from their inverse Wishart distribution, given the deviations.

    `scale` (C, k) has the scales of the prior, and `scatter` (C, k, k) the sum of the outer
    products of `count` (C,) deviations.
    """
    n_chains, k = scale.shape
    psi = scatter + scale[:, :, None] ** 2 * np.eye(k)
    dof = scale_prior(k)[1] + count
    bartlett = np.zeros((n_chains, k, k))
    for i in range(k):
        bartlett[:, i, i] = np.sqrt(2 * rng.standard_gamma((dof - i) / 2))
        bartlett[:, i, :i] = rng.standard_normal((n_chains, i))
    # if A A' has a standard Wishart distribution and U U' = psi, U A'^-1 A^-1 U' is inverse Wishart
    half = np.linalg.cholesky(psi) @ np.linalg.inv(np.swapaxes(bartlett, 1, 2))
    return half @ np.swapaxes(half, 1, 2)
