"""Correlation in time of the deviations of exposures: its significance and its time scale.

Exposures with similar deviations over months determine a drift less well than as many independent
ones.  The test uses the differences of successive exposures (von Neumann 1941, Annals of
Mathematical Statistics 12, 367); by chance, all orders of the exposures are equally probable.  The
correlation falls as exp(-|t - t'| / theta), as in an autoregressive process of the first order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.model import DistortionModel
from bayesdist.model.frames import DEVIATIONS
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.distributions import norm_sf

MIN_EXPOSURES = 8  # with fewer, residuals from a parabola are meaningless
PERMUTATIONS = 4000
# number of exceeding permutations; with fewer, the p-value is that of a normal distribution
COUNTED = 10
AT_ONCE = 1_000_000  # numbers that are permuted together
# robust standard deviations at which deviations are clipped, because some exposures fail
FARTHEST = 4.0
# relative to the time between first and last exposure
CORRELATION_TIMES = np.array([0.05, 0.15, 0.4, 1.0])
UNCORRELATED = 0.5  # prior probability that deviations are independent
# p-value below which correlation times are considered: few exposures hardly show a correlation,
# which makes the errors of their drift too small all the same
SUSPECTED = 0.5


def correlation_p(values: Float, epoch: Float, breaks: ArrayLike = ()) -> tuple[float, float]:
    """P-value of the correlation in time, and the correlation between successive exposures.

    Parameters
    ----------
    values : ndarray, shape (E, k)
        Deviations of the exposures, of k kinds.
    epoch : ndarray, shape (E,)
        Dates of the exposures in decimal years.
    breaks : array_like
        Dates at which a drift breaks; a free step is fitted at each.

    Returns
    -------
    p_value, correlation : float
        (1, 0) for fewer than `MIN_EXPOSURES` dates.
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
        """Mean correlation (...) of successive deviations (..., E, k) minus a parabola."""
        residual = of - basis @ (basis.T @ of)
        squares = np.maximum((residual**2).sum(axis=-2), 1e-300)
        return np.asarray(
            np.mean(1 - (np.diff(residual, axis=-2) ** 2).sum(axis=-2) / (2 * squares), axis=-1)
        )

    observed = float(correlation(values))
    rng = np.random.default_rng(len(t))
    chance, step = list[Float](), max(1, AT_ONCE // values.size)
    for start in range(0, PERMUTATIONS, step):
        n = min(step, PERMUTATIONS - start)
        mixed = rng.permuted(np.tile(np.arange(len(t)), (n, 1)), axis=1)
        chance.append(correlation(values[mixed]))
    permuted = np.concatenate(chance)
    beyond = int((permuted >= observed).sum())
    p = (beyond + 1) / (len(permuted) + 1)
    if beyond < COUNTED:
        # correlations are bounded: their tails are lighter than those of a normal distribution
        p = min(p, float(norm_sf((observed - permuted.mean()) / permuted.std())))
    return p, observed


def correlation_root(epoch: Float, theta: float, together: Bool) -> Float:
    """Lower Cholesky factor (E, E) of the correlation between exposures.

    Exposures that are not `together` are independent.  `theta` is the correlation time in the unit
    of the epochs; 0 for independent exposures.
    """
    E = len(epoch)
    if theta <= 0:
        return np.eye(E)
    correlation = np.exp(-np.abs(np.subtract.outer(epoch, epoch)) / theta)
    correlation = np.where(np.logical_and.outer(together, together), correlation, np.eye(E))
    # a small diagonal term, because exposures of one date are perfectly correlated
    return np.asarray(np.linalg.cholesky(correlation + 1e-6 * np.eye(E)))


def _fitted(model: DistortionModel, priors: GaussianPriors) -> Int | None:
    """Indices (k, E) of deviations that are parameters with a prior; None without any."""
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
    """Deviations (E, k) of a hierarchy of exposures; None if none was fitted."""
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
    """Errors (n, D) of a hierarchical fit due to correlation in time, and its median time scale.

    The fit assumes independent deviations b with variances tau^2.  Its error is cov tau^-2 b, which
    is larger if b has another covariance; the excess of this covariance over tau^2 is drawn.
    `epoch` (E,) are the dates of the exposures, and the correlation time is in years.  Returns None
    without a drift, and if the data do not suggest a correlation.
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
        # restricted likelihood of each kind, with its variance at the maximum
        fixed = np.log(np.diag(root)).sum() + np.log(np.abs(np.diag(triangle))).sum()
        log.append(-(fixed + 0.5 * free * np.log(squares)).sum())
        variances.append(squares / free)
        roots.append(root)
    prior = np.full(len(times), (1 - UNCORRELATED) / len(CORRELATION_TIMES))
    prior[0] = UNCORRELATED
    weight = prior * np.exp(np.array(log) - max(log))
    time_index = rng.choice(len(times), size=n, p=weight / weight.sum())
    out = np.zeros((n, len(theta)))
    for k in np.unique(time_index[time_index > 0]):
        rows = np.flatnonzero(time_index == k)
        correlation = roots[k] @ roots[k].T
        for at, variance in zip(index[:, typical], variances[k], strict=True):
            kind_precision = priors.precision[at]
            beyond = variance * correlation - np.diag(1 / kind_precision)
            squares, turn = np.linalg.eigh(beyond)
            factor = covariance[:, at] @ (
                kind_precision[:, None] * turn * np.sqrt(np.maximum(squares, 0.0))
            )
            out[rows] += rng.standard_normal((len(rows), len(t))) @ factor.T
    return out, float(np.median(times[time_index]))
