"""Correlation in time of the deviations of exposures: is there any, and how long does it last?

Exposures that deviate alike over months determine a drift less well than as many independent ones.
Whether they do is tested by the differences of successive exposures (von Neumann 1941, Annals of
Mathematical Statistics 12, 367), with all orders of the exposures equally probable by chance.  The
correlation falls as exp(-|t - t'| / theta), that of an autoregressive process of the first order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.utils.arrays import Bool, Float

MIN_EXPOSURES = 8  # fewer say nothing of what is left beyond a parabola
PERMUTATIONS = 20_000
AT_ONCE = 1_000_000  # numbers that are permuted at a time
FARTHEST = 4.0  # robust standard deviations to which deviations are brought: some exposures fail
CORRELATION_TIMES = np.array([0.05, 0.15, 0.4, 1.0])  # relative to the time between first and last
UNCORRELATED = 0.5  # prior probability that deviations are independent
SUSPECTED = 0.05  # probability by chance below which correlation times are looked at


def correlation_p(values: Float, epoch: Float, breaks: ArrayLike = ()) -> tuple[float, float]:
    """Probability of as much correlation in time by chance, and the correlation of neighbours.

    Parameters
    ----------
    values : ndarray, shape (E, k)
        Deviations of the exposures, of k kinds.
    epoch : ndarray, shape (E,)
        Decimal years.
    breaks : array_like
        Dates at which a drift breaks; a step is free at each.

    Returns
    -------
    tuple of float
        1 and 0 for fewer than `MIN_EXPOSURES` exposures or dates.
    """
    order = np.argsort(epoch, kind="stable")
    t = epoch[order]
    if len(np.unique(t)) < MIN_EXPOSURES:
        return 1.0, 0.0
    values = values[order] - np.median(values, axis=0)
    spread = 1.4826 * np.median(np.abs(values), axis=0)
    values = values[:, spread > 0] / spread[spread > 0]
    values = np.clip(values, -FARTHEST, FARTHEST)
    half = (2 * t - t[0] - t[-1]) / (t[-1] - t[0])
    steps = [(t >= b).astype(float) for b in np.atleast_1d(breaks)] if np.size(breaks) else []
    basis = np.linalg.qr(np.column_stack([np.ones(len(t)), half, half**2, *steps]))[0]
    if not values.shape[1] or len(t) <= basis.shape[1] + 2:
        return 1.0, 0.0

    def correlation(of: Float) -> Float:
        """Mean correlation (...) of successive deviations (..., E, k) beyond a parabola."""
        left = of - basis @ (basis.T @ of)
        squares = np.maximum((left**2).sum(axis=-2), 1e-300)
        return np.asarray(
            np.mean(1 - (np.diff(left, axis=-2) ** 2).sum(axis=-2) / (2 * squares), axis=-1)
        )

    seen = float(correlation(values))
    rng = np.random.default_rng(len(t))
    step, beyond, done = max(1, AT_ONCE // values.size), 0, 0
    while done < PERMUTATIONS:
        n = min(step, PERMUTATIONS - done)
        mixed = rng.permuted(np.tile(np.arange(len(t)), (n, 1)), axis=1)
        beyond += int((correlation(values[mixed]) >= seen).sum())
        done += n
        if beyond > 100:  # far from any limit
            break
    return (beyond + 1) / (done + 1), seen


def correlation_root(epoch: Float, theta: float, together: Bool) -> Float:
    """Lower factor (E, E) of the correlation of exposures, those not `together` independent.

    `theta` is the correlation time in the unit of the epochs; 0 for independent exposures.
    """
    E = len(epoch)
    if theta <= 0:
        return np.eye(E)
    correlation = np.exp(-np.abs(np.subtract.outer(epoch, epoch)) / theta)
    correlation = np.where(np.logical_and.outer(together, together), correlation, np.eye(E))
    # exposures of one date are alike but for a little
    return np.asarray(np.linalg.cholesky(correlation + 1e-6 * np.eye(E)))
