"""R-hat and effective sample sizes of many parameters at once (Vehtari et al. 2021).

The results equal those of ArviZ, which computes them one parameter at a time.  Chains have the
shape (chains, draws, parameters) = (C, N, D).  Each chain is split into halves, which are compared
like separate chains.  A parameter with a NaN among its draws gets NaN.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import ndtri

from bayesdist.utils.arrays import Float

FEWEST = 4  # draws per chain needed to compare its halves
AT_ONCE = 2**18  # draws (of several parameters) that are transformed together, to fit the cache


def rhat_and_bulk_draws(chains: Float, walkers: int = 1) -> Float:
    """Rank-normalised split R-hat and bulk effective sample size, stacked to shape (2, D).

    The N draws of a chain are ordered by step and, within a step, by walker.  R-hat uses this
    order; it is the larger of the values for bulk and tails.  The effective sample size is that of
    the mean of the normal scores, with the draws reordered walker by walker.
    """

    def both(some: Float) -> Float:
        halves = _halves(some)
        if some.shape[2] % 2:  # the two orders drop different middle draws
            scores = _normal_scores(halves)
            by_walker = _normal_scores(_halves(_by_walker(some, walkers)))
        else:
            all_scores = _normal_scores(some)
            scores, by_walker = _halves(all_scores), _halves(_by_walker(all_scores, walkers))
        folded = np.abs(halves - np.median(halves, axis=(1, 2), keepdims=True))
        rhat = np.maximum(_rhat(scores), _rhat(_normal_scores(folded)))
        return np.stack([rhat, _effective(by_walker)])

    return _by_parameters(both, chains, 2)


def tail_draws(chains: Float, tails: tuple[float, float]) -> Float:
    """Effective sample size (D,) of the tails: the smaller value of the two `tails` quantiles."""

    def smaller(some: Float) -> Float:
        limits = np.quantile(some, tails, axis=(1, 2))
        sides = [_effective(_halves((some <= q[:, None, None]).astype(float))) for q in limits]
        # comparisons with a NaN limit are False, as if the parameter had never moved
        return np.where(np.isnan(limits).any(axis=0), np.nan, np.min(sides, axis=0))

    return _by_parameters(smaller, chains)


def mean_draws(chains: Float) -> Float:
    """Effective sample size (D,) of the mean."""
    return _by_parameters(lambda some: _effective(_halves(some)), chains)


def _by_parameters(function: Callable[[Float], Float], chains: Float, *numbers: int) -> Float:
    """Apply a function of draws (d, C, N) to all parameters, d of them at a time.

    The function returns an array (*numbers, d), and the results are joined to (*numbers, D).
    They are NaN if a chain has fewer than `FEWEST` draws.
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
    """First and last half of each chain, shape (d, 2 C, N // 2); a middle draw is dropped."""
    half = chains.shape[2] // 2
    return np.concatenate([chains[..., :half], chains[..., -half:]], axis=1)


def _by_walker(chains: Float, walkers: int) -> Float:
    """Draws (d, C, N) reordered from step by step to walker by walker."""
    d, C, N = chains.shape
    return np.swapaxes(chains.reshape(d, C, N // walkers, walkers), 2, 3).reshape(d, C, N)


def _normal_scores(chains: Float) -> Float:
    """Normal quantiles of the ranks among all draws of a parameter (Blom 1958)."""
    from scipy.stats import rankdata  # its import takes half a second, so only when needed

    ranks = rankdata(chains.reshape(len(chains), -1), axis=1)
    return ndtri((ranks - 3 / 8) / (ranks.shape[1] + 1 / 4)).reshape(chains.shape)


def _rhat(chains: Float) -> Float:
    """R-hat (d,) of chains, without splitting them or ranking their draws."""
    N = chains.shape[2]
    between = chains.mean(axis=2).var(axis=1, ddof=1)
    within = chains.var(axis=2, ddof=1).mean(axis=1)
    return np.sqrt(between / within + (N - 1) / N)


def _effective(chains: Float) -> Float:
    """Effective sample size (d,) of the mean; autocorrelations are truncated by Geyer's rules."""
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
    # initial positive sequence: sums over pairs of lags, up to the first that is not positive
    n_pairs = max((N - 1) // 2, 1)
    even, odd = correlation[:, 0 : 2 * n_pairs : 2], correlation[:, 1 : 2 * n_pairs : 2]
    sums = even + odd
    ends = ~(sums > 0)
    ends[:, -1] = True
    end = ends.argmax(axis=1)[:, None]
    # initial monotone sequence
    falling = np.minimum.accumulate(sums, axis=1)
    total = np.where(np.arange(n_pairs) < end, falling, 0.0).sum(axis=1)
    last = np.take_along_axis(even, end, axis=1)[:, 0]
    last[(last < 0) & (np.take_along_axis(sums, end, axis=1)[:, 0] < 0)] = 0.0
    time = np.maximum(2 * total + last - 1, 1 / np.log10(C * N))
    time[np.isnan(variance)] = np.nan
    return np.where(np.ptp(chains, axis=(1, 2)) == 0, 1.0, 1 / time) * (C * N)
