"""Pareto-smoothed importance weights (Vehtari et al. 2024, Journal of Machine Learning Research
25, number 72), the tail fitted as by Zhang and Stephens (2009, Technometrics 51, 316).

The values are those of ArviZ, whose import takes longer than a small posterior.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

__all__ = ["pareto_smoothed"]

Float = NDArray[np.float64]

MIN_TAIL = 5  # weights to which a tail is fitted
PRIOR_SHAPE, PRIOR_WEIGHT = 0.5, 10  # of the shape, and how many weights it counts for
SMALLEST = np.log(np.finfo(float).tiny)  # log weight relative to the largest


def pareto_smoothed(log_weights: Float, independent: float = 1.0) -> tuple[Float, float]:
    """Log weights (n,) of sum 1 whose largest follow a Pareto distribution, and its shape k.

    `independent`: effective fraction of the draws. k is infinite, and the weights are as they were,
    where there are too few in the tail.
    """
    out = log_weights - log_weights.max()
    n = len(out)
    order = np.argsort(out)
    reach = int(np.ceil(min(n / 5, 3 * np.sqrt(n / independent))))
    threshold = max(out[order[-reach - 1]], SMALLEST)
    tail = order[out[order] > threshold]
    if len(tail) < MIN_TAIL:
        return out - logsumexp(out), float("inf")
    k, scale = _fitted_tail(np.exp(out[tail]) - np.exp(threshold))
    middles = -np.log1p(-np.arange(0.5, len(tail)) / len(tail))
    excess = scale * (np.expm1(k * middles) / k if k else middles)
    out[tail] = np.minimum(np.log(excess + np.exp(threshold)), 0.0)
    return out - logsumexp(out), k


def _fitted_tail(excess: Float) -> tuple[float, float]:
    """Shape and scale of a generalised Pareto distribution of ascending values (n,)."""
    n = len(excess)
    m = 30 + int(np.sqrt(n))
    quartile = excess[int(n / 4 + 0.5) - 1]
    b = 1 / excess[-1] + (1 - np.sqrt(m / (np.arange(1, m + 1) - 0.5))) / (3 * quartile)
    b[b == 0] = 1e-9 / excess[-1]  # an exponential tail, but for rounding
    shape = np.log1p(-b[:, None] * excess).mean(axis=1)
    profile = n * (np.log(-b / shape) - shape - 1)
    weight = np.exp(profile - logsumexp(profile))
    weight[weight < 10 * np.finfo(float).eps] = 0.0
    best = float(b @ weight / weight.sum())
    k = float(np.log1p(-best * excess).mean())
    return (n * k + PRIOR_WEIGHT * PRIOR_SHAPE) / (n + PRIOR_WEIGHT), -k / best
