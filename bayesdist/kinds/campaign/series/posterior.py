"""Posterior of a series: draws of trend and scatter, predictions, and changes at breaks.

For predictive densities of held-out exposures, the exposures are divided into folds, and each fold
is predicted from the others.  This is done with importance weights for the draws of the complete
series if the weights are reliable, otherwise by sampling without the fold.  The chains of all such
refits run in parallel, starting from the last state for the complete series.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.convergence import Convergence, Limits, smoothed_weights
from bayesdist.infer.equations.scaled import chi_square, one_thread
from bayesdist.infer.kernel import densities
from bayesdist.kinds.campaign.series.problem import SeriesProblem, State
from bayesdist.kinds.campaign.series.sampler import Draws, Engine, run
from bayesdist.kinds.campaign.series.series import Series
from bayesdist.kinds.campaign.series.trend import Design, TrendModel
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.checks import PARETO_K

CHAINS, WARMUP, SWEEPS = 32, 50, 50  # number of chains; sweeps of the warm-up; first sweeps

# per fold that is sampled again: number of chains, of warm-up sweeps and of sweeps after these
FOLD_CHAINS, FOLD_WARMUP, FOLD_SWEEPS = 6, 30, 60
CHAINS_AT_ONCE = 192  # largest number of chains in parallel
DRAWS_AT_ONCE = 1024  # number of posterior draws per block of the predictive densities
N_FOLDS = 30  # default number of folds


@dataclass(frozen=True, eq=False)
class ChangeAtBreak:
    """Change of k coefficients, with its covariance.

    Parameters
    ----------
    value : ndarray, shape (k,)
        Change of each coefficient.
    cov : ndarray, shape (k, k)
        Covariance of the changes.
    """

    value: Float
    cov: Float

    @classmethod
    def of(cls, draws: Float) -> ChangeAtBreak:
        """Compute mean and covariance from draws.

        Parameters
        ----------
        draws : ndarray, shape (n, k)
            Draws of the change.

        Returns
        -------
        ChangeAtBreak
        """
        return cls(draws.mean(axis=0), np.atleast_2d(np.cov(draws, rowvar=False)))

    @property
    def sigma(self) -> Float:
        """Standard deviation (k,) of each change."""
        return np.sqrt(np.diag(self.cov))

    @property
    def significance(self) -> Float:
        """Change divided by its error (k,); 0 if the trend does not allow a change."""
        return np.divide(
            self.value, self.sigma, out=np.zeros_like(self.value), where=self.sigma > 0
        )

    @property
    def p_value(self) -> float:
        """Probability of a larger chi-square if there is no change.

        It assumes a Gaussian posterior.  With few exposures, the posterior has heavier tails, and
        this value is too small.
        """
        return chi_square(self.value, self.cov).p_value


@dataclass(frozen=True, eq=False)
class SeriesPrediction:
    """Predicted coefficients at M epochs.

    Parameters
    ----------
    epoch : ndarray, shape (M,)
        Decimal years.
    mean : ndarray, shape (M, k)
        Posterior mean of the trend.
    cov : ndarray, shape (M, k, k)
        Covariance of the trend.
    cov_new : ndarray, shape (M, k, k)
        Covariance of the coefficients of a new exposure that is not an outlier and has no formal
        errors: that of the trend plus the intrinsic covariance.
    """

    epoch: Float
    mean: Float
    cov: Float
    cov_new: Float

    @property
    def sigma(self) -> Float:
        """Standard deviation (M, k) of the trend."""
        return np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))

    @property
    def sigma_new(self) -> Float:
        """Standard deviation (M, k) of a new exposure without formal errors."""
        return np.sqrt(np.diagonal(self.cov_new, axis1=1, axis2=2))


@dataclass(frozen=True, eq=False)
class SeriesPosterior:
    """Posterior of a trend and of the scatter of the exposures about it.

    Parameters
    ----------
    series : Series
    trend : TrendModel
    design : Design
        Design matrix of the trend.
    raw : Draws
        Draws in units of the spread of the series.
    convergence : Convergence
    engine : Engine
        Sampler, to continue the chains.
    last : State
        Last state of the chains.
    """

    series: Series
    trend: TrendModel
    design: Design
    raw: Draws
    convergence: Convergence
    engine: Engine
    last: State

    @property
    def _parameters(self) -> Float:
        """Draws (n, k, p) of the parameters of the columns."""
        return self.raw.b.reshape(-1, *self.raw.b.shape[2:])

    @cached_property
    def _lines(self) -> tuple[Float, Float]:
        level, slope = self.design.lines(self._parameters, self._breaks)
        unit = self.series.spread
        return self.series.centre + level * unit, slope * unit

    @cached_property
    def _breaks(self) -> Float:
        """Draws (n, B) of the break dates; a single row if they are given."""
        if not self.trend.find:
            return self.design.given_breaks()
        return self.raw.breaks.reshape(self.raw.fraction.size, self.trend.find)

    @property
    def reference(self) -> Float:
        """Reference date (S,) of each segment in decimal years."""
        return self.design.reference

    @property
    def alpha(self) -> Float:
        """Draws (n, S, k) of the coefficients at the reference dates, for the first group."""
        return self._lines[0]

    @property
    def beta(self) -> Float:
        """Draws (n, S, k) of the slopes per year; zero if the trend has no slopes."""
        return self._lines[1]

    @cached_property
    def scatter(self) -> Float:
        """Draws (n, k, k) of the intrinsic covariance."""
        unit = self.series.spread
        k = len(unit)
        return self.raw.sigma.reshape(-1, k, k) * (unit[:, None] * unit)

    @property
    def scatter_sigma(self) -> Float:
        """Draws (n, k) of the intrinsic standard deviations."""
        return np.sqrt(np.diagonal(self.scatter, axis1=1, axis2=2))

    @property
    def breaks(self) -> Float:
        """Draws (n, B) of the dates of unknown breaks, in decimal years."""
        return self.raw.breaks.reshape(-1, self.trend.find)

    @property
    def outlier_probability(self) -> Float:
        """Posterior outlier probability (E,) of each exposure."""
        return self.raw.outlier_probability

    @cached_property
    def group_offset(self) -> Float:
        """Draws (n, G - 1, k) of the offsets of the other groups from the first group."""
        return self._group_columns(self.trend.n_columns) * self.series.spread

    @cached_property
    def group_slope(self) -> Float:
        """Draws (n, G - 1, k) of the slopes of the other groups minus that of the first, per year.

        Raises
        ------
        InputError
            If the groups have common slopes.
        """
        if self.trend.groups != "slopes":
            raise InputError(
                "the groups have common slopes",
                where=self.series.source,
                do="fit a trend with groups='slopes'",
            )
        first = self.trend.n_columns + self.design.n_groups - 1
        return self._group_columns(first) * self.series.spread / self.design.years

    def _group_columns(self, first: int) -> Float:
        columns = slice(first, first + self.design.n_groups - 1)
        return np.swapaxes(self._parameters[..., columns], 1, 2)

    def change(self, number: int = 0) -> tuple[ChangeAtBreak, ChangeAtBreak]:
        """Changes of the coefficients and of their slopes at a break.

        Parameters
        ----------
        number : int
            Number of the break, starting from 0.

        Returns
        -------
        level, slope : ChangeAtBreak
            Values after the break minus those before it, at the date of the break. If the trend
            does not allow the slopes to change, their change is zero with zero error.

        Raises
        ------
        InputError
            If the trend has no such break.
        """
        if not 0 <= number < self.trend.n_breaks:
            raise InputError(
                f"there is no break {number + 1}", where=self.series.source, do="see trend.breaks"
            )
        date = self._breaks[:, number, None, None]
        at = self.alpha + self.beta * (date - self.reference[:, None])
        level = at[:, number + 1] - at[:, number]
        slope = self.beta[:, number + 1] - self.beta[:, number]
        return ChangeAtBreak.of(level), ChangeAtBreak.of(slope)

    # -- prediction -------------------------------------------------------------------------------

    def predict(self, epoch: ArrayLike, *, group: str | None = None) -> SeriesPrediction:
        """Predict the coefficients at epochs between the first and the last exposure.

        Parameters
        ----------
        epoch : array_like, shape (M,)
            Decimal years.
        group : str, optional
            Name of the group; by default that with most exposures.

        Returns
        -------
        SeriesPrediction

        Raises
        ------
        InputError
            If an epoch is outside the range of the exposures, or the group is unknown.
        """
        t = np.atleast_1d(np.asarray(epoch, float))
        trend = self._trend_draws(t, group)
        mean = trend.mean(axis=0)
        off = trend - mean
        cov = np.einsum("nmi,nmj->mij", off, off) / (len(off) - 1)
        return SeriesPrediction(t, mean, cov, cov + self.scatter.mean(axis=0))

    def _trend_draws(self, t: Float, group: str | None) -> Float:
        """Draws (n, M, k) of the trend at epochs t (M,)."""
        first, last = self.series.span
        outside = ~((t >= first) & (t <= last))
        if outside.any():
            raise InputError(
                f"epoch {t[int(np.argmax(outside))]:g} is outside the range of the exposures, "
                f"{first:.2f} to {last:.2f}",
                where=self.series.source,
                do="give another epoch",
            )
        names = self.series.group_names
        if group is not None and group not in names:
            raise InputError(
                f"there is no group {group!r}",
                where=self.series.source,
                do=f"choose among {', '.join(names)}" if names else "the series has no groups",
            )
        code = np.full(len(t), names.index(group) if group is not None else 0)
        columns = self.design.matrix(t, code, self._breaks)  # (n or 1, M, p)
        values = columns @ np.swapaxes(self._parameters, 1, 2)
        return self.series.centre + values * self.series.spread


# -- sampling of the posterior of a series ---------------------------------------------------------


@one_thread
def fit_series(
    series: Series,
    trend: TrendModel,
    *,
    seed: int = 1,
    scatter: ArrayLike | None = None,
    outliers: bool = True,
    target_ess: float = 400.0,
    target_rhat: float = 1.01,
    max_sweeps: int = 1600,
) -> SeriesPosterior:
    """Sample the posterior of a trend with time, the scatter of the exposures, and outliers.

    Parameters
    ----------
    series : Series
    trend : TrendModel
    seed : int
        Seed of the random numbers.
    scatter : array_like, shape (k, k), optional
        Intrinsic covariance of the coefficients, if known; fitted by default.
    outliers : bool
        True if exposures may be outliers.
    target_ess, target_rhat : float
        Convergence criteria for all parameters.
    max_sweeps : int
        Maximum number of draws per chain. Convergence is checked after 50 draws, then after 100
        new draws, and so on.

    Returns
    -------
    SeriesPosterior
        Its `convergence.converged` is True if the criteria were met.

    Raises
    ------
    DegenerateError
        If the exposures do not determine the trend (see `Design`), or have neither formal errors
        nor scatter.
    InputError
        If `scatter` is not a finite matrix of shape (k, k).
    """
    intrinsic = None
    if scatter is not None:
        intrinsic = np.asarray(scatter, float)
        k = series.n_coefficients
        if intrinsic.shape != (k, k) or not np.all(np.isfinite(intrinsic)):
            raise InputError(
                f"scatter has shape {intrinsic.shape} or is not finite, but must be a finite "
                f"matrix {(k, k)}",
                where=series.source,
                do="give the covariance of the coefficients",
            )
        unit = series.spread[:, None] * series.spread
        if np.linalg.eigvalsh((series.cov + intrinsic) / unit).min() <= 1e-12:
            raise DegenerateError(
                "with the given scatter some exposures have no error at all",
                where=series.source,
                do="give formal errors or a scatter above zero",
            )
    design = Design(trend, series)
    problem = SeriesProblem.of(series, design, intrinsic, outliers=outliers)
    engine, last, draws, convergence = run(
        problem,
        np.random.default_rng(seed),
        chains=CHAINS,
        warmup=WARMUP,
        sweeps=SWEEPS,
        most=max(max_sweeps, SWEEPS),
        limits=Limits(target_ess, target_rhat),
    )
    return SeriesPosterior(series, trend, design, draws, convergence, engine, last)


# -- predictive densities of held-out exposures ----------------------------------------------------


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Predictive densities of held-out exposures.

    Parameters
    ----------
    log_density : ndarray, shape (E,)
        Joint log predictive density of all k coefficients, in units of the spread.
    rank : ndarray, shape (E, k)
        Predictive probability of a value below the measured one; uniform if the trend is adequate.
    fold : ndarray of int, shape (E,)
        Number of the fold; exposures of a fold were held out together.
    mc_error : float
        Monte-Carlo standard error of the sum of `log_density`.
    """

    log_density: Float
    rank: Float
    fold: Int
    mc_error: float

    @property
    def total(self) -> float:
        """Sum of the log densities (score); larger values are better."""
        return float(self.log_density.sum())

    def covered(self, probability: float) -> Float:
        """Fraction of the measurements inside the central predictive interval.

        Parameters
        ----------
        probability : float
            Probability of the interval, between 0 and 1.

        Returns
        -------
        ndarray, shape (k,)
        """
        tail = (1 - probability) / 2
        return ((self.rank > tail) & (self.rank < 1 - tail)).mean(axis=0)


