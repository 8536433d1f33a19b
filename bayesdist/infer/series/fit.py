"""From a series to its posterior."""

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

CHAINS, WARMUP, SWEEPS = 32, 50, 50


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
    """Posterior of a trend with time, of the scatter of the exposures, and of outliers.

    Parameters
    ----------
    series : Series
    trend : TrendModel
    seed : int
    scatter : array_like, shape (k, k), optional
        Intrinsic covariance where it is known; it is a parameter by default.
    outliers : bool
        True if exposures may lie off the trend.
    target_ess, target_rhat : float
        Limits of convergence, for every parameter.
    max_sweeps : int
        Draws of each chain at most; convergence is judged of 50, then of 100 further ones, and so
        on.

    Returns
    -------
    SeriesPosterior
        `convergence` shows if the limits were reached.

    Raises
    ------
    DegenerateError
        Where the exposures do not determine the trend (see `Design`), or have no error at all.
    InputError
        For a scatter of another shape.
    """
    known = None
    if scatter is not None:
        known = np.asarray(scatter, float)
        k = series.n_coefficients
        if known.shape != (k, k) or not np.all(np.isfinite(known)):
            raise InputError(
                f"scatter has shape {known.shape} or is not finite, and must be a finite matrix "
                f"{(k, k)}",
                where=series.source,
                do="give the covariance of the coefficients",
            )
        unit = series.spread[:, None] * series.spread
        if np.linalg.eigvalsh((series.cov + known) / unit).min() <= 1e-12:
            raise DegenerateError(
                "with the given scatter some exposures have no error at all",
                where=series.source,
                do="give formal errors or a scatter above zero",
            )
    design = Design(trend, series)
    problem = Problem.of(series, design, known, outliers=outliers)
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
