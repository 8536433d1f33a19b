"""Predictive densities of held-out exposures.

The exposures are divided into folds, and each fold is predicted from the others.  This is done with
importance weights for the draws of the complete series if the weights are reliable, otherwise by
sampling without the fold.  The chains of all such refits run in parallel, starting from the last
state for the complete series.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from bayesdist.infer.convergence import smoothed_weights
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.kernel import densities
from bayesdist.infer.series.posterior import SeriesPosterior
from bayesdist.infer.series.problem import State
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.limits import PARETO_K

# per fold that is sampled again: number of chains, of warm-up sweeps and of sweeps after these
CHAINS, WARMUP, SWEEPS = 6, 30, 60
CHAINS_AT_ONCE = 192  # largest number of chains in parallel
DRAWS_AT_ONCE = 1024  # number of posterior draws per block of the predictive densities
N_FOLDS = 30  # default number of folds


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Predictive densities of held-out exposures.

    Parameters
    ----------
    log_density : ndarray, shape (E,)
        Joint log predictive density of all k coefficients, in units of the spread.
    rank : ndarray, shape (E, k)
        Predictive probability of a value below the measured one; uniform if the trend is adequate.
    fold : ndarray of int, shape (E,)
        Number of the fold; exposures of a fold were held out together.
    mc_error : float
        Monte-Carlo standard error of the sum of `log_density`.
    """

    log_density: Float
    rank: Float
    fold: Int
    mc_error: float

    @property
    def total(self) -> float:
        """Sum of the log densities (score); larger values are better."""
        return float(self.log_density.sum())

    def covered(self, probability: float) -> Float:
        """Fraction of the measurements inside the central predictive interval.

        Parameters
        ----------
        probability : float
            Probability of the interval, between 0 and 1.

        Returns
        -------
        ndarray, shape (k,)
        """
        tail = (1 - probability) / 2
        return ((self.rank > tail) & (self.rank < 1 - tail)).mean(axis=0)


def exposure_folds(epoch: Float, groups: int = N_FOLDS) -> Int:
    """Assign exposures to folds in turn, in the order of their dates.

    Parameters
    ----------
    epoch : ndarray, shape (E,)
        Dates of the exposures.
    groups : int
        Number of folds, if there are enough exposures.

    Returns
    -------
    ndarray of int, shape (E,)
        Fold of each exposure.
    """
    out = np.empty(len(epoch), np.int64)
    out[np.argsort(epoch, kind="stable")] = np.arange(len(epoch)) % min(len(epoch), groups)
    return out


