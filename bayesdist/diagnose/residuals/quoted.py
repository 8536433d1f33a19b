"""Quoted errors that are far too small: the factor, and its sentence.

Jitter takes up errors that are a few times too small.  Where they are far smaller, what they say of
single stars would be lost beside it, so all of them are multiplied by what the residuals show.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from bayesdist.data.matches import Matches
from bayesdist.infer.linear import LinearFit
from bayesdist.infer.stars.stars import prepare
from bayesdist.limits import QUOTED_ERRORS

__all__ = ["error_scale", "error_scale_sentence"]

LOW_QUANTILE = 0.1  # of the matches


def error_scale(fit: LinearFit, table: Matches) -> float:
    """Factor on all errors that makes small residuals what they say; 1 where it is not large.

    A low quantile of chi-square is compared with its expectation: most matches may be false.

    `table` has the matches, or some of them.
    """
    stars, _ = prepare(fit.model, table)
    r = stars.residuals(np.asarray(fit.mean))
    found = np.quantile(r[:, 0] ** 2 / stars.var_u + r[:, 1] ** 2 / stars.var_v, LOW_QUANTILE)
    factor = float(np.sqrt(found / chi2.ppf(LOW_QUANTILE, 2)))
    return 1.0 if QUOTED_ERRORS.met_by(factor) else factor


def error_scale_sentence(factor: float, sigma: float, unit: str, *, by_magnitude: bool) -> str:
    """Warning that errors were multiplied, and what else may help, as a clause.

    `sigma` is the median error after it; `by_magnitude` says that there are magnitudes to estimate
    errors by.
    """
    do = "check their unit and the order of the model"
    if by_magnitude:
        do += ', or set data.sigma = "by_magnitude"'
    return (
        f"the residuals scatter {factor:.3g} times as widely as the quoted errors say (median "
        f"{sigma / factor:.3g} {unit}), and all errors were multiplied by that: {do}"
    )
