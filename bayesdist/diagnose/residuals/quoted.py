"""Quoted errors that are far too small, and matches most of which are false, with their sentences.

Jitter takes up errors that are a few times too small.  Where they are far smaller, what they say of
single stars would be lost beside it, so all of them are multiplied by what the residuals show.
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

LOW_QUANTILE = 0.1  # of the matches
FALSE_FRACTION = 0.02  # of false matches, beyond which they widen the residuals of least squares


def error_scale(fit: LinearFit, table: Matches) -> float:
    """Factor on all errors that makes small residuals what they say; 1 where it is not large.

    A low quantile of chi-square is compared with its expectation: most matches may be false.

    `table` has the matches, or some of them.
    """
    stars, _ = prepare(fit.model, table)
    r = stars.residuals(np.asarray(fit.mean))
    found = np.quantile(r[:, 0] ** 2 / stars.var_u + r[:, 1] ** 2 / stars.var_v, LOW_QUANTILE)
    factor = float(np.sqrt(found / chi2_ppf(LOW_QUANTILE, 2)))
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


def explained_by_false_matches(posterior: Posterior | None, quoted: float) -> bool:
    """True if a posterior finds false matches, and quoted errors of the others that are right.

    `quoted`: usual quoted error of one axis, in the unit of u and v.
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
    """Warning that most pairs are false, as a clause; empty where they are not.

    Rejection and mixture both take the true matches to be those that lie together.  Where false
    ones are the rule, a chance alignment, or their own mean, may be what was fitted; the posterior
    is then that of a wrong mode and says nothing of the others.  A mixture whose outliers have
    another shape than the false matches may settle where all pairs are true and their errors large:
    that shows in the jitter.

    `quoted` is the usual quoted error of one axis, in the unit of u, v; `things` is the word for
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
