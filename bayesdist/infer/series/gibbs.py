"""Draws of a trend, of the scatter about it, and of the exposures that lie off it.

    y_e = H(t_e) b + deviation,    deviation ~ N(0, w_e (S_e + Sigma)),    w_e = 1 or kappa^2

with S_e the formal covariance, Sigma the intrinsic one.  An exposure is an outlier (w_e = kappa^2)
with probability f.  Everything is in units of the series' spread.  Priors, all proper:

    b        Gaussian of standard deviation `WIDE`: flat compared with any data
    Sigma    half-Student-t standard deviations, uniform correlations: see scatter.py
    f        Beta(1, 9), cut off at 0.25: outliers are the exception
    kappa    at least 3; inverse gamma on kappa^2, shape 1, most probable log kappa at log 5
    drift    half-Student-t standard deviation of each coefficient, two degrees of freedom
    breaks   uniform in time: see breaks.py

A sweep draws the memberships with the deviations integrated out, f and kappa given them; then the
breaks with b and the deviations integrated out, b with the deviations integrated out, the drift's
amplitude, the deviations, and Sigma given them.  Before Sigma is drawn, deviations and Sigma are
sheared and stretched together, which leaves the posterior as it is (Liu and Sabatti 2000,
Biometrika 87, 353): given the deviations alone Sigma moves slowly where formal errors are large.
Many chains run in parallel; some exposures may be held out of some of them, which gives exact
refits without one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import betainc, betaincinv, gammainc, gammaincinv

from bayesdist.infer.kernel import densities, draw_deviations, gaussians, precisions, shear
from bayesdist.infer.series.breaks import BreakMoves
from bayesdist.infer.series.problem import Problem, State, break_likelihood, trend_equations
from bayesdist.infer.series.scatter import (
    FRACTION_PRIOR,
    KAPPA_RATE,
    KAPPA_SHAPE,
    MAX_FRACTION,
    MIN_KAPPA,
    draw_scales,
    draw_scatter,
    scale_prior,
)
from bayesdist.utils.arrays import Float

DRIFT_NU, DRIFT_SCALE = 2.0, 1.0
N_DRIFT_MOVES = 2  # amplitudes that a sweep moves with all else of the trend integrated out


def sweep(
    problem: Problem,
    state: State,
    rng: np.random.Generator,
    *,
    included: Float | None = None,
    moves: BreakMoves | None = None,
    scan: bool = False,
) -> State:
    """State after one draw of everything.

    `included` (C, E) is 0 for exposures that a chain must not see, else 1; `moves` are those of
    breaks that are to be found.  With `scan` the breaks are drawn among all gaps, for warming up
    only.
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
    problem: Problem,
    state: State,
    precision: Float,
    rng: np.random.Generator,
    *,
    included: Float,
    moves: BreakMoves | None = None,
    scan: bool = False,
) -> State:
    """Breaks, parameters and amplitude of the trend given scatter and memberships.

    `precision` (C, k, k, E) is that of exposures that do not lie off.
    """
    weight = included / np.where(state.off, state.kappa2[:, None], 1.0)
    seen = precision * weight[:, None, None]
    breaks = state.breaks
    if moves is not None:
        likelihood = break_likelihood(problem, seen)
        breaks = (moves.scan if scan else moves.move)(breaks, likelihood, rng)
    columns = problem.columns(breaks)
    matrix, right = trend_equations(problem, seen, columns, state.drift)
    if problem.design.drift is not None:
        matrix, drift = _move_drift_alone(problem, matrix, right, state.drift, rng)
        state = replace(state, drift=drift)
    b = gaussians(matrix, right, rng.standard_normal(right.shape))[0]
    state = replace(state, b=b.reshape(state.b.shape), breaks=breaks)
    if problem.design.drift is not None:
        state = _move_drift(problem, state, columns, seen, rng)
    return state


def _draw_memberships(
    problem: Problem, state: State, included: Float, rng: np.random.Generator
) -> State:
    """Memberships given trend and scatter, then fraction and inflation given them."""
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
    # 1 / kappa^2 is gamma, cut off where kappa would be less than its smallest value
    below = np.maximum(gammainc(shape, rate / MIN_KAPPA**2), 1e-290)
    inverse = gammaincinv(shape, below * rng.uniform(1e-12, 1.0, len(below))) / rate
    kappa2_new = np.maximum(1 / np.maximum(inverse, 1e-300), MIN_KAPPA**2)
    return replace(state, off=off, probability=probability, fraction=fraction, kappa2=kappa2_new)


def _draw_sigma(
    problem: Problem, state: State, precision: Float, included: Float, rng: np.random.Generator
) -> State:
    """Intrinsic covariance given deviations, which are drawn from the residuals."""
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
    """Log density of the logarithms of amplitudes, up to a constant."""
    return np.asarray(np.log(drift) - 1.5 * np.log1p((drift / DRIFT_SCALE) ** 2 / 2))


def _move_drift_alone(
    problem: Problem, matrix: Float, right: Float, drift: Float, rng: np.random.Generator
) -> tuple[Float, Float]:
    """Amplitudes of the drift of some coefficients, with its parameters integrated out.

    Given its parameters an amplitude that the data hardly determine moves slowly; here it leaps.
    """
    n_chains, k = drift.shape
    n, p = problem.design.n_fixed, matrix.shape[1] // k
    chain, n_random = np.arange(n_chains), p - n

    def value(m: Float, d: Float) -> Float:
        evidence = gaussians(m, right, np.zeros_like(right))[1]
        return evidence + (_drift_prior(d) - n_random * np.log(d)).sum(axis=1)

    here = value(matrix, drift)
    for _ in range(min(k, N_DRIFT_MOVES)):
        j = rng.integers(k, size=n_chains)
        new = drift.copy()
        new[chain, j] *= np.exp(rng.standard_normal(n_chains))
        at = (j * p + n)[:, None] + np.arange(n_random)
        trial = matrix.copy()
        more = new[chain, j] ** -2 - drift[chain, j] ** -2
        trial[chain[:, None], at, at] += more[:, None]
        there = value(trial, new)
        taken = np.log(rng.random(n_chains)) < there - here
        matrix = np.where(taken[:, None, None], trial, matrix)
        drift = np.where(taken[:, None], new, drift)
        here = np.where(taken, there, here)
    return matrix, drift


def _move_drift(
    problem: Problem, state: State, columns: Float, precision: Float, rng: np.random.Generator
) -> State:
    """Amplitude of the drift, given its parameters and then by stretching them with it."""
    n = problem.design.n_fixed
    random = state.b[..., n:]
    shape = state.drift.shape
    scale = rng.gamma((DRIFT_NU + 1) / 2, size=shape)
    scale = scale / (DRIFT_NU / state.drift**2 + DRIFT_SCALE**-2)
    rate = DRIFT_NU * scale + 0.5 * (random**2).sum(axis=2)
    drift = np.sqrt(rate / rng.gamma((DRIFT_NU + random.shape[2]) / 2, size=shape))
    # the second move: the likelihood decides, where the first one would move slowly near zero
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
        taken = np.log(rng.random(len(b))) < odds
        factor = np.where(taken, factor, 1.0)
        residual[:, j] += np.where(taken[:, None], change, 0.0)
        moving[:, j] *= factor[:, None]
        b[:, j, n:] *= factor[:, None]
        drift[:, j] *= factor
    return replace(state, b=b, drift=drift)
