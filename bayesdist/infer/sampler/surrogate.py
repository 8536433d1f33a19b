"""Draws without a pass over the data, and a certificate of their quality.

With many stars the proposal q is so close to the posterior p that the log importance weight log p -
log q is small and smooth.  A few hundred exact weights (pilots) are regressed on features of low
order, g, and the surrogate is s = q exp(g).  Pilots that were not used in the regression then show
how far s is from p.

**What is certified.**  With d = log p - log s, known up to a constant, and expectations over s,

    chi2(p || s) = E[e^2d] / E[e^d]^2 - 1,

and for any function f of the parameters, because E_p f - E_s f = E_s[(p/s - 1) (f - E_s f)], Cauchy
and Schwarz give

    |E_p f - E_s f| <= sd_s(f) sqrt(chi2),        total variation <= sqrt(chi2) / 2.

So every mean, also that of a square or of the indicator of an interval, is off by at most
sqrt(chi2) of its own standard deviation.  The pilots are draws of q, hence E[.] is a mean weighted
by e^g.

**What is not.**  The inequality is exact, chi2 is an estimate.  Its upper limit allows for what the
pilots could have missed: three more of them (the rule of three: a region of more than 3/n of q's
probability is hit with 95 %), each with twice the worst remainder seen.  Normal theory or the
bootstrap are too low here, since remainders have the tails of a cubic.  All values hold for the
region that the pilots reach.  The outermost tails of q and all beyond, such as a second mode far
away, are not covered.
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

DEGREE = 3  # of the polynomial in the hyperparameters
LEAST_TRAINING = 20
LEAST_HELD_OUT = 100  # fewer leave more than 3 % of the probability unseen
MOST_REMAINDER = 0.1
MOST_SHIFT = 0.1  # posterior standard deviations: the Monte-Carlo error of 100 draws
MISSED = 3  # pilots that may have been missed, by the rule of three
MISSED_FACTOR = 2.0  # factor by which an unseen remainder may exceed the worst that was seen
ROUNDING = 1e-6  # of log densities of 1e7 and more
LARGEST = 300.0  # of a log weight: its square must not overflow
BATCH = 4096  # proposals drawn at a time; draws depend on it
LEAST_ACCEPTED = 1e-3

SHARES = np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 9)])  # prior sd: linear terms over core
STRENGTHS = np.geomspace(1e-9, 1e5, 43)  # of the ridge, for each pilot
LEAST_FREE = 1e-6  # of a pilot's residual, from which it counts as predicted by the others


@dataclass(frozen=True, eq=False)
class Surrogate:
    """Approximate log importance weight, as a bounded function of whitened coordinates.

    Its features are orthonormal (Hermite) polynomials under the proposal: up to third degree in the
    hyperparameters u; S = sum_k (t_k^2 - 1) over the coefficients t, with S u and S^2, since the
    hyperparameters scale the errors of all coefficients together; and each t_k separately.  The
    hyperparameters u = root @ (w - centre) have mean zero and unit covariance.

    The log weight has bounds: a cubic has none, and q exp(cubic) would be no density; `upper` also
    is the exact envelope of rejection sampling.
    """

    centre: Float  # (h,) of the hyperparameters, which are the last h coordinates
    root: Float  # (h, h)
    constant: float
    coefficients: Float  # (p,)
    lower: float
    upper: float

    def log_weight(self, white: Float) -> Float:
        """Log s - log q (n,), up to the constant of the exact ones, at points (n, D)."""
        core, linear = _features(white, self.centre, self.root)
        c = core.shape[1]
        value = self.constant + core @ self.coefficients[:c] + linear @ self.coefficients[c:]
        return np.clip(value, self.lower, self.upper)


def certify(
    white: Float, log_weights: Float, n_hyper: int, *, rng: np.random.Generator
) -> tuple[Surrogate, Certificate]:
    """Surrogate fitted to half of the pilots, and its certificate by the others.

    `white` (n, D) are independent draws of the proposal q inside its support, in coordinates about
    standard normal under q, the last `n_hyper` of them hyperparameters; `log_weights` (n,) are
    exact log p - log q, up to a constant, minus infinity where p is zero.  `rng` splits the pilots.
    InputError for too few of them.
    """
    order = rng.permutation(len(log_weights))
    n_test = round(len(order) / 2)
    test, train = order[:n_test], order[n_test:]
    train = train[np.isfinite(log_weights[train])]
    if len(train) < LEAST_TRAINING or not np.isfinite(log_weights[test]).any():
        raise InputError(
            f"{len(train)} pilots to learn from and {n_test} to judge by are too few",
            where="certificate",
            do="draw a few hundred pilots",
        )
    surrogate = _fit(white[train], log_weights[train], n_hyper)
    # the tail of rounding errors means nothing
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
    """Independent draws (n, D) of the surrogate by rejection, and the fraction accepted.

    The surrogate is bounded, so its bound is an envelope and the draws, all of weight one, follow
    it exactly; resampled draws would repeat themselves.  Draws of one generator begin alike,
    however many there are.

    `propose` (m, rng) gives draws of q (m, D), whose rows are not finite outside the support;
    `whiten` maps draws to the coordinates of the pilots.  NotConvergedError when next to no
    proposal is accepted.
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
    """Core features (n, c), and the coefficients themselves (n, D - h)."""
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
    # half the range more on either side: about five standard deviations
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
    """Ridge coefficients, whose two strengths (core, linear terms) are chosen by leave-one-out."""
    n = len(y)
    y = y - y.mean()
    core, linear = core - core.mean(axis=0), linear - linear.mean(axis=0)
    least, best = np.inf, np.zeros(core.shape[1] + linear.shape[1])
    for share in SHARES:
        # in the space of the pilots: there may be more features than pilots
        values, U = np.linalg.eigh(core @ core.T + share**2 * (linear @ linear.T))
        values, along = np.maximum(values, 0.0), U.T @ y
        strengths = n * STRENGTHS
        left = strengths / (values[:, None] + strengths)
        free = U**2 @ left - 1 / n  # of each residual; the constant is fitted too
        misses = (U @ (left * along[:, None])) / np.maximum(free, LEAST_FREE)
        errors = (misses**2).sum(axis=0)
        # a pilot that determines its own value gives no information about others
        errors[free.min(axis=0) < LEAST_FREE] = np.inf
        k = int(np.argmin(errors))
        if errors[k] < least:
            dual = U @ (along / (values + strengths[k]))
            best = np.concatenate([core.T @ dual, share**2 * (linear.T @ dual)])
            least = float(errors[k])
    return best


# -- the certificate ------------------------------------------------------------------------------


def _judge(log_weights: Float, exact: Float, guess: Float, n_train: int, k: float) -> Certificate:
    """Certificate from all log weights and, over pilots held out, exact and approximate ones."""
    finite = np.isfinite(exact)
    n_outside = int((~np.isfinite(log_weights)).sum())
    weight = np.exp(guess - guess.max())
    weight /= weight.sum()  # means over s from draws of q
    remainder = exact - guess
    top = remainder.max()
    d = remainder - top - np.log(weight @ np.exp(remainder - top))  # E_s[e^d] = 1
    worst = float(np.abs(d[finite]).max())
    chi2 = _chi2(weight, d)
    # the unseen part, at the weight of an average pilot
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
        reasons.append(f"{n_outside} pilots lie where the posterior is zero")
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
    """Variance of e^d over its squared mean, for weights that add up to one."""
    b = np.exp(d)
    mean = weight @ b
    # centred: E[b^2] - 1 would lose all digits where the remainder is 1e-8
    return float(weight @ (b - mean) ** 2 / mean**2)