def block_folds(epoch: Float, breaks: tuple[float, ...], length: int) -> Int:
    """Divide exposures into blocks of consecutive exposures, at the longest gaps in time.

    Parameters
    ----------
    epoch : ndarray, shape (E,)
        Dates of the exposures.
    breaks : tuple of float
        Dates of given breaks, where blocks end. A segment with at least two exposures has several
        blocks.
    length : int
        Minimum number of exposures in a block, if the segments allow it.

    Returns
    -------
    ndarray of int, shape (E,)
        Block of each exposure.
    """
    order = np.argsort(epoch, kind="stable")
    t = epoch[order]
    n = len(t)
    cuts = {0, n, *(int(np.searchsorted(t, b)) for b in breaks)}
    for first, last in zip(sorted(cuts)[:-1], sorted(cuts)[1:], strict=True):
        min_length = min(length, (last - first) // 2)
        inner = sorted(range(first + 1, last), key=lambda i: t[i - 1] - t[i])
        for i in inner:
            below = max(c for c in cuts if c < i)
            above = min((c for c in cuts if c > i), default=n)
            if min_length and i in range(below + min_length, above - min_length + 1):
                cuts.add(i)
    out = np.empty(n, np.int64)
    out[order] = np.searchsorted(sorted(cuts), np.arange(n), side="right") - 1
    return out


@one_thread
def held_out(posterior: SeriesPosterior, fold: Int, *, seed: int = 1) -> HeldOut:
    """Predict the exposures of each fold from the other folds.

    The draws for the complete series are weighted by 1 / (density of the fold), with
    Pareto-smoothed weights (Vehtari, Gelman & Gabry 2017).  If the weights are unreliable (Pareto k
    above 0.7), the posterior is sampled again without the fold.

    Parameters
    ----------
    posterior : SeriesPosterior
        Posterior of the complete series.
    fold : ndarray of int, shape (E,)
        Fold of each exposure.
    seed : int
        Seed of the random numbers.

    Returns
    -------
    HeldOut
    """
    rng = np.random.default_rng([seed, 1])
    density, below = _of_all_draws(posterior)
    independent = min(1.0, posterior.convergence.ess_bulk_min / len(density))
    n, k = posterior.series.values.shape
    log_density, rank, error = np.zeros(n), np.zeros((n, k)), np.zeros(n)
    refitted = []
    for code in np.unique(fold):
        rows = fold == code
        weight, pareto_k = smoothed_weights(-density[:, rows].sum(axis=1), independent)
        if pareto_k > PARETO_K.value:
            refitted.append(code)
            continue
        top = density[:, rows].max(axis=0)
        each = np.exp(density[:, rows] - top)
        mean = weight @ each
        log_density[rows] = top + np.log(mean)
        error[rows] = np.sqrt(weight**2 @ (each / mean - 1) ** 2 / independent)
        rank[rows] = np.tensordot(weight, below[:, rows], 1)
    at_once = max(1, CHAINS_AT_ONCE // CHAINS)
    for start in range(0, len(refitted), at_once):
        codes = np.array(refitted[start : start + at_once])
        density, below = _without(posterior, fold, codes, rng)
        for i, code in enumerate(codes):
            rows = fold == code
            chains = density[i * CHAINS : (i + 1) * CHAINS, rows]
            top = chains.max(axis=0)
            each = np.exp(chains - top)
            log_density[rows] = top + np.log(each.mean(axis=0))
            error[rows] = each.std(axis=0, ddof=1) / each.mean(axis=0) / np.sqrt(CHAINS)
            rank[rows] = below[i * CHAINS : (i + 1) * CHAINS, rows].mean(axis=0)
    return HeldOut(log_density, rank, fold, float(np.sqrt((error**2).sum())))


def _of_all_draws(posterior: SeriesPosterior) -> tuple[Float, Float]:
    """Log density (n, E) and probability below the measured value (n, E, k) for all draws."""
    n_draws = posterior.raw.fraction.size
    pieces = [
        predictive(posterior, posterior.raw.state(slice(first, first + DRAWS_AT_ONCE)))
        for first in range(0, n_draws, DRAWS_AT_ONCE)
    ]
    return np.concatenate([p[0] for p in pieces]), np.concatenate([p[1] for p in pieces])


def _without(
    posterior: SeriesPosterior, fold: Int, codes: Int, rng: np.random.Generator
) -> tuple[Float, Float]:
    """Log density (C, E) and probability below the measured value (C, E, k) without some folds.

    They are averaged over the draws of each chain, with `CHAINS` chains per fold in `codes`.
    """
    engine, last = posterior.engine, posterior.last
    excluded = np.repeat(codes, CHAINS)
    included = (excluded[:, None] != fold).astype(float)
    state = last.take(rng.integers(0, len(last.fraction), len(excluded)))
    for _ in range(WARMUP):
        state = engine.step(state, rng, included)
    density = np.full(included.shape, -np.inf)
    below = np.zeros((*included.shape, posterior.series.n_coefficients))
    for _ in range(SWEEPS):
        state = engine.step(state, rng, included)
        log_density, probability = predictive(posterior, state)
        density = np.logaddexp(density, log_density)
        below += probability
    return density - np.log(SWEEPS), below / SWEEPS


def predictive(posterior: SeriesPosterior, state: State) -> tuple[Float, Float]:
    """Log density (C, E) and probability below the measured value (C, E, k) for a state."""
    problem = posterior.engine.problem
    columns = problem.columns(state.breaks)
    residual = problem.residual(state.b, columns)
    f, kappa2 = state.fraction, state.kappa2
    log_density = densities(problem.formal, state.sigma, residual, f, kappa2)[0]
    variance = np.diagonal(problem.formal).T + np.diagonal(state.sigma, axis1=1, axis2=2)[..., None]
    sd = np.sqrt(variance)
    good = ndtr(residual / sd)
    bad = ndtr(residual / sd / np.sqrt(kappa2)[:, None, None])
    f = f[:, None, None]
    return log_density, np.swapaxes((1 - f) * good + f * bad, 1, 2)
