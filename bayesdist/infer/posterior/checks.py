"""Checks of a fit and of a posterior: chi-square, rejected rows, condition, convergence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayesdist.infer.convergence import Convergence
from bayesdist.infer.posterior import Posterior
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.infer.solution.solution import Solution
from bayesdist.utils.checks import (
    CHI2_TOO_LARGE,
    CHI2_TOO_SMALL,
    CHI2_TOO_SMALL_CHANCE,
    CONDITION,
    EITHER,
    IMPORTANCE_EFFICIENCY,
    LARGER,
    LEFT_OUT,
    MEAN_ERROR,
    PARETO_K,
    PIXEL_SIZE,
    Check,
    level_of,
)
from bayesdist.utils.distributions import chi2_cdf
from bayesdist.utils.text import count, number, percent

FIT, SAMPLING = "Fit", "Sampling"


def scatter_too_small(total: float, dof: float) -> bool:
    """True if the chi-square `total` is significantly too small for `dof` degrees of freedom.

    The residuals then scatter less than their quoted errors.
    """
    by_chance = float(chi2_cdf(total, max(dof, 1)))
    return total < CHI2_TOO_SMALL.value * dof and by_chance < CHI2_TOO_SMALL_CHANCE.value


@dataclass(frozen=True)
class ChiSquare:
    """Chi-square of a fit with the quoted errors, and circumstances that affect its meaning.

    Parameters
    ----------
    total : float
        Chi-square of both axes.
    dof : float
        Degrees of freedom.
    in_circle : bool
        True if the likelihood accounts for the match circle that truncates the residuals.
    false_matches : bool
        True if the posterior attributes residuals that are too large to false matches and finds
        the quoted errors correct.
    catalogue : bool
        True if u and v are positions of a reference catalogue, whose errors the quoted ones
        include.
    radius_doubt : str
        Clause on a stated match radius that no match comes near; empty if there is none.
    cut_elsewhere : bool
        True if matches may have been cut at a radius about positions that are not given.
    """

    total: float
    dof: float
    in_circle: bool = False
    false_matches: bool = False
    catalogue: bool = True
    radius_doubt: str = ""
    cut_elsewhere: bool = False

    def check(self, findings: Sequence[str] = (), *, displaced: bool = False) -> Check:
        """Check that chi-square is about one per degree of freedom.

        `findings` are the names of other findings in the residuals, such as missing terms.  If the
        model does not describe the positions, large residuals are no evidence against the quoted
        errors.  `displaced` is True if a part of the stars is displaced as a whole: that test has
        excluded a cut of normal errors about the solution.
        """
        ratio = self.total / self.dof if self.dof > 0 else float("nan")
        small = scatter_too_small(self.total, self.dof)
        doubt = EITHER if small and not self.in_circle else ""
        unexplained = ratio > CHI2_TOO_LARGE.value and not self.false_matches and not findings
        if unexplained and self.radius_doubt:
            doubt = LARGER
        return Check(
            FIT,
            "Chi-square per degree of freedom, quoted errors",
            number(ratio),
            f"{CHI2_TOO_SMALL.value:g} to {CHI2_TOO_LARGE.value:g}",
            level_of(not small and CHI2_TOO_LARGE.met_by(ratio), "warn"),
            self._sentence(small, findings, uncut=displaced and not self.cut_elsewhere),
            doubt,
        )

    def _sentence(self, small: bool, findings: Sequence[str], *, uncut: bool) -> str:
        """Sentence on a chi-square that is not about one; empty where it is."""
        ratio = self.total / max(self.dof, 1)
        if small and self.in_circle:
            return (
                f"chi-square per degree of freedom of least squares is {ratio:.2g}: the match "
                "circle cuts the residuals, and draws this fit to the nominal solution; the "
                "posterior accounts for the circle"
            )
        if small:
            why = "" if uncut else "the match radius has cut the residuals, or "
            return (
                f"chi-square per degree of freedom is {ratio:.2g}: {why}the quoted errors are too "
                "large, and with them all uncertainties"
            )
        if ratio <= CHI2_TOO_LARGE.value:
            return ""
        if self.false_matches:
            return (
                f"chi-square per degree of freedom of least squares is {ratio:.3g}: the rejection "
                "limits have kept false matches; the posterior accounts for them, with the quoted "
                "errors of the others as they are"
            )
        why = "they are too small, which the jitter takes up, or the model does not fit"
        if self.catalogue:
            why = (
                "if centroids cause it, they are too small, and the jitter takes it up; if the "
                "catalogue does, as with motions since its epoch, all stars may also be displaced "
                "together, by more than its stated error: state the errors of both as they are"
            )
        if self.radius_doubt:
            why = f"{self.radius_doubt}; otherwise the jitter takes up what is not quoted"
        if findings:
            why = (
                f"the model does not describe all positions ({', '.join(findings)}): follow that "
                "advice before the errors are changed"
            )
        return f"chi-square per degree of freedom is {ratio:.3g} with the quoted errors: {why}"


def fit_checks(
    fit: LinearFit, *, things: str = "stars", chooser: str = "least-squares fit"
) -> tuple[Check, ...]:
    """Checks of a fit: fraction of rows left out, and condition number.

    Parameters
    ----------
    fit : LinearFit
    things : str
        Plural noun for the rows that are fitted, as printed.
    chooser : str
        Name of the step that leaves rows out, as printed.

    Returns
    -------
    tuple of Check
    """
    left_out = fit.n_rejected / fit.n_rows
    return (
        Check(
            FIT,
            f"{things.capitalize()} left out by the {chooser}",
            percent(left_out),
            f"at most {percent(LEFT_OUT.value, 2)}",
            level_of(LEFT_OUT.met_by(left_out), "warn"),
        ),
        Check(
            FIT,
            "Condition number of the scaled normal matrix",
            number(fit.condition, 2),
            f"at most {number(CONDITION.value, 1)}",
            level_of(CONDITION.met_by(fit.condition), "warn"),
        ),
    )


def pixel_doubt(solution: Solution) -> str:
    """Warning if u and v are declared as pixels but the fitted scale contradicts it; else empty."""
    model = solution.model
    if model.unit != "pix":
        return ""
    size = model.linear_scale(solution.mean)
    if 1 / PIXEL_SIZE.value <= size <= PIXEL_SIZE.value:
        return ""
    return (
        f"u and v are called pixels, and one pixel of x, y is {size:.4g} of theirs: if they are "
        f"millimetres, divide them and their errors by {size:.4g}; if they are angles, give their "
        "unit; as they are, every error in 'pix' is in the unit of u and v"
    )


def convergence_check(c: Convergence) -> Check:
    """Check that the posterior is converged; lists the criteria that failed."""
    sentence = ""
    if not c.converged:
        why = "; ".join(c.reasons)
        sentence = "the posterior is not converged" + (f": {why}" if why else "")
    good = "yes" if c.converged else "NO"
    return Check(
        SAMPLING, "Converged", good, "yes", level_of(c.converged), sentence, sentence and EITHER
    )


def sampling_checks(posterior: Posterior | None) -> tuple[Check, ...]:
    """Checks of the posterior draws; a single warning "not sampled" if `posterior` is None."""
    if posterior is None:
        return (Check(SAMPLING, "Posterior", "not sampled", "sampled and converged", "warn"),)
    c = posterior.convergence
    D = len(posterior.mean)
    sd = np.sqrt(np.diag(posterior.cov))
    with np.errstate(divide="ignore", invalid="ignore"):
        mcse = float(np.nanmax(np.where(sd > 0, c.mcse_mean[:D] / sd, 0.0), initial=0.0))
    # R-hat and ESS decide; the other diagnostics are advisory and only warn
    return (
        convergence_check(c),
        Check(
            SAMPLING,
            f"Largest R-hat, {posterior.sampler.ensembles} independent ensembles",
            f"{c.rhat_max:.4f}" if np.isfinite(c.rhat_max) else "∞",
            f"at most {c.limits.rhat:g}",
            level_of(c.rhat_max <= c.limits.rhat),
        ),
        *(
            Check(
                SAMPLING,
                f"Smallest {part} effective sample size",
                count(np.floor(ess)),
                f"at least {count(c.limits.ess)}",
                level_of(ess >= c.limits.ess),
            )
            for part, ess in (("bulk", c.ess_bulk_min), ("tail", c.ess_tail_min))
        ),
        Check(
            SAMPLING,
            "Largest Monte-Carlo error of a mean, in posterior sd",
            number(mcse, 2),
            MEAN_ERROR.words,
            level_of(MEAN_ERROR.met_by(mcse), "warn"),
        ),
        Check(
            SAMPLING,
            "Pareto k of the proposal",
            number(c.pareto_k, 2),
            PARETO_K.words,
            level_of(PARETO_K.met_by(c.pareto_k), "warn"),
        ),
        Check(
            SAMPLING,
            "Importance efficiency of the proposal",
            percent(c.importance_efficiency, 2),
            f"at least {percent(IMPORTANCE_EFFICIENCY.value, 2)}",
            level_of(IMPORTANCE_EFFICIENCY.met_by(c.importance_efficiency), "warn"),
        ),
    )
