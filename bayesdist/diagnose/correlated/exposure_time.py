"""Correlation in time of the deviations of exposures: is there any, and how long does it last?

Exposures that deviate alike over months determine a drift less well than as many independent ones.
Whether they do is tested by the differences of successive exposures (von Neumann 1941, Annals of
Mathematical Statistics 12, 367), with all orders of the exposures equally probable by chance.  The
correlation falls as exp(-|t - t'| / theta), that of an autoregressive process of the first order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.model import DistortionModel
from bayesdist.model.frames import DEVIATIONS
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.distributions import norm_sf

MIN_EXPOSURES = 8  # fewer say nothing of what is left beyond a parabola
PERMUTATIONS = 4000
COUNTED = 10  # permutations beyond: of fewer, the probability is that of a normal distribution
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
    chance, step = list[Float](), max(1, AT_ONCE // values.size)
    for start in range(0, PERMUTATIONS, step):
        n = min(step, PERMUTATIONS - start)
        mixed = rng.permuted(np.tile(np.arange(len(t)), (n, 1)), axis=1)
        chance.append(correlation(values[mixed]))
    others = np.concatenate(chance)
    beyond = int((others >= seen).sum())
    p = (beyond + 1) / (len(others) + 1)
    if beyond < COUNTED:
        # correlations are limited: their tails are lighter than those of a normal distribution
        p = min(p, float(norm_sf((seen - others.mean()) / others.std())))
    return p, seen


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


def _fitted(model: DistortionModel, priors: GaussianPriors) -> Int | None:
    """Indices (k, E) of deviations that are parameters with a prior; None if there are none."""
    if model.frames == "none":
        return None
    number = {name: k for k, name in enumerate(model.names)}
    kinds = []
    for kind in DEVIATIONS:
        at = [number.get(f"{exposure}.{kind}", -1) for exposure in model.exposures]
        if min(at) >= 0 and (priors.precision[at] > 0).all():
            kinds.append(at)
    return np.array(kinds) if kinds else None


def fitted_deviations(model: DistortionModel, theta: Float, priors: GaussianPriors) -> Float | None:
    """Deviations (E, k) of a hierarchy of exposures; None where none was fitted."""
    index = _fitted(model, priors)
    return None if index is None else theta[index].T


def correlated_hierarchy(
    model: DistortionModel,
    theta: Float,
    covariance: Float,
    priors: GaussianPriors,
    epoch: Float,
    n: int,
    rng: np.random.Generator,
) -> tuple[Float, float] | None:
    """Errors (n, D) of a hierarchical fit by correlation in time, and its median time in years.

    The fit takes deviations b for independent, with variances tau^2.  Its error is then
    cov tau^-2 b, of which b of another covariance makes more: what that has beyond tau^2 is drawn.
    None without a drift, and where nothing suggests such correlation.  `epoch` (E,) are the dates
    of the exposures.
    """
    index = _fitted(model, priors)
    if index is None or model.time is None:
        return None
    breaks = model.time.breaks
    precision = priors.precision[index]
    typical = (precision >= 0.5 * np.median(precision, axis=1)[:, None]).all(axis=0)
    values = theta[index][:, typical]
    t = epoch[typical]
    if correlation_p(values.T, t, breaks)[0] > SUSPECTED:
        return None
    steps = [(t >= b).astype(float) for b in breaks]
    design = np.column_stack([np.ones(len(t)), t - t.mean(), *steps])
    design = design[:, np.ptp(design, axis=0) + (design[0] == 1.0) > 0]
    times = np.concatenate([[0.0], CORRELATION_TIMES * np.ptp(t)])
    log, variances, roots = [], [], []
    for time in times:
        root = correlation_root(t, float(time), np.ones(len(t), bool))
        white, flat = np.linalg.solve(root, values.T), np.linalg.solve(root, design)
        basis, triangle = np.linalg.qr(flat)
        squares = ((white - basis @ (basis.T @ white)) ** 2).sum(axis=0)
        free = len(t) - flat.shape[1]
        # restricted likelihood of each kind, its variance at the maximum
        fixed = np.log(np.diag(root)).sum() + np.log(np.abs(np.diag(triangle))).sum()
        log.append(-(fixed + 0.5 * free * np.log(squares)).sum())
        variances.append(squares / free)
        roots.append(root)
    prior = np.full(len(times), (1 - UNCORRELATED) / len(CORRELATION_TIMES))
    prior[0] = UNCORRELATED
    weight = prior * np.exp(np.array(log) - max(log))
    which = rng.choice(len(times), size=n, p=weight / weight.sum())
    out = np.zeros((n, len(theta)))
    for k in np.unique(which[which > 0]):
        rows = np.flatnonzero(which == k)
        correlation = roots[k] @ roots[k].T
        for at, variance in zip(index[:, typical], variances[k], strict=True):
            own = priors.precision[at]
            beyond = variance * correlation - np.diag(1 / own)
            squares, turn = np.linalg.eigh(beyond)
            factor = covariance[:, at] @ (own[:, None] * turn * np.sqrt(np.maximum(squares, 0.0)))
            out[rows] += rng.standard_normal((len(rows), len(t))) @ factor.T
    return out, float(np.median(times[which]))
