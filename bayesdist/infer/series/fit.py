"""Sampling of the posterior of a series."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.convergence import Limits
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.series.chains import run
from bayesdist.infer.series.design import Design
from bayesdist.infer.series.posterior import SeriesPosterior
from bayesdist.infer.series.problem import Problem
from bayesdist.infer.series.series import Series
from bayesdist.infer.series.trend import TrendModel

CHAINS, WARMUP, SWEEPS = 32, 50, 50  # number of chains; sweeps of the warm-up; first sweeps


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
                f"scatter has shape {intrinsic.shape} or is not finite, and must be a finite "
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
    problem = Problem.of(series, design, intrinsic, outliers=outliers)
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
