"""Surrogate of the posterior that can be sampled without the data, and its certificate.

With many stars the proposal q is so close to the posterior p that the log importance weight log p -
log q is small and smooth.  A regression g on low-order features is fitted to the exact weights of a
few hundred draws of q (pilots), and the surrogate is s = q exp(g).  Pilots that are held out from
the regression show how much s differs from p.

**What is certified.**  With d = log p - log s, known up to a constant, and expectations over s,

    chi2(p || s) = E[e^2d] / E[e^d]^2 - 1.

For any function f of the parameters, E_p f - E_s f = E_s[(p/s - 1) (f - E_s f)], so that by the
Cauchy-Schwarz inequality

    |E_p f - E_s f| <= sd_s(f) sqrt(chi2),        total variation <= sqrt(chi2) / 2.

Hence the error of any mean, including that of a square or of the indicator of an interval, is at
most sqrt(chi2) times the standard deviation of the averaged quantity.  Since the pilots are draws
of q, E[.] is a mean weighted by e^g.

**What is not certified.**  The inequality is exact, but chi2 is an estimate.  Its upper limit
allows for a region that the pilots may have missed.  By the rule of three, a region with more than
3/n of the probability of q is hit with 95 % confidence; three pilots are therefore added, each with
twice the largest remainder observed.  Normal theory and the bootstrap would give limits that are
too low, since the remainders have the tails of a cubic.  All values hold for the region that the
pilots cover.  The outermost tails of q and everything beyond them, such as a distant second mode,
are not covered.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import factorial

import numpy as np
from numpy.polynomial import hermite_e

from bayesdist.errors import InputError, NotConvergedError
from bayesdist.infer.convergence import importance_efficiency, pareto_k
from bayesdist.infer.density.proposal import Random
from bayesdist.infer.posterior import Certificate
from bayesdist.infer.sampler.move_schedule import EFFICIENT
from bayesdist.utils.arrays import Float
from bayesdist.utils.limits import PARETO_K

DEGREE = 3  # degree of the polynomial in the hyperparameters
LEAST_TRAINING = 20  # minimum number of pilots for the regression
LEAST_HELD_OUT = 100  # minimum number of held-out pilots; fewer may miss 3 % of the probability
MOST_REMAINDER = 0.1  # largest standard deviation of log p - log s for a certificate
MOST_SHIFT = 0.1  # largest error of a mean in posterior sd: the Monte-Carlo error of 100 draws
MISSED = 3  # number of pilots that may have been missed, by the rule of three
MISSED_FACTOR = 2.0  # assumed ratio of a missed remainder to the largest observed one
ROUNDING = 1e-6  # rounding error of log densities of 1e7 and more
LARGEST = 300.0  # limit of a log weight, to avoid overflow of its square
BATCH = 4096  # proposals drawn at a time; the draws depend on it
LEAST_ACCEPTED = 1e-3  # smallest accepted fraction before sampling is given up

# ratios to try of the prior sd of the linear terms to that of the core features
SHARES = np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 9)])
STRENGTHS = np.geomspace(1e-9, 1e5, 43)  # ridge strengths per pilot to try
LEAST_FREE = 1e-6  # smallest leave-one-out factor of a pilot that is not interpolated exactly


@dataclass(frozen=True, eq=False)
class Surrogate:
    """Approximate log importance weight g, a bounded function of whitened coordinates.

    The features are polynomials that are orthonormal under the proposal (Hermite polynomials): up
    to third degree in the hyperparameters u; S = sum_k (t_k^2 - 1) over the coefficients t, S u and
    S^2, since the hyperparameters scale the errors of all coefficients together; and each t_k by
    itself.  The hyperparameters u = root @ (w - centre) have mean zero and unit covariance.

    The log weight is clipped to bounds, because q exp(cubic) could not be normalised; `upper` is
    also the envelope for rejection sampling.
    """

    centre: Float  # mean (h,) of the hyperparameters, which are the last h coordinates
    root: Float  # whitening matrix (h, h) of the hyperparameters
    constant: float
    coefficients: Float  # regression coefficients (p,)
    lower: float  # bounds of the log weight
    upper: float

    def log_weight(self, white: Float) -> Float:
        """Log s - log q (n,) at whitened points (n, D), with the constant of the exact weights."""
        core, linear = _features(white, self.centre, self.root)
        c = core.shape[1]
        value = self.constant + core @ self.coefficients[:c] + linear @ self.coefficients[c:]
        return np.clip(value, self.lower, self.upper)


def certify(
    white: Float, log_weights: Float, n_hyper: int, *, rng: np.random.Generator
) -> tuple[Surrogate, Certificate]:
    """Fit a surrogate to half of the pilots and certify it with the other half.

    Parameters
    ----------
    white : ndarray, shape (n, D)
        Pilots: independent draws of the proposal q inside the support, in whitened coordinates. The
        last `n_hyper` coordinates are hyperparameters.
    log_weights : ndarray, shape (n,)
        Exact log p - log q up to a constant; minus infinity if p is zero.
    n_hyper : int
    rng : numpy.random.Generator
        Random generator that splits the pilots.

    Returns
    -------
    Surrogate
    Certificate

    Raises
    ------
    InputError
        If there are too few pilots.
    """
    order = rng.permutation(len(log_weights))
    n_test = round(len(order) / 2)
    test, train = order[:n_test], order[n_test:]
    train = train[np.isfinite(log_weights[train])]
    if len(train) < LEAST_TRAINING or not np.isfinite(log_weights[test]).any():
        raise InputError(
            f"{len(train)} pilots for the regression and {n_test} held-out pilots are too few",
            where="certificate",
            do="draw a few hundred pilots",
        )
    surrogate = _fit(white[train], log_weights[train], n_hyper)
    # k is meaningless if the weights differ by rounding errors only
    flat = np.ptp(log_weights[np.isfinite(log_weights)]) < ROUNDING
    k = float("-inf") if flat else pareto_k(log_weights)
    guess = surrogate.log_weight(white[test])
    return surrogate, _judge(log_weights, log_weights[test], guess, len(train), k)


def draw_surrogate(
    propose: Callable[[int, Random], Float],
    whiten: Callable[[Float], Float],
    surrogate: Surrogate,
    n: int,
    rng: Random,
) -> tuple[Float, float]:
    """Draw from the surrogate by rejection sampling.

    Since g is bounded, the draws are independent and follow the surrogate exactly, without repeated
    draws as in resampling.  The first draws from a generator do not depend on `n`.

    Parameters
    ----------
    propose : callable
        Function (m, rng) that returns draws (m, D) of q; rows outside the support are not finite.
    whiten : callable
        Function that transforms draws to the whitened coordinates of the pilots.
    surrogate : Surrogate
    n : int
        Number of draws.
    rng : numpy.random.Generator

    Returns
    -------
    draws : ndarray, shape (n, D)
    acceptance : float
        Accepted fraction of the proposals.

    Raises
    ------
    NotConvergedError
        If hardly any proposal is accepted.
    """
    accepted: list[Float] = []
    n_kept = tried = 0
    while n_kept < n:
        psi = propose(BATCH, rng)
        chance = np.log(rng.uniform(size=BATCH))
        inside = np.isfinite(psi).all(axis=1)
        psi, chance = psi[inside], chance[inside]
        take = psi[chance < surrogate.log_weight(whiten(psi)) - surrogate.upper]
        accepted.append(take)
        n_kept, tried = n_kept + len(take), tried + BATCH
        if tried >= 10 / LEAST_ACCEPTED and n_kept < LEAST_ACCEPTED * tried:
            raise NotConvergedError(
                f"the surrogate accepts {n_kept} of {tried} proposals",
                where="certificate",
                do="sample the exact posterior",
            )
    draws = np.concatenate(accepted)[:n] if accepted else propose(0, rng)
    return draws, n_kept / tried if tried else 1.0


# -- the surrogate --------------------------------------------------------------------------------


def _features(white: Float, centre: Float, root: Float) -> tuple[Float, Float]:
    """Core features (n, c), and linear features (n, D - h): the coefficients t themselves."""
    h = len(centre)
    t, u = white[:, : white.shape[1] - h], (white[:, white.shape[1] - h :] - centre) @ root.T
    hermite = [
        hermite_e.hermeval(u, [0.0] * d + [1.0 / np.sqrt(factorial(d))]) for d in range(DEGREE + 1)
    ]
    columns = []
    for degree in range(1, DEGREE + 1):
        for chosen in combinations_with_replacement(range(h), degree):
            power = np.bincount(chosen, minlength=h)
            columns.append(np.prod([hermite[power[k]][:, k] for k in range(h)], axis=0))
    if t.shape[1]:
        S = (t**2 - 1).sum(axis=1) / np.sqrt(2 * t.shape[1])
        columns += [S, (S**2 - 1) / np.sqrt(2), *(S * u[:, k] for k in range(h))]
    return np.stack(columns, axis=1), t


def _fit(white: Float, log_weights: Float, n_hyper: int) -> Surrogate:
    hyper = white[:, white.shape[1] - n_hyper :]
    centre = hyper.mean(axis=0)
    cov = (hyper - centre).T @ (hyper - centre) / len(hyper) + 1e-12 * np.eye(n_hyper)
    root = np.linalg.inv(np.linalg.cholesky(cov))
    core, linear = _features(white, centre, root)
    coefficients = _ridge(core, linear, log_weights)
    fitted = np.concatenate([core, linear], axis=1) @ coefficients
    constant = float(log_weights.mean() - fitted.mean())
    fitted += constant
    # bounds: the range of fitted values, extended by half of it on either side (about 5 sigma)
    margin = np.ptp(fitted) / 2
    return Surrogate(
        centre,
        root,
        constant,
        coefficients,
        float(fitted.min() - margin),
        float(fitted.max() + margin),
    )


def _ridge(core: Float, linear: Float, y: Float) -> Float:
    """Ridge regression coefficients; two ridge strengths are chosen by leave-one-out errors."""
    n = len(y)
    y = y - y.mean()
    core, linear = core - core.mean(axis=0), linear - linear.mean(axis=0)
    smallest_error, best = np.inf, np.zeros(core.shape[1] + linear.shape[1])
    for share in SHARES:
        # dual form, since there may be more features than pilots
        values, U = np.linalg.eigh(core @ core.T + share**2 * (linear @ linear.T))
        values, along = np.maximum(values, 0.0), U.T @ y
        strengths = n * STRENGTHS
        shrinkage = strengths / (values[:, None] + strengths)
        free = U**2 @ shrinkage - 1 / n  # leave-one-out factors; the constant is fitted too
        misses = (U @ (shrinkage * along[:, None])) / np.maximum(free, LEAST_FREE)
        errors = (misses**2).sum(axis=0)
        # exclude strengths for which a pilot is interpolated exactly
        errors[free.min(axis=0) < LEAST_FREE] = np.inf
        k = int(np.argmin(errors))
        if errors[k] < smallest_error:
            dual = U @ (along / (values + strengths[k]))
            best = np.concatenate([core.T @ dual, share**2 * (linear.T @ dual)])
            smallest_error = float(errors[k])
    return best


# -- the certificate ------------------------------------------------------------------------------


def _judge(log_weights: Float, exact: Float, guess: Float, n_train: int, k: float) -> Certificate:
    """Certificate from all log weights, and the exact and approximate ones of held-out pilots."""
    finite = np.isfinite(exact)
    n_outside = int((~np.isfinite(log_weights)).sum())
    weight = np.exp(guess - guess.max())
    weight /= weight.sum()  # weights of draws of q for means over s
    remainder = exact - guess
    top = remainder.max()
    d = remainder - top - np.log(weight @ np.exp(remainder - top))  # E_s[e^d] = 1
    worst = float(np.abs(d[finite]).max())
    chi2 = _chi2(weight, d)
    # add the pilots that may have been missed, with the weight of an average pilot
    n = len(exact)
    share = MISSED / (n + MISSED)
    missed = min(MISSED_FACTOR * worst, LARGEST)
    upper = _chi2(np.append((1 - share) * weight, share), np.append(d, missed))
    bound = float(np.sqrt(upper))
    sd = float(np.std(remainder[finite]))
    efficiency = importance_efficiency(log_weights[np.isfinite(log_weights)], n_outside)

    reasons = []
    if n < LEAST_HELD_OUT:
        reasons.append(f"{n} pilots held out are fewer than {LEAST_HELD_OUT}")
    if n_outside:
        reasons.append(f"the posterior is zero at {n_outside} pilots")
    if not k < PARETO_K.value:
        reasons.append(f"Pareto k {k:.3f} of the proposal is not below {PARETO_K.value}")
    if not efficiency > EFFICIENT:
        reasons.append(f"efficiency {efficiency:.3f} of the proposal is not above {EFFICIENT}")
    if not sd <= MOST_REMAINDER:
        reasons.append(f"standard deviation {sd:.2g} of the remainder exceeds {MOST_REMAINDER}")
    if not bound <= MOST_SHIFT:
        reasons.append(f"means may be off by {bound:.2g} standard deviations, above {MOST_SHIFT}")
    return Certificate(
        n_train=n_train,
        n_held_out=n,
        n_outside=n_outside,
        raw_sd=float(np.std(log_weights[np.isfinite(log_weights)])),
        remainder_sd=sd,
        remainder_max=worst,
        raw_efficiency=efficiency,
        efficiency=1 / (1 + chi2),
        pareto_k=k,
        chi2=chi2,
        chi2_upper=upper,
        mean_shift_bound=bound,
        tv_bound=min(bound / 2, 1.0),
        unseen=float(1 - 0.05 ** (1 / n)),
        reasons=tuple(reasons),
    )


def _chi2(weight: Float, d: Float) -> float:
    """Variance of e^d divided by its squared mean, for normalised weights."""
    b = np.exp(d)
    mean = weight @ b
    # subtract the mean first: E[b^2] - 1 would lose all digits for remainders of 1e-8
    return float(weight @ (b - mean) ** 2 / mean**2)
