"""R-hat and effective sample sizes of many parameters at a time (Vehtari et al. 2021).

The numbers of ArviZ, which computes them one parameter after another: of thousands of parameters
that took longer than the chains.  Chains are arrays (C, N, D); each is split into its halves.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import ndtri
from scipy.stats import rankdata

__all__ = ["ess_bulk", "ess_mean", "ess_tail", "rank_rhat"]

Float = NDArray[np.float64]

NUMBERS = 1_000_000  # of draws that are looked at at a time
BLOM = 3 / 8  # of ranks, in normal scores


def rank_rhat(chains: Float) -> Float:
    """Rank-normalised split R-hat (D,): the larger one of location and scale."""

    def of(halves: Float) -> Float:
        middle = np.median(halves, axis=(1, 2), keepdims=True)
        scores = _normal_scores(halves), _normal_scores(np.abs(halves - middle))
        return np.maximum(*map(_rhat, scores))

    return _by_parameters(of, chains)


def ess_bulk(chains: Float) -> Float:
    """Effective sample sizes (D,) of the rank-normalised draws."""
    return _by_parameters(lambda halves: _ess(_normal_scores(halves)), chains)


def ess_tail(chains: Float, prob: tuple[float, float]) -> Float:
    """Effective sample sizes (D,) of two quantiles, the smaller one of each parameter."""
    ends = np.quantile(chains, prob, axis=(0, 1))
    return np.minimum(*(ess_mean((chains <= end).astype(float)) for end in ends))


def ess_mean(chains: Float) -> Float:
    """Effective sample sizes (D,) of the mean."""
    return _by_parameters(_ess, chains)


def _by_parameters(function: Callable[[Float], Float], chains: Float) -> Float:
    """Values (D,) of a function of the halves (d, 2 C, N // 2) of chains, d of D at a time."""
    C, N, D = chains.shape
    half, step = N // 2, max(1, NUMBERS // (C * N))
    ends = np.concatenate([chains[:, :half], chains[:, N - half :]])
    parts = [ends[..., a : a + step].transpose(2, 0, 1) for a in range(0, D, step)]
    return np.concatenate([function(np.ascontiguousarray(part)) for part in parts])


def _normal_scores(halves: Float) -> Float:
    """Normal quantiles of the ranks of the draws of each parameter."""
    flat = halves.reshape(len(halves), -1)
    ranks = rankdata(flat, axis=1)
    return ndtri((ranks - BLOM) / (flat.shape[1] + 1 - 2 * BLOM)).reshape(halves.shape)


def _rhat(z: Float) -> Float:
    """Potential scale reduction (d,) of chains (d, C, n)."""
    n = z.shape[2]
    between = n * z.mean(axis=2).var(axis=1, ddof=1)
    within = z.var(axis=2, ddof=1).mean(axis=1)
    return np.asarray(np.sqrt((between / within + n - 1) / n))


def _ess(z: Float) -> Float:
    """Effective sample sizes (d,) of chains (d, C, n), by Geyer's initial monotone sequence."""
    _, C, n = z.shape
    means = z.mean(axis=2, keepdims=True)
    spectrum = rfft(z - means, next_fast_len(2 * n), axis=2)
    lagged = irfft(np.abs(spectrum) ** 2, next_fast_len(2 * n), axis=2)[..., :n].mean(axis=1) / n
    within = lagged[:, :1] * n / (n - 1)
    whole = lagged[:, :1] + (means[..., 0].var(axis=1, ddof=1)[:, None] if C > 1 else 0.0)
    rho = 1.0 - (within - lagged) / whole
    rho[:, 0] = 1.0
    # correlations of neighbouring lags add up to what is positive and falls
    last = max((n - 3) // 2, 0)
    even, odd = rho[:, 0 : 2 * last + 1 : 2], rho[:, 1 : 2 * last + 2 : 2]
    pairs = even + odd
    ended = np.cumsum(~(pairs[:, :last] > 0), axis=1) > 0
    falling = np.where(ended, 0.0, np.minimum.accumulate(pairs[:, :last], axis=1))
    rows, cut = np.arange(len(rho)), (~ended).sum(axis=1)
    rest = np.where((even > 0) | (pairs >= 0), even, 0.0)[rows, cut]
    tau = -1.0 + 2.0 * falling.sum(axis=1) + rest
    out = C * n / np.maximum(tau, 1 / np.log10(C * n))
    return np.where(np.ptp(z, axis=(1, 2)) < np.finfo(float).resolution, C * n, out)
