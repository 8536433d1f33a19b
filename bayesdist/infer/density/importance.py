"""Quality of a proposal density and of its independence chain, from log importance weights.

The weight of a draw is w = target / proposal density.  An independence chain at a point of
weight w rejects a proposal of weight w' with probability 1 - min(1, w'/w).  Efficiency, warm-up
and autocorrelation time therefore follow from the weights alone.

Log weights are NaN for draws outside the support, which are not evaluated; they have weight zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.infer.convergence import importance_efficiency, pareto_k
from bayesdist.utils.arrays import Float

CLOSE = 0.02  # total variation distance from the posterior at which warm-up ends
MOST_WARMUP = 10_000


@dataclass(frozen=True)
class Quality:
    """Quality of a proposal."""

    efficiency: float  # effective sample size of weighted draws over their number
    k: float  # Pareto shape of the tail of the weights
    log_weights: Float  # of the draws inside the support
    n_outside: int  # number of draws outside the support


def quality_of(log_weights: Float) -> Quality:
    """Importance efficiency and Pareto k of log weights (any shape)."""
    inside = log_weights[~np.isnan(log_weights)]
    n_outside = log_weights.size - inside.size
    if not np.isfinite(inside).any():
        return Quality(0.0, float("inf"), inside, n_outside)
    efficiency = importance_efficiency(inside, n_outside)
    return Quality(efficiency, pareto_k(inside), inside, n_outside)


def rejection(log_weights: Float) -> tuple[Float, Float]:
    """Normalised non-zero weights (m,), ascending, and the rejection rate (m,) at each of them.

    A weight is the posterior mass of its point.  The rejection rate is the mean of
    1 - min(1, w'/w) over the other draws.
    """
    flat = log_weights.ravel()
    log_w = np.sort(flat[np.isfinite(flat)])
    n_others, n_zero = flat.size - 1, flat.size - log_w.size
    w = np.exp(log_w - log_w[-1])
    below = np.cumsum(w) - w
    smaller = np.arange(log_w.size)
    # draws of smaller weight are rejected in part, those of zero weight always, larger ones never
    rate = (n_zero + smaller - below / np.maximum(w, 1e-300)) / max(n_others, 1)
    return w / w.sum(), np.clip(rate, 0.0, 1.0)


def warmup_steps(log_weights: Float) -> int:
    """Number of warm-up steps of an independence chain that starts from a draw of the proposal.

    The bound follows from a coupling argument.  A second chain starts from an exact posterior draw
    and uses the same proposals and uniform numbers.  Once the chain with the larger weight accepts
    a proposal, the other accepts it too, and the chains are identical afterwards.  Hence the total
    variation distance after t steps is at most the mean of r(max(w, w*))^t, with w drawn from the
    proposal, w* from the posterior, and r the rejection rate.  Returns the first t for which this
    bound is at most `CLOSE`.
    """
    mass, rate = rejection(log_weights)
    by_proposal = np.arange(1, len(mass) + 1) / len(mass)
    larger = np.diff(by_proposal * np.cumsum(mass), prepend=0.0)
    for t in range(1, MOST_WARMUP):
        if larger @ rate**t <= CLOSE:
            return t
    return MOST_WARMUP


def draws_per_effective(log_weights: Float) -> float:
    """Integrated autocorrelation time of an independence chain.

    For functions that do not depend on the weight, the autocorrelation at lag t is the posterior
    mean of r^t, with r the rejection rate.  The time is 1 + 2 sum_t E[r^t] = 1 + 2 E[r / (1 - r)].
    """
    mass, rate = rejection(log_weights)
    return float(1 + 2 * mass @ (rate / np.maximum(1 - rate, 1e-6)))
