"""Gibbs sampler for a trend, the scatter of the exposures about it, and outlying exposures.

    y_e = H(t_e) b + deviation,    deviation ~ N(0, w_e (S_e + Sigma)),    w_e = 1 or kappa^2

S_e is the formal and Sigma the intrinsic covariance.  An exposure is an outlier (w_e = kappa^2)
with probability f.  All quantities are in units of the spread of the series.  The priors are
proper:

    b        Gaussian with standard deviation `WIDE`, which is flat compared with any data
    Sigma    half-Student-t standard deviations and uniform correlations; see scatter.py
    f        Beta(1, 9), truncated at 0.25
    kappa    at least 3; inverse gamma on kappa^2 with shape 1 and the mode of log kappa at log 5
    drift    half-Student-t standard deviation of each coefficient, two degrees of freedom
    breaks   uniform in time; see breaks.py

A sweep draws the memberships with the deviations integrated out, then f and kappa conditional on
the memberships.  It continues with the breaks (b and deviations integrated out), b (deviations
integrated out), the amplitude of the drift, the deviations, and Sigma conditional on the
deviations.  If formal errors are large, Sigma conditional on the deviations moves slowly.
Therefore deviations and Sigma are first moved together by shears and scalings that leave the
posterior invariant (Liu and Sabatti 2000, Biometrika 87, 353).

Many chains run in parallel.  Exposures can be excluded from individual chains, which gives exact
posteriors without them.
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

DRIFT_NU, DRIFT_SCALE = 2.0, 1.0  # prior of the drift's amplitude: degrees of freedom, scale
N_DRIFT_MOVES = 2  # number of amplitudes per sweep that are moved with b integrated out


def sweep(
    problem: Problem,
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
    problem: Problem,
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
    problem: Problem, state: State, included: Float, rng: np.random.Generator
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
    problem: Problem, state: State, precision: Float, included: Float, rng: np.random.Generator
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
    problem: Problem, matrix: Float, right: Float, drift: Float, rng: np.random.Generator
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
    problem: Problem, state: State, columns: Float, precision: Float, rng: np.random.Generator
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
