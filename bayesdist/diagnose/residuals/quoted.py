"""Quoted errors that are far too small, and matches that are mostly false, with warnings.

Jitter compensates for errors that are a few times too small.  If they are far smaller, the
differences between stars would be lost in the jitter.  All errors are therefore multiplied by the
factor that the residuals show.
"""

from __future__ import annotations

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.infer.posterior import Posterior
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.infer.stars.stars import prepare
from bayesdist.utils.distributions import chi2_ppf
from bayesdist.utils.limits import (
    CHI2_TOO_LARGE,
    FALSE_MAJORITY,
    QUOTED_ERRORS,
    WIDENED_ERRORS,
)

LOW_QUANTILE = 0.1  # of the chi-squares of the matches
# fraction of false matches above which they broaden the residuals of least squares
FALSE_FRACTION = 0.02


def error_scale(fit: LinearFit, table: Matches) -> float:
    """Factor on all errors that makes small residuals consistent with them; 1 if it is not large.

    A low quantile of chi-square is compared with its expectation, because most matches may be
    false.  `table` contains the matches or a part of them.
    """
    stars, _ = prepare(fit.model, table)
    r = stars.residuals(np.asarray(fit.mean))
    quantile = np.quantile(r[:, 0] ** 2 / stars.var_u + r[:, 1] ** 2 / stars.var_v, LOW_QUANTILE)
    factor = float(np.sqrt(quantile / chi2_ppf(LOW_QUANTILE, 2)))
    return 1.0 if QUOTED_ERRORS.met_by(factor) else factor


def error_scale_sentence(factor: float, sigma: float, unit: str, *, by_magnitude: bool) -> str:
    """Warning that errors were multiplied, and what may help instead, as a clause.

    `sigma` is the median error after the multiplication; `by_magnitude` is True if errors can be
    estimated as a function of magnitude.
    """
    do = "check their unit and the order of the model"
    if by_magnitude:
        do += ', or set data.sigma = "by_magnitude"'
    return (
        f"the residuals scatter {factor:.3g} times as widely as the quoted errors say (median "
        f"{sigma / factor:.3g} {unit}), and all errors were multiplied by that: {do}"
    )


def explained_by_false_matches(posterior: Posterior | None, quoted: float) -> bool:
    """True if a posterior finds false matches, and correct quoted errors for the true ones.

    `quoted` is the typical quoted error per axis, in the unit of u and v.
    """
    if posterior is None or not {"f", "j"} <= set(posterior.hyper) or quoted <= 0:
        return False
    jitter = float(np.sqrt(np.mean(posterior.hyper["j"] ** 2)))
    right = 1.0 + (jitter / quoted) ** 2 <= CHI2_TOO_LARGE.value
    return right and float(posterior.hyper["f"].mean()) > FALSE_FRACTION


def majority_sentence(
    fit: LinearFit,
    posterior: Posterior | None = None,
    *,
    quoted: float | None = None,
    things: str = "pairs",
) -> str:
    """Warning that most pairs are false, as a clause; empty if they are not.

    Rejection and mixture both assume that true matches cluster.  If most matches are false, a
    chance alignment or their mean may have been fitted, and the posterior then belongs to a wrong
    mode.  If the outliers of a mixture have a different shape than the false matches, the solution
    may take all pairs as true with large errors; a large jitter indicates that.

    `quoted` is the typical quoted error per axis, in the unit of u and v; `things` is the word for
    the matches.
    """
    if posterior is not None and "f" in posterior.hyper:
        fraction = float(posterior.hyper["f"].mean())
        if not FALSE_MAJORITY.met_by(fraction):
            return (
                f"the mixture takes {100 * fraction:.0f} % of the {things} for false ones: with "
                "more false than true ones the solution may rest on chance alignments"
            )
    if posterior is not None and quoted and "j" in posterior.hyper:
        jitter = float(posterior.hyper["j"].mean())
        if jitter > WIDENED_ERRORS.value * quoted:
            return (
                f"the mixture adds {jitter:.3g} {posterior.unit} to the errors of all {things}, "
                f"{jitter / quoted:.2g} times the quoted one: either that is far too small, or "
                f"most {things} are false ones that were taken for true"
            )
    share = fit.n_rejected / fit.n_rows
    if not FALSE_MAJORITY.met_by(share):
        return (
            f"the fit left out {100 * share:.0f} % of the {things}: most of them are "
            "false, the quoted errors are far too small or the order of the model is too low, and "
            "the solution may rest on chance alignments"
        )
    return ""
