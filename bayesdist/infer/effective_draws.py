"""R-hat and effective sample sizes of chains (Vehtari et al. 2021, Bayesian Analysis 16, 667).

The values are those of ArviZ, whose import takes longer than a small posterior.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import rankdata

__all__ = ["bulk_draws", "mean_draws", "rank_rhat", "tail_draws"]

Float = NDArray[np.float64]

TAIL = (0.05, 0.95)  # quantiles whose effective sample sizes are those of the tails
MIN_DRAWS = 4  # of a chain
EQUAL = 1e-15  # range of values below which they are taken for equal


def rank_rhat(chains: Float) -> Float:
    """Rank-normalised split R-hat (D,), the larger one of bulk and tails, of chains (C, N, D)."""
    return _each(_rank_rhat, chains) if len(chains) > 1 else np.full(chains.shape[-1], np.nan)


def bulk_draws(chains: Float) -> Float:
    """Bulk effective sample sizes (D,) of chains (C, N, D)."""
    return _each(lambda values: _effective(_normal_scores(_split(values))), chains)


def tail_draws(chains: Float) -> Float:
    """Effective sample sizes (D,) of the 5 and 95 % quantiles, the smaller, of chains (C, N, D)."""

    def smaller(values: Float) -> float:
        limits = np.quantile(values, TAIL)
        return min(_effective(_split(values <= limit).astype(float)) for limit in limits)

    return _each(smaller, chains)


def mean_draws(chains: Float) -> Float:
    """Effective sample sizes (D,) of the means of chains (C, N, D)."""
    return _each(lambda values: _effective(_split(values)), chains)


def _each(function: Callable[[Float], float], chains: Float) -> Float:
    """Function of the chains (C, N) of each parameter; NaN for too few draws, or some that are."""
    found = np.full(chains.shape[-1], np.nan)
    if chains.shape[1] >= MIN_DRAWS:
        for k in np.flatnonzero(np.isfinite(chains).all(axis=(0, 1))):
            found[k] = function(np.ascontiguousarray(chains[..., k]))
    return found


def _split(values: Float) -> Float:
    """First and last halves (2 C, N / 2) of chains."""
    half = values.shape[1] // 2
    return np.concatenate([values[:, :half], values[:, -half:]])


def _normal_scores(values: Float) -> Float:
    """Normal quantiles of the ranks among all chains (Blom 1958)."""
    rank = rankdata(values).reshape(values.shape)
    return np.asarray(ndtri((rank - 0.375) / (values.size + 0.25)))


def _rank_rhat(values: Float) -> float:
    halves = _split(values)
    folded = np.abs(halves - np.median(halves))
    return max(_rhat(_normal_scores(halves)), _rhat(_normal_scores(folded)))


def _rhat(values: Float) -> float:
    """Root of the variance of all draws over that within chains (Gelman and Rubin 1992)."""
    n = values.shape[1]
    within = values.var(axis=1, ddof=1).mean()
    between = n * values.mean(axis=1).var(ddof=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return float(np.sqrt((between / within + n - 1) / n))


def _effective(values: Float) -> float:
    """Effective sample size of the mean: autocorrelations are summed as Geyer (1992) says.

    Sums of neighbouring lags are positive and fall, in theory; those from the first that is not
    positive on are noise, and none counts more than the one before it.
    """
    chains, n = values.shape
    if np.ptp(values) < EQUAL:
        return float(values.size)
    covariance = _autocovariance(values)
    within = covariance[0] * n / (n - 1)
    total = covariance[0] + (values.mean(axis=1).var(ddof=1) if chains > 1 else 0.0)
    rho = 1 - (within - covariance) / total
    rho[0] = 1.0
    pairs = rho[: n // 2 * 2].reshape(-1, 2).sum(axis=1)
    most = max((n - 3) // 2, 0)
    ended = np.flatnonzero(~(pairs[:most] > 0))
    used = int(ended[0]) if ended.size else most
    time = 2 * np.minimum.accumulate(pairs[:used]).sum() - 1
    if rho[2 * used] > 0 or pairs[used] >= 0:
        time += rho[2 * used]
    return float(values.size / max(time, 1 / np.log10(values.size)))


def _autocovariance(values: Float) -> Float:
    """Mean autocovariance (N,) of chains by lag."""
    n = values.shape[1]
    padded = scipy.fft.next_fast_len(2 * n, real=True)
    spectrum = scipy.fft.rfft(values - values.mean(axis=1, keepdims=True), n=padded, axis=1)
    power = (spectrum.real**2 + spectrum.imag**2).mean(axis=0)
    return np.asarray(scipy.fft.irfft(power, n=padded)[:n] / n)
