"""Lines as published: coefficient by coefficient, segment by segment, by least squares.

For comparison with the posterior: the two-step way of Tables 1-3 of ACS ISR 2015-06.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.kinds.campaign.series.series import Series
from bayesdist.kinds.campaign.series.trend import Design, TrendModel

__all__ = ["StraightLines", "straight_lines"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StraightLines:
    """Lines alpha + beta (t - R) in each of S segments for each of k coefficients.

    Parameters
    ----------
    reference : ndarray, shape (S,)
    alpha, beta : ndarray, shape (S, k)
        Beta per year.
    sigma_alpha, sigma_beta : ndarray, shape (S, k)
        Formal errors.
    rms : ndarray, shape (S, k)
        Of the residuals, with n - 2 degrees of freedom.
    chi2 : ndarray, shape (S, k)
        Against the formal errors of the exposures; infinite where there are none.
    count : ndarray, shape (S,)
        Number of exposures.
    """

    reference: Float
    alpha: Float
    beta: Float
    sigma_alpha: Float
    sigma_beta: Float
    rms: Float
    chi2: Float
    count: NDArray[np.int64]


def straight_lines(series: Series, trend: TrendModel, *, weighted: bool = False) -> StraightLines:
    """Line of each coefficient in each segment.

    By default each exposure counts the same, and the errors come from the scatter about the line;
    with `weighted` the formal errors weight, and are propagated.
    """
    design = Design(trend, series)
    segment = design.segment(series.epoch)[0]
    shape = (trend.n_segments, series.n_coefficients)
    alpha, beta, s_alpha, s_beta, rms, chi2 = (np.zeros(shape) for _ in range(6))
    for s in range(trend.n_segments):
        rows = segment == s
        since = series.epoch[rows] - design.reference[s]
        columns = np.stack([np.ones(rows.sum()), since], axis=1)
        for j in range(series.n_coefficients):
            sigma = series.sigma[rows, j]
            weight = sigma**-2 if weighted else np.ones(rows.sum())
            cov = np.linalg.inv(columns.T @ (weight[:, None] * columns))
            # the values are close to each other and far from zero
            y = series.values[rows, j] - series.centre[j]
            fit = cov @ columns.T @ (weight * y)
            residual = y - columns @ fit
            rms[s, j] = np.sqrt(residual @ residual / (rows.sum() - 2))
            with np.errstate(divide="ignore"):
                chi2[s, j] = ((residual / sigma) ** 2).sum() if sigma.all() else np.inf
            errors = np.sqrt(np.diag(cov)) * (1.0 if weighted else rms[s, j])
            alpha[s, j], beta[s, j] = fit[0] + series.centre[j], fit[1]
            s_alpha[s, j], s_beta[s, j] = errors
    count = np.array([(segment == s).sum() for s in range(trend.n_segments)])
    return StraightLines(design.reference, alpha, beta, s_alpha, s_beta, rms, chi2, count)