def exposure_folds(epoch: Float, groups: int = N_FOLDS) -> Int:
    """Assign exposures to folds in turn, in the order of their dates.

    Parameters
    ----------
    epoch : ndarray, shape (E,)
        Dates of the exposures.
    groups : int
        Number of folds, if there are enough exposures.

    Returns
    -------
    ndarray of int, shape (E,)
        Fold of each exposure.
    """
    out = np.empty(len(epoch), np.int64)
    out[np.argsort(epoch, kind="stable")] = np.arange(len(epoch)) % min(len(epoch), groups)
    return out


def block_folds(epoch: Float, breaks: tuple[float, ...], length: int) -> Int:
    """Divide exposures into blocks of consecutive exposures, at the longest gaps in time.

    Parameters
    ----------
    epoch : ndarray, shape (E,)
        Dates of the exposures.
    breaks : tuple of float
        Dates of given breaks, where blocks end. A segment with at least two exposures has several
        blocks.
    length : int
        Minimum number of exposures in a block, if the segments allow it.

    Returns
    -------
    ndarray of int, shape (E,)
        Block of each exposure.
    """
    order = np.argsort(epoch, kind="stable")
    t = epoch[order]
    n = len(t)
    cuts = {0, n, *(int(np.searchsorted(t, b)) for b in breaks)}
    for first, last in zip(sorted(cuts)[:-1], sorted(cuts)[1:], strict=True):
        min_length = min(length, (last - first) // 2)
        inner = sorted(range(first + 1, last), key=lambda i: t[i - 1] - t[i])
        for i in inner:
            below = max(c for c in cuts if c < i)
            above = min((c for c in cuts if c > i), default=n)
            if min_length and i in range(below + min_length, above - min_length + 1):
                cuts.add(i)
    out = np.empty(n, np.int64)
    out[order] = np.searchsorted(sorted(cuts), np.arange(n), side="right") - 1
    return out


@one_thread
def held_out(
    posterior: SeriesPosterior, fold: Int, *, seed: int = 1, max_pareto_k: float = PARETO_K.value
) -> HeldOut:
    """Predict the exposures of each fold from the other folds.

    The draws for the complete series are weighted by 1 / (density of the fold), with
    Pareto-smoothed weights (Vehtari, Gelman & Gabry 2017).  If the weights are unreliable, the
    posterior is sampled again without the fold.

    Parameters
    ----------
    posterior : SeriesPosterior
        Posterior of the complete series.
    fold : ndarray of int, shape (E,)
        Fold of each exposure.
    seed : int
        Seed of the random numbers.
    max_pareto_k : float
        Weights with a larger Pareto k are unreliable.

    Returns
    -------
    HeldOut
    """
    rng = np.random.default_rng([seed, 1])
    density, below = _of_all_draws(posterior)
    independent = min(1.0, posterior.convergence.ess_bulk_min / len(density))
    n, k = posterior.series.values.shape
    log_density, rank, error = np.zeros(n), np.zeros((n, k)), np.zeros(n)
    refitted = []
    for code in np.unique(fold):
        rows = fold == code
        weight, pareto_k = smoothed_weights(-density[:, rows].sum(axis=1), independent)
        if pareto_k > max_pareto_k:
            refitted.append(code)
            continue
        top = density[:, rows].max(axis=0)
        each = np.exp(density[:, rows] - top)
        mean = weight @ each
        log_density[rows] = top + np.log(mean)
        error[rows] = np.sqrt(weight**2 @ (each / mean - 1) ** 2 / independent)
        rank[rows] = np.tensordot(weight, below[:, rows], 1)
    at_once = max(1, CHAINS_AT_ONCE // FOLD_CHAINS)
    for start in range(0, len(refitted), at_once):
        codes = np.array(refitted[start : start + at_once])
        density, below = _without(posterior, fold, codes, rng)
        for i, code in enumerate(codes):
            rows = fold == code
            chains = density[i * FOLD_CHAINS : (i + 1) * FOLD_CHAINS, rows]
            top = chains.max(axis=0)
            each = np.exp(chains - top)
            log_density[rows] = top + np.log(each.mean(axis=0))
            error[rows] = each.std(axis=0, ddof=1) / each.mean(axis=0) / np.sqrt(FOLD_CHAINS)
            rank[rows] = below[i * FOLD_CHAINS : (i + 1) * FOLD_CHAINS, rows].mean(axis=0)
    return HeldOut(log_density, rank, fold, float(np.sqrt((error**2).sum())))


def _of_all_draws(posterior: SeriesPosterior) -> tuple[Float, Float]:
    """Log density (n, E) and probability below the measured value (n, E, k) for all draws."""
    n_draws = posterior.raw.fraction.size
    pieces = [
        predictive(posterior, posterior.raw.state(slice(first, first + DRAWS_AT_ONCE)))
        for first in range(0, n_draws, DRAWS_AT_ONCE)
    ]
    return np.concatenate([p[0] for p in pieces]), np.concatenate([p[1] for p in pieces])


def _without(
    posterior: SeriesPosterior, fold: Int, codes: Int, rng: np.random.Generator
) -> tuple[Float, Float]:
    """Log density (C, E) and probability below the measured value (C, E, k) without some folds.

    They are averaged over the draws of each chain, with `FOLD_CHAINS` chains per fold in `codes`.
    """
    engine, last = posterior.engine, posterior.last
    excluded = np.repeat(codes, FOLD_CHAINS)
    included = (excluded[:, None] != fold).astype(float)
    state = last.take(rng.integers(0, len(last.fraction), len(excluded)))
    for _ in range(FOLD_WARMUP):
        state = engine.step(state, rng, included)
    density = np.full(included.shape, -np.inf)
    below = np.zeros((*included.shape, posterior.series.n_coefficients))
    for _ in range(FOLD_SWEEPS):
        state = engine.step(state, rng, included)
        log_density, probability = predictive(posterior, state)
        density = np.logaddexp(density, log_density)
        below += probability
    return density - np.log(FOLD_SWEEPS), below / FOLD_SWEEPS


def predictive(posterior: SeriesPosterior, state: State) -> tuple[Float, Float]:
    """Log density (C, E) and probability below the measured value (C, E, k) for a state."""
    problem = posterior.engine.problem
    columns = problem.columns(state.breaks)
    residual = problem.residual(state.b, columns)
    f, kappa2 = state.fraction, state.kappa2
    log_density = densities(problem.formal, state.sigma, residual, f, kappa2)[0]
    variance = np.diagonal(problem.formal).T + np.diagonal(state.sigma, axis1=1, axis2=2)[..., None]
    sd = np.sqrt(variance)
    good = ndtr(residual / sd)
    bad = ndtr(residual / sd / np.sqrt(kappa2)[:, None, None])
    f = f[:, None, None]
    return log_density, np.swapaxes((1 - f) * good + f * bad, 1, 2)
