"""The status on top of the report: each criterion with its number and limit, and a verdict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.assess.verdict import LEAST_CHI2, scatter_too_small
from bayesdist.report.campaign.status import campaign_checks
from bayesdist.report.context import Check, ReportInput
from bayesdist.report.holdout import holdout_checks
from bayesdist.report.margins import VERDICT_LEVELS
from bayesdist.report.numbers import count, number, percent, rounded, with_mas
from bayesdist.report.structure import structure_check

__all__ = ["Verdict", "status_checks", "verdict"]

_PARETO_K = 0.7  # above it importance weights cannot be trusted (Vehtari et al. 2024)
_EFFICIENCY = 0.1
_MCSE = 0.1  # of a posterior sd: adds half a percent to the error of a mean
_MOST_CHI2 = 1.5  # per degree of freedom: quoted errors right within some twenty percent
_LEFT_OUT = 0.2  # of the stars: rejection that takes more has shaped what it was to protect
_CONDITION = 1e8  # leaves half the digits of a double


@dataclass(frozen=True)
class Verdict:
    """What the run is worth, in words.

    Parameters
    ----------
    level : str
        'pass', 'warn' or 'fail'.
    headline : str
    sentences : tuple of str
    """

    level: str
    headline: str
    sentences: tuple[str, ...]


def status_checks(inputs: ReportInput) -> dict[str, tuple[Check, ...]]:
    """All criteria, by what they concern.

    Parameters
    ----------
    inputs : ReportInput

    Returns
    -------
    dict of str to tuple of Check
        Groups 'Held-out truth', 'Campaign', 'Sampling', 'Fit', 'Requirements', 'Products'; empty
        ones are left out.
    """
    groups = {
        "Held-out truth": holdout_checks(inputs.held_out),
        "Campaign": () if inputs.campaign is None else campaign_checks(inputs.campaign),
        "Sampling": _sampling_checks(inputs),
        "Fit": _fit_checks(inputs),
        "Requirements": _margin_checks(inputs),
        "Products": tuple(
            Check(f"{p.path}: {c.name}", c.value, c.limit, c.level)
            for p in inputs.products
            for c in p.checks
            if c.level != "note"
        ),
    }
    return {name: checks for name, checks in groups.items() if checks}


def _level(good: bool, bad: str = "fail") -> str:
    return "pass" if good else bad


def _sampling_checks(inputs: ReportInput) -> tuple[Check, ...]:
    if inputs.posterior is None:
        return (Check("Posterior", "not sampled", "sampled and converged", "warn"),)
    c = inputs.posterior.convergence
    D = len(inputs.posterior.mean)
    sd = np.sqrt(np.diag(inputs.posterior.cov))
    with np.errstate(divide="ignore", invalid="ignore"):
        mcse = float(np.nanmax(np.where(sd > 0, c.mcse_mean[:D] / sd, 0.0), initial=0.0))
    # what only advises does not fail by itself: the limits of R-hat and ESS decide
    return (
        Check("Converged", "yes" if c.converged else "NO", "yes", _level(c.converged)),
        Check(
            f"Largest R-hat, {inputs.posterior.sampler.ensembles} independent ensembles",
            f"{c.rhat_max:.4f}" if np.isfinite(c.rhat_max) else "∞",
            f"at most {c.limits.rhat:g}",
            _level(c.rhat_max <= c.limits.rhat),
        ),
        Check(
            "Smallest bulk effective sample size",
            count(np.floor(c.ess_bulk_min)),
            f"at least {c.limits.ess:g}",
            _level(c.ess_bulk_min >= c.limits.ess),
        ),
        Check(
            "Smallest tail effective sample size",
            count(np.floor(c.ess_tail_min)),
            f"at least {c.limits.ess:g}",
            _level(c.ess_tail_min >= c.limits.ess),
        ),
        Check(
            "Largest Monte-Carlo error of a mean, in posterior sd",
            number(mcse, 2),
            f"at most {_MCSE:g}",
            _level(mcse <= _MCSE, "warn"),
        ),
        Check(
            "Pareto k of the proposal",
            number(c.pareto_k, 2),
            f"at most {_PARETO_K:g}",
            _level(c.pareto_k <= _PARETO_K, "warn"),
        ),
        Check(
            "Importance efficiency of the proposal",
            percent(c.importance_efficiency, 2),
            f"at least {percent(_EFFICIENCY, 2)}",
            _level(c.importance_efficiency >= _EFFICIENCY, "warn"),
        ),
    )


def _fit_checks(inputs: ReportInput) -> tuple[Check, ...]:
    fit = inputs.fit
    ratio = fit.chi2 / fit.dof if fit.dof > 0 else float("nan")
    left_out = fit.n_rejected / fit.n_rows
    small = scatter_too_small(fit.chi2, fit.dof)
    structure = (structure_check(inputs.misfits, fit="the fit"),) if inputs.misfits else ()
    return (
        Check(
            "Chi-square per degree of freedom, quoted errors",
            number(ratio),
            f"{LEAST_CHI2:g} to {_MOST_CHI2:g}",
            _level(not small and ratio <= _MOST_CHI2, "warn"),
        ),
        Check(
            f"{inputs.words.things.capitalize()} left out by the {inputs.words.chooser}",
            percent(left_out),
            f"at most {percent(_LEFT_OUT, 2)}",
            _level(left_out <= _LEFT_OUT, "warn"),
        ),
        Check(
            "Condition number of the scaled normal matrix",
            number(fit.condition, 2),
            f"at most {number(_CONDITION, 1)}",
            _level(fit.condition <= _CONDITION, "warn"),
        ),
        *structure,
    )


def _margin_checks(inputs: ReportInput) -> tuple[Check, ...]:
    return tuple(
        Check(
            f"{m.requirement.name}: {m.requirement.statistic}, {m.verdict}",
            f"{rounded(m.value, (m.interval[1] - m.interval[0]) / 4)}\u202f{m.unit}, probability"
            f" {number(m.probability_met)}",
            f"at most {m.requirement.limit:g}\u202f{m.unit}, with probability"
            f" {m.requirement.probability:g}",
            VERDICT_LEVELS[m.verdict],
        )
        for m in inputs.margins
    )


def verdict(inputs: ReportInput) -> Verdict:
    """The verdict on the run.

    Parameters
    ----------
    inputs : ReportInput

    Returns
    -------
    Verdict
        'fail' when the posterior is not converged, a requirement is missed or a product fails its
        check; 'warn' when something is undecided or nothing was sampled.
    """
    sentences = [_margin_sentence(inputs), _accuracy_sentence(inputs)]
    failed = [
        f"{p.path} ({c.name})" for p in inputs.products for c in p.checks if c.level == "fail"
    ]
    if failed:
        sentences.append(f"Products that fail their own check: {', '.join(failed)}.")
    verdicts = {m.verdict for m in inputs.margins}
    if inputs.provisional:
        reasons = inputs.posterior.convergence.reasons  # type: ignore[union-attr]
        sentences.insert(0, f"Why: {'; '.join(reasons) or 'no reason was recorded'}.")
        return Verdict("fail", "NOT CONVERGED: do not rely on these numbers", tuple(sentences))
    if inputs.posterior is None:
        headline, level = "Least squares only: no posterior was sampled", "warn"
    else:
        headline, level = "The posterior is converged", "pass"
    if inputs.warnings:
        sentences[:0] = [f"{text}." for text in inputs.warnings]
        headline, level = f"{headline}, but read the warnings", _worse(level, "warn")
    if "missed" in verdicts:
        headline, level = f"{headline}; not every requirement is met", "fail"
    elif "undecided" in verdicts:
        headline, level = f"{headline}; not every requirement is decided", _worse(level, "warn")
    elif verdicts:
        headline = f"{headline}; every requirement is met"
    if failed:
        headline, level = f"{headline}; a product fails its check", "fail"
    return Verdict(level, headline, tuple(sentences))


def _worse(a: str, b: str) -> str:
    order = ("pass", "warn", "fail")
    return max(a, b, key=order.index)


def _margin_sentence(inputs: ReportInput) -> str:
    if not inputs.margins:
        return "No requirement was stated."
    by_verdict: dict[str, list[str]] = {}
    for m in inputs.margins:
        by_verdict.setdefault(m.verdict, []).append(m.requirement.name)
    parts = [
        f"{len(by_verdict[v])} {v} ({', '.join(by_verdict[v])})"
        for v in ("met", "missed", "undecided")
        if v in by_verdict
    ]
    return f"Requirements: {'; '.join(parts)}."


def _accuracy_sentence(inputs: ReportInput) -> str:
    whose = "posterior" if inputs.posterior is not None else "formal"
    if inputs.provisional:
        whose = f"provisional {whose}"
    worst = max(inputs.chips, key=lambda c: c.best_map.radius_max)
    best = worst.best_map
    median = float(np.median(np.concatenate([c.best_map.radius.ravel() for c in inputs.chips])))
    x, y = best.position_of_max
    text = (
        f"The {whose} uncertainty of the distortion (radial, 1 σ) is"
        f" {with_mas(median, inputs.unit, inputs.scale_mas)} at the median"
        f" place and at most {with_mas(best.radius_max, inputs.unit, inputs.scale_mas)},"
        f" at pixel ({x:.0f}, {y:.0f}){inputs.on_chip(worst.chip)}"
        f"{_with_shift(inputs)}"
    )
    if inputs.budget is None:
        return f"{text}."
    total = inputs.budget.rows()[-1]["radial"]
    with_budget = with_mas(total, inputs.budget.unit, inputs.scale_mas)
    whom = (
        ""
        if inputs.campaign is None
        else " for a new exposure whose shift and rotation are fitted by whoever uses it"
    )
    return f"{text}; with all terms of the budget the rms over the detector is {with_budget}{whom}."


def _with_shift(inputs: ReportInput) -> str:
    """What a shift and a rotation of the whole count for in the errors of positions."""
    if inputs.selfcal is not None:
        return ", in the gauge of the solution"
    return ", shift and rotation included" if inputs.fit.model.n_frame else ""
