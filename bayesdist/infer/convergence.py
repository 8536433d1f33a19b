"""Convergence diagnostics, computed over independent ensembles rather than over coupled walkers.

Differential evolution couples the walkers of an ensemble.  In that case the effective sample size
is the smaller of two estimates: that of the concatenated walkers, and that of the ensemble
averages, which reveals a drift common to all walkers (Goodman and Weare 2010, section 5).
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

TAIL = (0.05, 0.95)  # the tail ESS is the effective sample size of these quantiles
MIN_WEIGHTS = 25  # fewest importance weights; the Pareto tail is fitted to a fifth of them

DIAGNOSTICS = ("rhat", "ess_bulk", "ess_tail", "mcse_mean", "mcse_sd")


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
        """Names of the `n` parameters that are farthest from meeting the criteria."""
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
    nearly equal weights would be meaningless.
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
