"""R-hat and effective sample sizes of many parameters at once (Vehtari et al. 2021).

The numbers are those of ArviZ, which goes through parameter after parameter.  Chains are
(C, N, D): as many chains, draws and parameters.  Each is split into halves, which are compared as
if they were further chains.  NaN where a draw is.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import ndtri

from bayesdist.utils.arrays import Float

FEWEST = 4  # draws in a chain whose halves can be compared
AT_ONCE = 2**18  # draws of as many parameters as are transformed together fit into the cache


def rhat_and_bulk_draws(chains: Float, walkers: int = 1) -> Float:
    """Rank-normalised split R-hat and effective sample size of the bulk (2, D).

    A chain has the draws of all its walkers at one step after the other.  So R-hat goes through
    them: it is the larger one of bulk and tails.  The sample size, that of the normal scores' mean,
    goes through one walker after the other.
    """

    def both(some: Float) -> Float:
        halves = _halves(some)
        if some.shape[2] % 2:  # the middle draw is another one
            scores = _normal_scores(halves)
            by_walker = _normal_scores(_halves(_by_walker(some, walkers)))
        else:
            every = _normal_scores(some)
            scores, by_walker = _halves(every), _halves(_by_walker(every, walkers))
        folded = np.abs(halves - np.median(halves, axis=(1, 2), keepdims=True))
        rhat = np.maximum(_rhat(scores), _rhat(_normal_scores(folded)))
        return np.stack([rhat, _effective(by_walker)])

    return _by_parameters(both, chains, 2)


def tail_draws(chains: Float, tails: tuple[float, float]) -> Float:
    """Effective sample size (D,) of the tails: the smaller one of two quantiles."""

    def smaller(some: Float) -> Float:
        limits = np.quantile(some, tails, axis=(1, 2))
        sides = [_effective(_halves((some <= q[:, None, None]).astype(float))) for q in limits]
        # no draw lies beyond a limit that is not a number, as if none had ever moved
        return np.where(np.isnan(limits).any(axis=0), np.nan, np.min(sides, axis=0))

    return _by_parameters(smaller, chains)


def mean_draws(chains: Float) -> Float:
    """Effective sample size (D,) of the mean."""
    return _by_parameters(lambda some: _effective(_halves(some)), chains)


def _by_parameters(function: Callable[[Float], Float], chains: Float, *numbers: int) -> Float:
    """A function of (d, C, N) for all parameters, of which some are treated at once.

    NaN for fewer than `FEWEST` draws in a chain.  It returns as many `numbers` (n, d), or one (d,).
    """
    C, N, D = chains.shape
    if N < FEWEST:
        return np.full((*numbers, D), np.nan)
    step = max(AT_ONCE // (C * N), 1)
    chains = np.moveaxis(chains, 2, 0)
    with np.errstate(invalid="ignore", divide="ignore"):  # parameters that never moved
        parts = [
            function(np.ascontiguousarray(chains[k : k + step], float)) for k in range(0, D, step)
        ]
    return np.concatenate(parts, axis=-1)


def _halves(chains: Float) -> Float:
    """First and last half of each chain, (d, 2 C, N / 2), without a middle draw."""
    half = chains.shape[2] // 2
    return np.concatenate([chains[..., :half], chains[..., -half:]], axis=1)


def _by_walker(chains: Float, walkers: int) -> Float:
    """Draws of one walker after the other, (d, C, N), of those at one step after the other."""
    d, C, N = chains.shape
    return np.swapaxes(chains.reshape(d, C, N // walkers, walkers), 2, 3).reshape(d, C, N)


def _normal_scores(chains: Float) -> Float:
    """Normal quantiles of the ranks among all draws of a parameter (Blom 1958)."""
    from scipy.stats import rankdata  # takes half a second to import: not where nothing is sampled

    ranks = rankdata(chains.reshape(len(chains), -1), axis=1)
    return ndtri((ranks - 3 / 8) / (ranks.shape[1] + 1 / 4)).reshape(chains.shape)


def _rhat(chains: Float) -> Float:
    """R-hat (d,) of chains that are compared as they are."""
    N = chains.shape[2]
    between = chains.mean(axis=2).var(axis=1, ddof=1)
    within = chains.var(axis=2, ddof=1).mean(axis=1)
    return np.sqrt(between / within + (N - 1) / N)


def _effective(chains: Float) -> Float:
    """Effective sample size (d,) of the mean, from autocorrelations that Geyer's rules limit."""
    _, C, N = chains.shape
    means = chains.mean(axis=2, keepdims=True)
    size = next_fast_len(2 * N, real=True)
    spectrum = rfft(chains - means, size)
    power = (spectrum.real**2 + spectrum.imag**2).mean(axis=1)
    covariance = irfft(power, size)[:, :N] / N
    variance = covariance[:, 0]
    if C > 1:
        variance = variance + means[..., 0].var(axis=1, ddof=1)
    unexplained = covariance[:, :1] * N / (N - 1) - covariance
    correlation = 1 - unexplained / variance[:, None]
    correlation[:, 0] = 1.0
    # pairs of lags have positive sums up to the first one that has not
    n_pairs = max((N - 1) // 2, 1)
    even, odd = correlation[:, 0 : 2 * n_pairs : 2], correlation[:, 1 : 2 * n_pairs : 2]
    sums = even + odd
    ends = ~(sums > 0)
    ends[:, -1] = True
    end = ends.argmax(axis=1)[:, None]
    # and do not rise
    falling = np.minimum.accumulate(sums, axis=1)
    total = np.where(np.arange(n_pairs) < end, falling, 0.0).sum(axis=1)
    last = np.take_along_axis(even, end, axis=1)[:, 0]
    last[(last < 0) & (np.take_along_axis(sums, end, axis=1)[:, 0] < 0)] = 0.0
    time = np.maximum(2 * total + last - 1, 1 / np.log10(C * N))
    time[np.isnan(variance)] = np.nan
    return np.where(np.ptp(chains, axis=(1, 2)) == 0, 1.0, 1 / time) * (C * N)
