"""Convergence of the sampler, judged over independent ensembles, never over coupled walkers.

Differential evolution couples the walkers of an ensemble.  Then two estimates of the effective
sample size are made and the smaller counts: that of the walkers laid end to end, and that of the
ensemble averages, which shows a drift that all walkers share (Goodman and Weare 2010, section 5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import logsumexp

from bayesdist.infer.effective_draws import mean_draws, rhat_and_bulk_draws, tail_draws
from bayesdist.utils.arrays import Float
from bayesdist.utils.limits import DRAWS_PER_WALKER
from bayesdist.utils.numbers import count

TAIL = (0.05, 0.95)  # quantiles whose effective sample sizes are those of the tails
MIN_WEIGHTS = 25  # to a fifth of which a tail is fitted

DIAGNOSTICS = ("rhat", "ess_bulk", "ess_tail", "mcse_mean", "mcse_sd")


@dataclass(frozen=True)
class Limits:
    """Targets of a converged run.

    Parameters
    ----------
    ess : float
        Bulk and tail effective sample size of every parameter.
    rhat : float
        Rank-normalised split R-hat of every parameter.
    """

    ess: float = 400.0
    rhat: float = 1.01


@dataclass(frozen=True, eq=False)
class Convergence:
    """Diagnostics of every sampled parameter, and the verdict.

    Parameters
    ----------
    names : tuple of str
        theta, then the hyperparameters as sampled.
    rhat, ess_bulk, ess_tail, mcse_mean, mcse_sd : ndarray, shape (D,)
        NaN for fixed parameters, which are not judged.
    pareto_k : float
        Of the importance weights of the independence proposal (Vehtari et al. 2024).
    importance_efficiency : float
        Effective fraction of the proposal's draws.
    converged : bool
    reasons : tuple of str
        Failed criteria, with the worst parameter; empty when converged.
    limits : Limits
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
        """Names of the `n` parameters that are farthest from the limits."""
        ess = np.minimum(self.ess_bulk, self.ess_tail)
        lacking = np.maximum(
            (self.rhat - 1) / max(self.limits.rhat - 1, 1e-6),
            self.limits.ess / np.maximum(ess, 1e-3),
        )
        return tuple(self.names[k] for k in np.argsort(-lacking)[:n])

    def among(self, names: tuple[str, ...]) -> Convergence:
        """Convergence with further names, of parameters that are fixed and not judged."""
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
    """Diagnostics from the draws after warm-up: chains (ensembles, steps, walkers, D).

    `log_weights` (n,) are log importance weights of independent proposals; `n_outside` further ones
    fell outside the support and have weight zero.  `coupled` if the walkers of an ensemble
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
    with np.errstate(invalid="ignore", divide="ignore"):  # by the delta method
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
                found, asked = f"{values[k]:.4f}", f"{limit:g}"
            else:
                k, side = int(np.argmin(values)), "at least"
                found, asked = count(np.floor(values[k])), count(limit)
            reasons.append(
                f"{label} of {names[k]} is {found} and must be {side} {asked}"
                f" ({int(bad.sum())} of {D} parameters)"
            )
    # every walker counts at least as one draw, even if it never moved: many walkers must not
    # compensate for walkers that do not mix
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
    """Effective sample size of the mean over ensembles that may move as one."""
    D = chains.shape[-1]
    averages = chains.mean(axis=2)
    share = averages.reshape(-1, D).var(axis=0)
    total = chains.reshape(-1, D).var(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        ess = mean_draws(averages) * total / share
    return np.where(np.isfinite(ess), ess, 0.0)


def importance_efficiency(log_weights: Float, n_outside: int = 0) -> float:
    """Effective fraction of draws with these log weights, and of others with weight zero."""
    if not len(log_weights):
        return 0.0
    weights = np.exp(log_weights - log_weights.max())
    return float(weights.sum() ** 2 / (weights**2).sum() / (len(weights) + n_outside))


def pareto_k(log_weights: Float) -> float:
    """Shape of the Pareto tail of importance weights; above 0.7 they cannot be trusted.

    0 where no weight is more than twice the mean: there is no tail then, and the shape of nearly
    equal weights means nothing.
    """
    finite = log_weights[np.isfinite(log_weights)]
    if len(finite) < MIN_WEIGHTS or np.ptp(finite) < 1e-9:
        return float("-inf") if len(finite) >= MIN_WEIGHTS else float("inf")
    weights = np.exp(finite - finite.max())
    if weights.mean() > 0.5:
        return 0.0
    return _pareto_smoothed(finite, 1.0)[1]


def smoothed_weights(log_weights: Float, independent: float) -> tuple[Float, float]:
    """Importance weights (n,) of sum 1 with a Pareto tail, and the shape k of that tail.

    `independent` is the effective fraction of the draws.  With k above 0.7 the weights cannot be
    trusted.
    """
    smoothed, k = _pareto_smoothed(log_weights, independent)
    return np.exp(smoothed), k


def _pareto_smoothed(log_weights: Float, independent: float) -> tuple[Float, float]:
    """Log weights (n,) of sum 1 whose largest follow a Pareto distribution, and its shape k.

    k is infinite, and the weights are as they were, where there is no tail to be fitted.
    """
    from arviz_stats.base import array_stats  # half a second

    try:
        with np.errstate(all="ignore"):  # draws of negligible weight
            # ArviZ takes log likelihoods, of which importance weights are the inverse
            smoothed, k = array_stats.psislw(-log_weights, r_eff=independent)
    except ValueError:  # equal weights in the tail, or too few
        return log_weights - logsumexp(log_weights), float("inf")
    return np.asarray(smoothed, float), float(k)
