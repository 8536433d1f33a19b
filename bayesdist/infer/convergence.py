"""Convergence diagnostics, computed over independent ensembles rather than over coupled walkers.

Chains have the shape (chains, draws, parameters) = (C, N, D).  Each chain is split into halves,
which are compared like separate chains.  R-hat and effective sample sizes equal those of ArviZ,
which computes them one parameter at a time.  A parameter with a NaN among its draws gets NaN.

Differential evolution couples the walkers of an ensemble.  In that case the effective sample size
is the smaller of two estimates: that of the concatenated walkers, and that of the ensemble
averages, which reveals a drift common to all walkers (Goodman and Weare 2010, section 5).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import logsumexp, ndtri

from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import DRAWS_PER_WALKER
from bayesdist.utils.text import count

TAIL = (0.05, 0.95)  # the tail ESS is the effective sample size of these quantiles
MIN_WEIGHTS = 25  # fewest importance weights; the Pareto tail is fitted to a fifth of them
DIAGNOSTICS = ("rhat", "ess_bulk", "ess_tail", "mcse_mean", "mcse_sd")

FEWEST = 4  # draws per chain needed to compare its halves
AT_ONCE = 2**18  # draws (of several parameters) that are transformed together, to fit the cache


@dataclass(frozen=True)
class Limits:
    """Convergence criteria.

    Parameters
    ----------
    ess : float
        Smallest bulk and tail effective sample size allowed for any parameter.
    rhat : float
        Largest rank-normalised split R-hat allowed for any parameter.
    """

    ess: float = 400.0
    rhat: float = 1.01


@dataclass(frozen=True, eq=False)
class Convergence:
    """Convergence diagnostics of all sampled parameters, and whether the criteria are met.

    Parameters
    ----------
    names : tuple of str
        Names of the D parameters: theta, then the hyperparameters in sampled coordinates.
    rhat, ess_bulk, ess_tail, mcse_mean, mcse_sd : ndarray, shape (D,)
        R-hat, bulk and tail effective sample sizes, and Monte-Carlo standard errors of the mean
        and of the standard deviation. NaN for fixed parameters, which the criteria ignore.
    pareto_k : float
        Pareto shape of the importance weights of the independence proposal (Vehtari et al. 2024).
    importance_efficiency : float
        Effective sample size of the proposal's draws as a fraction of their number.
    converged : bool
        True if all criteria are met.
    reasons : tuple of str
        One sentence per failed criterion, naming the worst parameter; empty if converged.
    limits : Limits
        The criteria that were applied.
    """

    names: tuple[str, ...]
    rhat: Float
    ess_bulk: Float
    ess_tail: Float
    mcse_mean: Float
    mcse_sd: Float
    pareto_k: float
    importance_efficiency: float
    converged: bool
    reasons: tuple[str, ...]
    limits: Limits

    @property
    def rhat_max(self) -> float:
        """Largest R-hat."""
        return float(np.nanmax(self.rhat))

    @property
    def ess_bulk_min(self) -> float:
        """Smallest bulk effective sample size."""
        return float(np.nanmin(self.ess_bulk))

    @property
    def ess_tail_min(self) -> float:
        """Smallest tail effective sample size."""
        return float(np.nanmin(self.ess_tail))

    def worst(self, n: int) -> tuple[str, ...]:
        """Names of the `n` parameters that are farthest from meeting the criteria, worst first."""
        ess = np.minimum(self.ess_bulk, self.ess_tail)
        lacking = np.maximum(
            (self.rhat - 1) / max(self.limits.rhat - 1, 1e-6),
            self.limits.ess / np.maximum(ess, 1e-3),
        )
        return tuple(self.names[k] for k in np.argsort(-lacking)[:n])

    def among(self, names: tuple[str, ...]) -> Convergence:
        """Diagnostics extended to `names`; the parameters that are added are fixed (NaN)."""
        at = [names.index(name) for name in self.names]

        def spread(values: Float) -> Float:
            out = np.full(len(names), np.nan)
            out[at] = values
            return out

        columns: dict[str, Any] = {name: spread(getattr(self, name)) for name in DIAGNOSTICS}
        return replace(self, names=names, **columns)


def diagnose(
    chains: Float,
    names: tuple[str, ...],
    log_weights: Float,
    limits: Limits,
    *,
    coupled: bool,
    n_outside: int = 0,
) -> Convergence:
    """Compute the convergence diagnostics of the draws after warm-up.

    `chains` has the shape (ensembles, steps, walkers, D).  `log_weights` (n,) are the log
    importance weights of independent proposals; `n_outside` is the number of further proposals
    outside the support, which have weight zero.  `coupled` is True if the walkers of an ensemble
    influence each other.
    """
    E, T, W, D = chains.shape
    in_time = chains.reshape(E, T * W, D)
    by_walker = np.swapaxes(chains, 1, 2).reshape(E, W * T, D)

    # a parameter that never moved has no variance: no effective draws, no agreement
    rhat, bulk = rhat_and_bulk_draws(in_time, W)
    rhat[~np.isfinite(rhat)] = np.inf
    tail = tail_draws(by_walker, TAIL)
    if coupled:
        low, high = np.quantile(in_time.reshape(-1, D), TAIL, axis=0)
        bulk = np.minimum(bulk, _coupled_ess(chains))
        for outside in (chains <= low, chains >= high):
            tail = np.minimum(tail, _coupled_ess(outside.astype(float)))
    frozen = np.ptp(in_time.reshape(-1, D), axis=0) == 0
    bulk[frozen | ~np.isfinite(bulk)] = 0.0
    tail[frozen | ~np.isfinite(tail)] = 0.0
    spread = in_time.reshape(-1, D).std(axis=0)
    squares = (by_walker - by_walker.reshape(-1, D).mean(axis=0)) ** 2
    ess_squares = np.maximum(mean_draws(squares), 1.0)
    with np.errstate(invalid="ignore", divide="ignore"):  # delta method
        mcse_sd = squares.reshape(-1, D).std(axis=0) / np.sqrt(ess_squares) / (2 * spread)
    reasons = []
    for label, values, bad, limit in (
        ("R-hat", rhat, rhat > limits.rhat, limits.rhat),
        ("bulk ESS", bulk, bulk < limits.ess, limits.ess),
        ("tail ESS", tail, tail < limits.ess, limits.ess),
    ):
        if bad.any():
            if label == "R-hat":
                k, side = int(np.argmax(values)), "at most"
                value, asked = f"{values[k]:.4f}", f"{limit:g}"
            else:
                k, side = int(np.argmin(values)), "at least"
                value, asked = count(np.floor(values[k])), count(limit)
            reasons.append(
                f"{label} of {names[k]} is {value} and must be {side} {asked}"
                f" ({int(bad.sum())} of {D} parameters)"
            )
    # the draws of a walker always count as at least one effective draw, even if it never moved:
    # a large number of walkers must not hide that the walkers do not mix
    each_walker = float(np.minimum(bulk, tail).min()) / (E * W)
    if not DRAWS_PER_WALKER.met_by(each_walker):
        k = int(np.argmin(np.minimum(bulk, tail)))
        reasons.append(
            f"a walker has made {each_walker:.2g} effective draws of {names[k]} and must have made "
            f"at least {DRAWS_PER_WALKER.value:g}"
        )
    return Convergence(
        names=names,
        rhat=rhat,
        ess_bulk=bulk,
        ess_tail=tail,
        mcse_mean=spread / np.sqrt(np.maximum(bulk, 1.0)),
        mcse_sd=np.nan_to_num(mcse_sd),
        pareto_k=pareto_k(log_weights),
        importance_efficiency=importance_efficiency(log_weights, n_outside),
        converged=not reasons,
        reasons=tuple(reasons),
        limits=limits,
    )


def _coupled_ess(chains: Float) -> Float:
    """Effective sample size (D,) of the mean if the walkers of an ensemble may move together."""
    D = chains.shape[-1]
    averages = chains.mean(axis=2)
    share = averages.reshape(-1, D).var(axis=0)
    total = chains.reshape(-1, D).var(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        ess = mean_draws(averages) * total / share
    return np.where(np.isfinite(ess), ess, 0.0)


def importance_efficiency(log_weights: Float, n_outside: int = 0) -> float:
    """Effective sample size of weighted draws, as a fraction of their number.

    `n_outside` is the number of further draws with weight zero.
    """
    if not len(log_weights):
        return 0.0
    weights = np.exp(log_weights - log_weights.max())
    return float(weights.sum() ** 2 / (weights**2).sum() / (len(weights) + n_outside))


def pareto_k(log_weights: Float) -> float:
    """Shape k of the Pareto tail of importance weights; above 0.7 they cannot be trusted.

    Returns 0 if no weight exceeds twice the mean: such weights have no tail, and a shape fitted to
    nearly equal weights would be meaningless.  Returns infinity if there are too few weights, and
    minus infinity if all weights are equal.
    """
    finite = log_weights[np.isfinite(log_weights)]
    if len(finite) < MIN_WEIGHTS or np.ptp(finite) < 1e-9:
        return float("-inf") if len(finite) >= MIN_WEIGHTS else float("inf")
    weights = np.exp(finite - finite.max())
    if weights.mean() > 0.5:
        return 0.0
    return _pareto_smoothed(finite, 1.0)[1]


def smoothed_weights(log_weights: Float, independent: float) -> tuple[Float, float]:
    """Pareto-smoothed importance weights (n,), normalised to a sum of 1, and their tail shape k.

    `independent` is the effective fraction of the draws.  Weights with k above 0.7 cannot be
    trusted.
    """
    smoothed, k = _pareto_smoothed(log_weights, independent)
    return np.exp(smoothed), k


def _pareto_smoothed(log_weights: Float, independent: float) -> tuple[Float, float]:
    """Pareto-smoothed, normalised log weights (n,), and the shape k of their tail.

    If no tail can be fitted, k is infinite and the weights are only normalised.
    """
    from arviz_stats.base import array_stats  # half a second

    try:
        with np.errstate(all="ignore"):  # draws of negligible weight
            # ArviZ takes log likelihoods; importance weights are their inverse
            smoothed, k = array_stats.psislw(-log_weights, r_eff=independent)
    except ValueError:  # equal weights in the tail, or too few
        return log_weights - logsumexp(log_weights), float("inf")
    return np.asarray(smoothed, float), float(k)


# -- R-hat and effective sample sizes of many parameters at once (Vehtari et al. 2021) -------------


def rhat_and_bulk_draws(chains: Float, walkers: int = 1) -> Float:
    """Rank-normalised split R-hat and bulk effective sample size (2, D) of chains (C, N, D).

    The N draws of a chain are ordered by step and, within a step, by walker; `walkers` is the
    number of walkers.  R-hat uses this order; it is the larger of the values for bulk and tails.
    The effective sample size is that of the mean of the normal scores, with the draws reordered
    walker by walker.
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
    """Effective sample size (D,) of the tails of chains (C, N, D).

    The effective sample size is computed for two quantiles, of probabilities `tails`; the smaller
    value is returned.
    """

    def smaller(some: Float) -> Float:
        limits = np.quantile(some, tails, axis=(1, 2))
        sides = [_effective(_halves((some <= q[:, None, None]).astype(float))) for q in limits]
        # comparisons with a NaN limit are False, as if the parameter had never moved
        return np.where(np.isnan(limits).any(axis=0), np.nan, np.min(sides, axis=0))

    return _by_parameters(smaller, chains)


def mean_draws(chains: Float) -> Float:
    """Effective sample size (D,) of the mean, from chains (C, N, D)."""
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
